"""Backend of a learner in plain torch: evaluates networks and steps parameters."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Literal, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule, SoftUpdate

from coachable.training.loss_functions import LossFunctions


class Backend:
    """Operations of an update that another implementation may replace without changing the result.

    This implementation evaluates the networks layer by layer, under autocast at bfloat16. It steps with
    `torch.optim.Adam` and moves the target networks with TorchRL's `SoftUpdate`. To replace it, pass a subclass to
    :meth:`coachable.training.Learner.use_backend`, as `coachable.fast.accelerate` does.

    Attributes:
        compiles: Whether `torch.compile` may be applied to the loss functions.
    """

    compiles = True

    def __init__(self, loss_module: LossModule, precision: Literal["fp32", "bf16"], target_updater: SoftUpdate) -> None:
        self.loss_module = loss_module
        self.precision = precision
        self.target_updater = target_updater
        self._device_type = next(loss_module.parameters()).device.type

    def working(self) -> AbstractContextManager[Any]:
        """Return the context of a round of updates and of the sampling between them; an update alone needs none."""
        return nullcontext()

    def updating(self) -> AbstractContextManager[Any]:
        """Return the context of an update: evaluations, backward passes and steps of the optimisers."""
        return nullcontext()

    def evaluating(self) -> AbstractContextManager[Any]:
        """Return the context in which a loss is evaluated, without its backward pass."""
        if self.precision == "fp32":
            return nullcontext()
        return torch.autocast(self._device_type, dtype=torch.bfloat16)

    def both(self, losses: LossFunctions, batch: TensorDictBase, trained: Sequence[str]) -> Any:
        """Evaluate all losses, set the gradients of those in `trained`, and write `td_error` into the batch.

        Returns:
            The losses and further results by name.
        """
        with self.evaluating():
            outputs = losses.both(batch)
        cast(Tensor, sum(outputs[name] for name in trained)).backward()
        return outputs

    def actor(self, losses: LossFunctions, batch: TensorDictBase) -> tuple[Tensor, Any]:
        """Evaluate the policy's loss and set its gradients.

        Args:
            losses: The functions of the loss.
            batch: Transitions `[B]` or `[B, n + 1]`.

        Returns:
            The scalar loss and its metadata.
        """
        return self._differentiated(losses.actor, batch)

    def critic(self, losses: LossFunctions, batch: TensorDictBase) -> tuple[Tensor, Any]:
        """Evaluate the critics' loss and set its gradients, like `actor`; `td_error` is written into the batch."""
        return self._differentiated(losses.critic, batch)

    def make_optimizer(self, name: str, params: list[nn.Parameter], lr: float, eps: float) -> torch.optim.Adam:
        """Return an optimiser whose state dict has the format of `torch.optim.Adam`.

        Args:
            name: `"actor"`, `"critic"` or `"alpha"`.
            params: The trained parameters of that name.
            lr: Learning rate.
            eps: Adam's epsilon.
        """
        return torch.optim.Adam(params, lr=lr, eps=eps, fused=self._device_type in ("cpu", "cuda"))

    def gradient_norm(self, name: str, params: list[nn.Parameter]) -> Tensor:
        """Return the 2-norm of the gradients after the backward pass.

        Args:
            name: `"actor"`, `"critic"` or `"alpha"`.
            params: The trained parameters of that name. Those without a gradient do not count.

        Returns:
            Scalar norm over all parameters together.
        """
        return torch.nn.utils.get_total_norm([p.grad for p in params if p.grad is not None])

    def move_targets(self) -> None:
        """Move the target networks after an update."""
        self.target_updater.step()

    def follow(self) -> None:
        """Use the loss's present parameters, after they were replaced, cast or moved in memory."""

    def _differentiated(self, function: Callable[..., Any], batch: TensorDictBase) -> tuple[Tensor, Any]:
        with self.evaluating():
            loss, extra = function(batch)
        loss.backward()
        return loss, extra
