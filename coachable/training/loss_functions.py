"""Functions of a loss module that an update evaluates."""

import logging
import os
import shutil
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torchrl.objectives import LossModule

from coachable.ranges import SHARE

_LOG = logging.getLogger(__name__)


class LossFunctions(NamedTuple):
    """Functions of a loss module, each of which takes a batch.

    Attributes:
        both: Returns a tensordict with `loss_actor` and `loss_qvalue`.
        actor: Returns the policy's loss and metadata.
        critic: Returns the critics' loss and metadata.
    """

    both: Callable[..., Any]
    actor: Callable[..., Any]
    critic: Callable[..., Any]


def loss_functions(loss_module: LossModule) -> LossFunctions:
    """Return the functions of a loss.

    Raises:
        ValueError: If the loss has no function for the critics alone.
    """
    loss: Any = loss_module
    critic = getattr(loss, "qvalue_loss", None) or getattr(loss, "qvalue_v2_loss", None)
    if critic is None:
        raise ValueError(
            f"{type(loss).__name__} has neither qvalue_loss(td) nor qvalue_v2_loss(td) returning (loss, metadata)"
        )
    return LossFunctions(loss.forward, loss.actor_loss, critic)


def compiled(functions: LossFunctions, device_type: str) -> LossFunctions:
    """Compile functions with `torch.compile`; on a CPU without a C++ compiler, return them and log a warning."""
    if device_type != "cpu" or any(shutil.which(c) for c in (os.environ.get("CXX"), "g++", "clang++") if c):
        return LossFunctions(*map(torch.compile, functions))
    _LOG.warning("compile=True has no effect: torch.compile needs a C++ compiler on a CPU (g++ or clang++, or set CXX)")
    return functions


def check_loss(loss_module: LossModule) -> None:
    """Check the discount and the entropy weight of a loss, which TorchRL does not check.

    Raises:
        ValueError: If the discount lies outside [0, 1], or the entropy weight is negative (its logarithm is NaN).
    """
    gamma = getattr(getattr(loss_module, "_value_estimator", None), "gamma", None)
    if gamma is not None:
        SHARE.check("gamma of the loss", float(gamma))
    log_alpha = getattr(loss_module, "log_alpha", None)
    if log_alpha is not None and bool(torch.isnan(log_alpha)):
        raise ValueError("alpha of the loss is below 0: expected a number of at least 0")
