"""One gradient update of an actor-critic loss: update order, optimisers, target networks, precision."""

from __future__ import annotations

import copy
import logging
import math
import os
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Literal, NamedTuple, cast, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule, SoftUpdate

from coachable.fast.accelerate import Acceleration
from coachable.fast.flat_adam import FlatAdam, place_moments
from coachable.finite import NonFiniteError
from coachable.ranges import AMOUNT, NOT_NEGATIVE, POSITIVE, SHARE, Range
from coachable.training.lean_sac import LeanSAC
from coachable.training.parameters import Watch, adopt_actor, follow, loaded, share_actor, trained_parameters
from coachable.training.precision import Precision, resolve_precision

_LOG = logging.getLogger(__name__)

_ADVICE = "Look for extreme rewards or observations, lower the learning rates, or set max_grad_norm."

UpdateOrder = Literal["simultaneous", "policy_first", "critic_first"]


class NonFiniteLossError(NonFiniteError):
    """A loss or a gradient became infinite or NaN."""


class _Losses(NamedTuple):
    both: Callable[..., Any]
    actor: Callable[..., Any]
    critic: Callable[..., Any]


class Learner:
    """Update a TorchRL actor-critic loss module from batches.

    Works with `SACLoss` and its relatives (QR-SAC, RAC, Cat-RAC): any `LossModule` with `actor_network_params`,
    `qvalue_network_params`, their targets, and `loss_actor` and `loss_qvalue` among its outputs.

    Update orders (algorithms.md, sections 1 and 2):

    - `"simultaneous"` (the paper's humanoid): both losses from the parameters before the update, then both
      optimisers step, then the target networks move.
    - `"policy_first"` (the paper's racing and combat): the policy steps on `actor_loss`, then the critics on a
      target whose next actions come from the updated policy.
    - `"critic_first"` (common elsewhere): the critics step, then the policy on the updated critics.

    Losses or gradients that are infinite or NaN reach no weight: such an update raises on a CPU, and is left out on a
    GPU until the next check raises (see `check_every`).

    Args:
        loss_module: The loss.
        actor_lr: Learning rate of the policy.
        critic_lr: Learning rate of everything else that is trained, the temperature excepted.
        alpha_lr: Learning rate of a learned temperature; unused with `fixed_alpha=True`.
        adam_eps: Adam's epsilon (1e-7 as in TensorFlow, not torch's 1e-8).
        tau: Polyak rate of the target networks per update.
        max_grad_norm: Clip the norm of the policy's and of the critics' gradient, each on its own, to this value.
        update_order: See above.
        precision: `"bf16"` multiplies in bfloat16 with float32 master weights, layer-norm statistics, heads, targets
            and losses; `"auto"` takes it where the device has it in hardware.
        fused: Evaluate residual networks through their hand-written passes (`coachable.fast.fused`) where possible:
            on a CPU, when policy and critics consist of nothing else. The numbers are the same, the update is faster.
        compile: Compile the loss functions with `torch.compile` where `fused` does not apply (on a GPU, or with
            networks of other kinds). On a CPU that takes a C++ compiler; without one the log says that it was left.
        check_every: On a GPU, ask every so many updates whether one was left out, which waits for the device; 0 leaves
            that to calls of :meth:`check_finite`. On a CPU every update is checked.

    Between updates the loss and its policy may be moved to shared memory, cast to another dtype, loaded with
    `assign=True` or given other `.data`; an update trains the parameters that they have then.

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
        fused: bool = True,
        compile: bool = False,
        check_every: int = 100,
    ) -> None:
        self._options = {name: value for name, value in locals().items() if name not in ("self", "loss_module")}
        if update_order not in get_args(UpdateOrder):
            raise ValueError(f"update_order must be one of {get_args(UpdateOrder)}, got {update_order!r}")
        rates = {"actor": actor_lr, "critic": critic_lr, "alpha": alpha_lr}
        for name, rate in rates.items():
            NOT_NEGATIVE.check(f"{name}_lr", rate)
        POSITIVE.check("adam_eps", adam_eps)
        Range("(0, 1]").check("tau", tau)
        Range("(0, inf)", optional=True).check("max_grad_norm", max_grad_norm)
        AMOUNT.check("check_every", check_every)
        _check_loss(loss_module)
        self.loss_module = loss_module
        self.update_order: UpdateOrder = update_order
        self.max_grad_norm = max_grad_norm
        self.check_every = check_every
        self.updates = 0
        self.tau = tau
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
        self._acceleration: Acceleration | None = None
        self._lean: LeanSAC | None = None
        if fused and Acceleration.supports(loss_module):
            self._acceleration = Acceleration(loss_module, torch.bfloat16 if self.precision == "bf16" else None)
            if LeanSAC.supports(loss_module):
                self._lean = LeanSAC(loss_module, self._acceleration)
        self.optimizers: dict[str, torch.optim.Adam] = {
            name: self._adam(name, group, rates[name], adam_eps) for name, group in params.items() if group
        }
        self._rates = rates
        loss: Any = loss_module
        fixed = hasattr(loss, "log_alpha") and not params["alpha"]
        self._log_alpha = float(loss.log_alpha) if fixed else None
        self._losses = _Losses(loss.forward, loss.actor_loss, _critic_loss_of(loss))
        if compile and self._acceleration is None and _can_compile(device):
            self._losses = _Losses(*map(torch.compile, self._losses))
        self._left_out = torch.zeros((), device=device)
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
            NonFiniteLossError: If a loss or a gradient is infinite or NaN (on a GPU: was, see `check_every`); no weight
                has been changed by it.
        """
        self._follow()
        losses = self._losses
        if self._lean is not None and self._lean.serves(batch):
            losses = _Losses(self._lean.forward, self._lean.actor_loss, self._lean.critic_loss)
        update = self._simultaneous if self.update_order == "simultaneous" else self._sequential
        with self._networks():
            metrics = update(batch, losses)
        if self._acceleration is None:
            self.target_updater.step()
        self.updates += 1
        if self.check_every and self.updates % self.check_every == 0:
            self.check_finite()
        if "entropy" in metrics and "alpha" in metrics:
            metrics["q_policy"] = -(metrics["loss_actor"] + metrics["alpha"] * metrics["entropy"])
        return metrics

    def scale_learning_rates(self, factor: float) -> None:
        """Set every learning rate to `factor` times what the constructor was given."""
        for name, optimizer in self.optimizers.items():
            for group in optimizer.param_groups:
                group["lr"] = factor * self._rates[name]

    def scale_entropy_weight(self, factor: float) -> None:
        """Set a fixed entropy weight to `factor` times what it was at construction.

        Raises:
            ValueError: if there is no fixed entropy weight and the factor is not 1.
        """
        if self._log_alpha is not None:
            cast(Tensor, self.loss_module.log_alpha).fill_(self._log_alpha + math.log(factor))
        elif factor != 1.0:
            raise ValueError("this loss has no fixed entropy weight to scale: leave train.anneal_entropy at 1")

    def check_finite(self) -> None:
        """Raise if an update since the last check was left out on a GPU (this reads one number from the device)."""
        found = float(self._left_out)
        self._left_out.zero_()
        if not math.isfinite(found):
            raise NonFiniteLossError(
                f"a loss or a gradient was not finite at or before update {self.updates}. {_ADVICE}"
            )

    def check_weights(self) -> None:
        """Raise if a trained parameter is not finite; updates keep those finite that are."""
        for name, value in self.loss_module.named_parameters():
            if not torch.isfinite(value).all():
                raise NonFiniteError(f"{name} contains NaN or infinity: start from other weights.")

    def state_dict(self) -> dict[str, Any]:
        """Parameters, targets, optimiser moments and the update counter."""
        return {
            "loss_module": self.loss_module.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned; rates and a fixed entropy weight stay those of the constructor."""
        self._follow()
        self.loss_module.load_state_dict(state["loss_module"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
            if self._device_type == "cpu" and not isinstance(optimizer, FlatAdam):
                place_moments(optimizer)
        self.scale_learning_rates(1.0)
        self.scale_entropy_weight(1.0)
        self.updates = int(state["updates"])
        self._left_out.zero_()

    def __deepcopy__(self, memo: dict[int, Any]) -> Learner:
        """A learner of a copy of the loss, with a copy of the state."""
        twin = type(self)(copy.deepcopy(self.loss_module, memo), **self._options)
        twin.load_state_dict(copy.deepcopy(self.state_dict(), memo))
        return twin

    def _present_parameters(self) -> dict[str, list[nn.Parameter]]:
        """The trained parameters that the loss has now."""
        every = dict(self.loss_module.named_parameters())
        return {kind: [every[name] for name in names] for kind, names in self._names.items()}

    def _follow(self) -> None:
        """Go on with the loss's parameters as they are now: others may be in their place, or other memory in theirs."""
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
        if self._acceleration is not None:
            self._acceleration.bind()
        for name, optimizer in self.optimizers.items():
            follow(optimizer, self._params[name])
        self._watch.look()

    def _adam(self, name: str, params: list[nn.Parameter], lr: float, eps: float) -> torch.optim.Adam:
        acceleration = self._acceleration
        if acceleration is not None and name != "alpha":
            flat, target = acceleration.buffers(name)
            return FlatAdam(params, flat, target, self.tau, lr=lr, eps=eps)
        optimizer = torch.optim.Adam(params, lr=lr, eps=eps, fused=self._device_type in ("cpu", "cuda"))
        if self._device_type == "cpu":
            place_moments(optimizer)
        return optimizer

    def _networks(self) -> AbstractContextManager[None]:
        return nullcontext() if self._acceleration is None else self._acceleration.active()

    def _autocast(self) -> AbstractContextManager[Any]:
        if self.precision == "fp32" or self._acceleration is not None:
            return nullcontext()
        return torch.autocast(self._device_type, dtype=torch.bfloat16)

    def _step(self, losses: dict[str, Tensor], *names: str) -> dict[str, Tensor]:
        """Clip and step, unless a number is not finite; return the norms of the gradients before clipping.

        Args:
            losses: What the gradients are of, by name.
            names: Groups of parameters to step on their gradients.
        """
        norms = {f"grad_norm_{name}": self._gradient_norm(name) for name in names}
        self._require_finite({**losses, **norms}, names)
        for name, norm in zip(names, norms.values(), strict=True):
            optimizer = self.optimizers[name]
            if self.max_grad_norm is not None and name != "alpha":
                torch.nn.utils.clip_grads_with_norm_(self._params[name], self.max_grad_norm, norm)
            optimizer.step()
            if not isinstance(optimizer, FlatAdam):
                optimizer.zero_grad(set_to_none=True)
        return norms

    def _gradient_norm(self, name: str) -> Tensor:
        if isinstance(self.optimizers[name], FlatAdam):
            return torch.linalg.vector_norm(cast(Acceleration, self._acceleration).gradient(name))
        return torch.nn.utils.get_total_norm([p.grad for p in self._params[name] if p.grad is not None])

    def _require_finite(self, values: dict[str, Tensor], names: tuple[str, ...]) -> None:
        """Raise on a CPU, or let a GPU leave the step out, if a loss or the norm of a gradient is not finite.

        The norms are in it because a NaN parameter can hide behind a rectifier in the losses, but not in the gradients.
        """
        if self._device_type != "cuda":
            found = {name: value.item() for name, value in values.items()}
            if bad := [f"{name} is {value}" for name, value in found.items() if not math.isfinite(value)]:
                for optimizer in self.optimizers.values():
                    if not isinstance(optimizer, FlatAdam):  # whose gradients are written anew, not added to
                        optimizer.zero_grad(set_to_none=True)
                raise NonFiniteLossError(
                    f"{', '.join(bad)} at update {self.updates + 1}: no weight was changed by it. {_ADVICE}"
                )
            return
        total = torch.stack([value.detach().float() for value in values.values()]).sum()
        self._left_out.add_(total)  # a sum stays NaN or infinite once a part was
        for name in names:  # the fused Adam of a GPU then changes nothing, without waiting for the device
            cast(Any, self.optimizers[name]).found_inf = (~total.isfinite()).float()

    def _simultaneous(self, batch: TensorDictBase, functions: _Losses) -> dict[str, Tensor]:
        with self._autocast():
            outputs = functions.both(batch)
        trained = ["loss_actor", "loss_qvalue", *(["loss_alpha"] if self._params["alpha"] else [])]
        losses = {name: outputs[name] for name in trained}
        cast(Tensor, sum(losses.values())).backward()
        metrics = {key: outputs[key].detach() for key in ("loss_actor", "loss_qvalue", "alpha", "entropy")}
        norms = self._step(losses, *(name for name, group in self._params.items() if group))
        metrics |= {key: norms[key] for key in ("grad_norm_actor", "grad_norm_critic")}
        metrics["td_error"] = batch.get("td_error").mean()
        return metrics | _critic_health(outputs)

    def _sequential(self, batch: TensorDictBase, functions: _Losses) -> dict[str, Tensor]:
        policy_first = self.update_order == "policy_first"
        metrics = self._update_actor(batch, functions) if policy_first else {}
        with self._autocast():
            loss_qvalue, extra = functions.critic(batch)
        loss_qvalue.backward()
        metrics["loss_qvalue"] = loss_qvalue.detach()
        metrics |= self._step({"loss_qvalue": loss_qvalue}, "critic")
        batch.set("td_error", extra["td_error"])
        metrics["td_error"] = extra["td_error"].mean()
        if not policy_first:
            metrics |= self._update_actor(batch, functions)
        return metrics | _critic_health(extra)

    def _update_actor(self, batch: TensorDictBase, functions: _Losses) -> dict[str, Tensor]:
        with self._autocast():
            loss_actor, extra = functions.actor(batch)
        loss_actor.backward()
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
    """Share of targets outside a categorical critic's support; empty for other critics."""
    clipped = outputs.get("clipped_fraction", None)
    return {} if clipped is None else {"clipped_fraction": clipped.mean()}


def _check_loss(loss_module: LossModule) -> None:
    """Refuse what TorchRL's losses let pass: a discount outside [0, 1], the logarithm of a negative entropy weight."""
    gamma = getattr(getattr(loss_module, "_value_estimator", None), "gamma", None)
    if gamma is not None:
        SHARE.check("gamma of the loss", float(gamma))
    log_alpha = getattr(loss_module, "log_alpha", None)
    if log_alpha is not None and bool(torch.isnan(log_alpha)):
        raise ValueError("alpha of the loss is below 0: expected a number of at least 0")


def _can_compile(device: torch.device) -> bool:
    if device.type != "cpu" or any(shutil.which(c) for c in (os.environ.get("CXX"), "g++", "clang++") if c):
        return True
    _LOG.warning("compile=True has no effect: torch.compile needs a C++ compiler on a CPU (g++ or clang++, or set CXX)")
    return False


def _critic_loss_of(loss_module: LossModule) -> Callable[..., Any]:
    for name in ("qvalue_loss", "qvalue_v2_loss"):
        method = getattr(loss_module, name, None)
        if method is not None:
            return method
    raise ValueError(
        f"{type(loss_module).__name__} has neither qvalue_loss(td) nor qvalue_v2_loss(td) returning (loss, metadata)"
    )
