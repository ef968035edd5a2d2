"""Run the residual networks of a loss through their hand-written passes while the learner updates."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torchrl.objectives import LossModule

from coachable.networks.ensemble import CriticEnsemble, Shadow, residual_networks


class Acceleration:
    """Hand-written forward and backward of a loss's policy and critics, in one precision.

    The critics are taken over for good (their parameters live in the loss, their modules are ours); the policy only
    inside :meth:`active`, since a collector may share it.

    Args:
        loss_module: A loss for which :meth:`supports` holds.
        dtype: Dtype of the matrix products, `None` for that of the parameters.
    """

    def __init__(self, loss_module: LossModule, dtype: torch.dtype | None) -> None:
        loss: Any = loss_module
        self._critics = CriticEnsemble(
            loss.qvalue_network, loss.qvalue_network_params, loss.target_qvalue_network_params, dtype
        )
        loss._vmap_qnetworkN0 = self._critics
        self._loss, self._dtype = loss, dtype
        self.bind()

    @staticmethod
    def supports(loss_module: LossModule) -> bool:
        """Whether all networks are residual ones, on a CPU, and the critics are evaluated in SACLoss's way."""
        loss: Any = loss_module
        device = next(loss_module.parameters()).device
        return (
            device.type == "cpu"
            and hasattr(loss, "_vmap_qnetworkN0")
            and getattr(loss, "value_network", None) is None
            and CriticEnsemble.supports(loss.qvalue_network)
            and residual_networks(loss.actor_network) is not None
        )

    def bind(self) -> None:
        """Take hold of the loss's tensors (again, after they were replaced rather than overwritten)."""
        self._critics.bind()
        self._policies = residual_networks(self._loss.actor_network) or []
        self._shadow = Shadow(self._policies, self._dtype)

    @contextmanager
    def active(self) -> Iterator[None]:
        """Renew all low-precision weights and evaluate the policy with them inside the block."""
        self._critics.refresh()
        self._shadow.refresh()
        for network, plan in zip(self._policies, self._shadow.plans, strict=True):
            network.use_plan(plan)
        try:
            yield
        finally:
            for network in self._policies:
                network.use_plan(None)

    def refresh(self, name: str) -> None:
        """Renew the low-precision weights of the `"actor"` or the `"critic"` after its optimiser's step."""
        if name == "actor":
            self._shadow.refresh()
        elif name == "critic":
            self._critics.refresh(target=False)
