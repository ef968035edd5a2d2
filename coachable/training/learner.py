"""Gradient updates of an actor-critic loss: update order, optimisers, target networks and precision."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable
from typing import Any, Literal, cast, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule, SoftUpdate

from coachable.finite import NonFiniteError
from coachable.ranges import NOT_NEGATIVE, POSITIVE, Range
from coachable.training.backend import Backend
from coachable.training.loss_functions import check_loss, compiled, loss_functions
from coachable.training.precision import Precision, resolve_precision
from coachable.training.trained_parameters import Watch, adopt_actor, follow, loaded, share_actor, trained_parameters

_ADVICE = "Look for extreme rewards or observations, lower the learning rates, or set max_grad_norm."

CHECK_EVERY = 100  # updates on a GPU between checks for skipped ones, which wait for the device

UpdateOrder = Literal["simultaneous", "policy_first"]


class NonFiniteLossError(NonFiniteError):
    """A loss or a gradient became infinite or NaN."""


class Learner:
    """Learner that updates a TorchRL actor-critic loss module from batches.

    It works with `SACLoss`, QR-SAC, RAC, Cat-RAC and any other `LossModule` with `actor_network_params`,
    `qvalue_network_params`, their targets, and `loss_actor` and `loss_qvalue` among its outputs.

    Update orders:

    - `"simultaneous"` (the paper's humanoid): both losses are computed from the parameters before the update, then
      both optimisers step, then the target networks move.
    - `"policy_first"` (the paper's racing and combat): the policy steps on `actor_loss`, then the critics step on a
      target whose next actions come from the updated policy.

    No weight is changed by losses or gradients that are infinite or NaN. On a CPU such an update raises. On a GPU it is
    skipped, and the next check raises: every 100th update checks, as does :meth:`check_finite`.

    Args:
        loss_module: The loss.
        actor_lr: Learning rate of the policy.
        critic_lr: Learning rate of all other trained parameters, except the temperature.
        alpha_lr: Learning rate of a learned temperature; unused with `fixed_alpha=True`.
        adam_eps: Adam's epsilon. The default is TensorFlow's 1e-7, not torch's 1e-8.
        tau: Polyak rate of the target networks per update.
        max_grad_norm: Clip the norm of the policy's and of the critics' gradient, each on its own, to this value.
        update_order: `"simultaneous"` or `"policy_first"`.
        precision: `"bf16"` multiplies in bfloat16 and keeps weights, layer-norm statistics, heads, targets and losses
            in float32; `"auto"` chooses it where the device has it in hardware.
        compile: Compile the loss functions with `torch.compile`. On a CPU this needs a C++ compiler; without one it has
            no effect and logs a warning.

    Attributes:
        backend: How networks are evaluated and parameters stepped, see :meth:`use_backend`.

    Between updates you may move the loss or its policy to shared memory, cast them to another dtype, load them with
    `assign=True` or give them other `.data`. The next update trains the parameters that they have then.

    Raises:
        ValueError: If an option is unknown or a number out of range.
    """

    def __init__(
        self,
        loss_module: LossModule,
        *,
        actor_lr: float = 1e-4,
        critic_lr: float = 1e-4,
        alpha_lr: float = 1e-4,
        adam_eps: float = 1e-7,
        tau: float = 0.005,
        max_grad_norm: float | None = None,
        update_order: UpdateOrder = "simultaneous",
        precision: Precision = "auto",
        compile: bool = False,
    ) -> None:
        self._options = {name: value for name, value in locals().items() if name not in ("self", "loss_module")}
        if update_order not in get_args(UpdateOrder):
            raise ValueError(f"update_order must be one of {get_args(UpdateOrder)}, got {update_order!r}")
        self._rates = {"actor": actor_lr, "critic": critic_lr, "alpha": alpha_lr}
        for name, rate in self._rates.items():
            NOT_NEGATIVE.check(f"{name}_lr", rate)
        POSITIVE.check("adam_eps", adam_eps)
        Range("(0, 1]").check("tau", tau)
        Range("(0, inf)", optional=True).check("max_grad_norm", max_grad_norm)
        check_loss(loss_module)
        self.loss_module = loss_module
        self.update_order: UpdateOrder = update_order
        self.max_grad_norm = max_grad_norm
        self.updates = 0
        share_actor(loss_module)
        self._watch = Watch(loss_module)
        self._watch.forget_copies()
        loss_module.register_load_state_dict_post_hook(loaded)
        self._names = trained_parameters(loss_module)
        self._params = params = self._present_parameters()
        device = params["actor"][0].device
        self.precision = resolve_precision(precision, device)
        self._device_type = device.type
        self.target_updater = SoftUpdate(loss_module, tau=tau)
        loss: Any = loss_module
        fixed = hasattr(loss, "log_alpha") and not params["alpha"]
        self._log_alpha = float(loss.log_alpha) if fixed else None
        self._skipped = torch.zeros((), device=device)
        self.optimizers: dict[str, torch.optim.Adam] = {}
        self._watch.look()
        self.use_backend(Backend)

    def use_backend(self, make_backend: Callable[..., Backend]) -> None:
        """Replace the backend, which evaluates networks and steps parameters; the optimisers keep their state.

        Args:
            make_backend: A subclass of `Backend`, or a function with the same arguments.
        """
        self._follow()
        states = {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()}
        self._make_backend = make_backend
        self.backend = make_backend(self.loss_module, self.precision, self.target_updater)
        self.optimizers = {
            name: self.backend.make_optimizer(name, group, self._rates[name], self._options["adam_eps"])
            for name, group in self._params.items()
            if group
        }
        for name, state in states.items():
            self.optimizers[name].load_state_dict(state)
        self._losses = loss_functions(self.loss_module)
        self._to_compile = self._options["compile"] and self.backend.compiles
        if self._options["compile"] and not self.backend.compiles:
            warnings.warn(
                "compile=True has no effect on hand-written passes: expected fast=off beside it", stacklevel=2
            )
        self._watch.look()

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Make one update.

        Args:
            batch: Transitions, batch shape `[B]` or `[B, n + 1]`. `td_error` is written into it.

        Returns:
            Detached scalars: `loss_actor`, `loss_qvalue`, `grad_norm_actor`, `grad_norm_critic` (before
            clipping), `td_error` (mean), and, as far as the loss provides them, `entropy`, `alpha` and
            `q_policy` (mean over the batch of the smaller value of the policy's own actions). They are tensors so
            that nothing waits for the device: call `.item()` when they are logged.

        Raises:
            NonFiniteLossError: If a loss or a gradient is infinite or NaN; on a GPU, if one was in an update since the
                last check. No weight has been changed by it.
        """
        self._follow()
        if self._to_compile:
            self._losses, self._to_compile = compiled(self._losses, self._device_type), False
        update = self._simultaneous if self.update_order == "simultaneous" else self._policy_first
        with self.backend.updating():
            metrics = update(batch)
        self.backend.move_targets()
        self.updates += 1
        if self.updates % CHECK_EVERY == 0:
            self.check_finite()
        if "entropy" in metrics and "alpha" in metrics:
            metrics["q_policy"] = -(metrics["loss_actor"] + metrics["alpha"] * metrics["entropy"])
        return metrics

    def scale_learning_rates(self, factor: float) -> None:
        """Set every learning rate to `factor` times the constructor's value."""
        for name, optimizer in self.optimizers.items():
            for group in optimizer.param_groups:
                group["lr"] = factor * self._rates[name]

    def scale_entropy_weight(self, factor: float) -> None:
        """Set a fixed entropy weight to `factor` times its value at construction.

        Raises:
            ValueError: If there is no fixed entropy weight and the factor is not 1.
        """
        if self._log_alpha is not None:
            cast(Tensor, self.loss_module.log_alpha).fill_(self._log_alpha + math.log(factor))
        elif factor != 1.0:
            raise ValueError("this loss has no fixed entropy weight to scale: leave train.anneal_entropy at 1")

    def check_finite(self) -> None:
        """Raise a `NonFiniteLossError` if a GPU skipped an update since the last check; this waits for the device."""
        found = float(self._skipped)
        self._skipped.zero_()
        if not math.isfinite(found):
            raise NonFiniteLossError(
                f"a loss or a gradient was not finite at or before update {self.updates}. {_ADVICE}"
            )

    def check_weights(self) -> None:
        """Raise a `NonFiniteError` if a parameter is not finite; updates keep finite parameters finite."""
        for name, value in self.loss_module.named_parameters():
            if not torch.isfinite(value).all():
                raise NonFiniteError(f"{name} contains NaN or infinity: start from other weights.")

    def state_dict(self) -> dict[str, Any]:
        """Return parameters, targets, optimiser states and the update counter, in the same format for every backend."""
        return {
            "loss_module": self.loss_module.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned, with the constructor's `adam_eps`, rates and fixed alpha."""
        self._follow()
        self.loss_module.load_state_dict(state["loss_module"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
            for group in optimizer.param_groups:
                group["eps"] = self._options["adam_eps"]
        self.scale_learning_rates(1.0)
        self.scale_entropy_weight(1.0)
        self.updates = int(state["updates"])
        self._skipped.zero_()

    def __deepcopy__(self, memo: dict[int, Any]) -> Learner:
        """Return a learner of a copy of the loss, with a copy of the state."""
        twin = type(self)(copy.deepcopy(self.loss_module, memo), **self._options)
        twin.use_backend(self._make_backend)
        twin._log_alpha = self._log_alpha  # the loss may hold a scaled one
        twin.load_state_dict(copy.deepcopy(self.state_dict(), memo))
        return twin

    def _present_parameters(self) -> dict[str, list[nn.Parameter]]:
        every = dict(self.loss_module.named_parameters())
        return {kind: [every[name] for name in names] for kind, names in self._names.items()}

    def _follow(self) -> None:
        """Continue with the parameters that the loss has now, in case they or their memory were replaced."""
        if not self._watch.changed():
            return
        adopt_actor(self.loss_module)
        self._watch.forget_copies()
        self._params = self._present_parameters()
        device = self._params["actor"][0].device
        if device.type != self._device_type:
            raise RuntimeError(
                f"the loss was moved to {device} after its learner was made for {self._device_type}: make a learner of "
                "the moved loss, and load this one's state_dict() into it"
            )
        self.backend.follow()
        for name, optimizer in self.optimizers.items():
            follow(optimizer, self._params[name])
        self._watch.look()

    def _step(self, losses: dict[str, Tensor], *names: str) -> dict[str, Tensor]:
        """Clip and step groups of parameters unless a number is not finite; return their gradients' norms before."""
        norms = {f"grad_norm_{name}": self.backend.gradient_norm(name, self._params[name]) for name in names}
        self._require_finite({**losses, **norms}, names)
        for name, norm in zip(names, norms.values(), strict=True):
            optimizer = self.optimizers[name]
            if self.max_grad_norm is not None and name != "alpha":
                torch.nn.utils.clip_grads_with_norm_(self._params[name], self.max_grad_norm, norm)
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        return norms

    def _require_finite(self, values: dict[str, Tensor], names: tuple[str, ...]) -> None:
        """Raise on a CPU, or let a GPU skip the step, if a loss or the norm of a gradient is not finite.

        The norms are checked because a rectifier can hide a NaN parameter from the losses, but not from the gradients.
        """
        if self._device_type != "cuda":
            found = {name: value.item() for name, value in values.items()}
            if bad := [f"{name} is {value}" for name, value in found.items() if not math.isfinite(value)]:
                for optimizer in self.optimizers.values():
                    optimizer.zero_grad(set_to_none=True)
                raise NonFiniteLossError(
                    f"{', '.join(bad)} at update {self.updates + 1}: no weight was changed by it. {_ADVICE}"
                )
            return
        total = torch.stack([value.detach().float() for value in values.values()]).sum()
        self._skipped.add_(total)  # once NaN or infinite, the sum stays so
        for name in names:  # fused Adam then changes nothing, and nothing waits for the device
            cast(Any, self.optimizers[name]).found_inf = (~total.isfinite()).float()

    def _simultaneous(self, batch: TensorDictBase) -> dict[str, Tensor]:
        trained = ["loss_actor", "loss_qvalue", *(["loss_alpha"] if self._params["alpha"] else [])]
        outputs = self.backend.both(self._losses, batch, trained)
        losses = {name: outputs[name] for name in trained}
        metrics = {key: outputs[key].detach() for key in ("loss_actor", "loss_qvalue", "alpha", "entropy")}
        norms = self._step(losses, *(name for name, group in self._params.items() if group))
        metrics |= {key: norms[key] for key in ("grad_norm_actor", "grad_norm_critic")}
        metrics["td_error"] = batch.get("td_error").mean()
        return metrics | _critic_health(outputs)

    def _policy_first(self, batch: TensorDictBase) -> dict[str, Tensor]:
        metrics = self._update_actor(batch)
        loss_qvalue, extra = self.backend.critic(self._losses, batch)
        metrics["loss_qvalue"] = loss_qvalue.detach()
        metrics |= self._step({"loss_qvalue": loss_qvalue}, "critic")
        batch.set("td_error", extra["td_error"])
        metrics["td_error"] = extra["td_error"].mean()
        return metrics | _critic_health(extra)

    def _update_actor(self, batch: TensorDictBase) -> dict[str, Tensor]:
        loss_actor, extra = self.backend.actor(self._losses, batch)
        metrics = {"loss_actor": loss_actor.detach(), **self._step({"loss_actor": loss_actor}, "actor")}
        loss: Any = self.loss_module
        if "log_prob" in extra:
            log_prob = extra["log_prob"]
            metrics["entropy"] = -log_prob.mean()
            metrics["alpha"] = loss.log_alpha.detach().exp()
            if self._params["alpha"]:
                loss_alpha = loss.alpha_loss(log_prob).mean()
                loss_alpha.backward()
                self._step({"loss_alpha": loss_alpha}, "alpha")
        return metrics


def _critic_health(outputs: Any) -> dict[str, Tensor]:
    """Return the share of targets outside a categorical critic's support, or an empty dictionary."""
    clipped = outputs.get("clipped_fraction", None)
    return {} if clipped is None else {"clipped_fraction": clipped.mean()}
