"""One description per loss of what the contract suite needs, and networks that return constants."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import LossModule, SACLoss

from coachable.distributions.action_heads import ActionHeads
from coachable.distributions.mixed_action import MixedAction
from coachable.losses import CategoricalSACLoss, CatRACLoss, QRSACLoss, RACLoss
from coachable.networks import make_critic
from coachable.networks.hl_gauss_critic import make_hl_gauss_critic
from coachable.networks.mixed import make_mixed_actor

OBS, THETA = 5, 2
AXES = ActionHeads(axes=2)
BUTTONS = ActionHeads(categorical=(3, 2))
MIXED = ActionHeads(categorical=(3, 2), axes=2)
HEADS = {"axes": AXES, "categorical": BUTTONS, "mixed": MIXED}
# Eleven atoms 0, 2, .. 20, so that constant values are atoms.
BINS = {"v_min": -1.0, "v_max": 21.0, "num_atoms": 11}
NO_ENTROPY = 1e-30  # an entropy weight that rounds away


class PlainSpace:
    """What a network needs of a style space."""

    dim = THETA

    def encode(self, theta: Tensor) -> Tensor:
        return theta


@dataclass(frozen=True)
class Case:
    """A loss, the actions it serves, and how many outputs its critics have."""

    name: str
    build: Callable[..., LossModule]
    heads: tuple[str, ...]
    critic_width: int
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def ours(self) -> bool:
        return self.name != "SAC"

    def constant_output(self, value: float) -> Tensor:
        """Critic output that means `value`."""
        if self.critic_width == BINS["num_atoms"]:
            logits = torch.zeros(self.critic_width, dtype=torch.float64)
            logits[round(value / 2)] = 100.0  # the other atoms weigh e^-100
            return logits
        return torch.full((self.critic_width,), value, dtype=torch.float64)

    def critic(self, heads: ActionHeads, widths: Sequence[int] = (16, 16)) -> nn.Module:
        if self.critic_width == BINS["num_atoms"]:
            return make_hl_gauss_critic(OBS, heads.action_dim, PlainSpace(), widths, initial_value=10.0, **BINS)  # type: ignore[arg-type]
        return make_critic(OBS, heads.action_dim, PlainSpace(), widths, num_outputs=self.critic_width)

    def loss(self, heads: ActionHeads, *, gamma: float = 0.9, alpha: float = 0.1, **options: Any) -> LossModule:
        """The loss with small real networks."""
        actor = make_mixed_actor(OBS, heads, PlainSpace(), (16, 16))
        return self.wrap(actor, [self.critic(heads), self.critic(heads)], gamma=gamma, alpha=alpha, **options)

    def wrap(
        self, actor: nn.Module, critics: list[Any], *, gamma: float = 0.9, alpha: float = 0.1, **options: Any
    ) -> LossModule:
        if not self.ours:
            options = {
                "alpha_init": alpha,
                "fixed_alpha": True,
                "loss_function": "l2",
                "target_entropy": 0.0,
                **options,
            }
        else:
            options = {"alpha": alpha, **options}
        loss = self.build(actor, critics, **{**self.options, **options})
        loss.make_value_estimator(gamma=gamma)
        return loss


CASES = [
    Case("SAC", SACLoss, ("axes",), 1),
    Case("QR-SAC", QRSACLoss, ("axes",), 4, {"num_quantiles": 4}),
    Case("RAC", RACLoss, ("axes", "categorical", "mixed"), 1, {"entropy_samples": 20}),
    Case("Cat-RAC", CatRACLoss, ("axes", "categorical", "mixed"), 11, {"entropy_samples": 20, **BINS}),
    Case("cat-SAC", CategoricalSACLoss, ("axes", "categorical", "mixed"), 11, BINS),
]
OURS = [case for case in CASES if case.ours]
OWN = pytest.mark.parametrize("case", OURS, ids=lambda c: c.name)


class ConstantCritic(nn.Module):
    """Ignores its inputs."""

    def __init__(self, output: Tensor) -> None:
        super().__init__()
        self.output = nn.Parameter(output.clone())

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.output.expand(*action.shape[:-1], -1) + 0.0 * action[..., :1]


class ConstantPolicy(nn.Module):
    """Emits the same distribution in every state."""

    def __init__(self, parameters: dict[str, Tensor]) -> None:
        super().__init__()
        self.names = list(parameters)  # nn.ParameterDict sorts
        self.emitted = nn.ParameterDict(parameters)

    def forward(self, observation: Tensor) -> tuple[Tensor, ...]:
        return tuple(p.expand(*observation.shape[:-1], -1) for p in (self.emitted[n] for n in self.names))


def constant_actor(heads: ActionHeads, **parameters: Tensor) -> ProbabilisticActor:
    """Actor whose distribution parameters (probs, loc, scale) are given."""
    names: list[Any] = list(parameters)
    return ProbabilisticActor(
        TensorDictModule(ConstantPolicy(parameters), in_keys=["observation"], out_keys=names),
        in_keys=names,
        spec=heads.spec(),
        distribution_class=MixedAction,
        distribution_kwargs={"heads": heads},
    )


def constant_loss(case: Case, values: Sequence[float] = (10.0, 8.0), **options: Any) -> LossModule:
    """The loss on two axes with constant critics (of float64) and a standard normal policy before the tanh."""
    zeros, ones = torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    critics = [
        TensorDictModule(
            ConstantCritic(case.constant_output(v)), in_keys=["observation", "action"], out_keys=["state_action_value"]
        )
        for v in values
    ]
    return case.wrap(constant_actor(AXES, loc=zeros, scale=ones), critics, **options)


def make_batch(
    heads: ActionHeads, shape: Sequence[int] = (6,), dtype: torch.dtype = torch.float32, seed: int = 0
) -> TensorDict:
    """Transitions, some of them terminated, some truncated."""
    torch.manual_seed(seed)

    def state() -> dict[str, Tensor]:
        return {"observation": torch.randn(*shape, OBS, dtype=dtype), "style": torch.randn(*shape, THETA, dtype=dtype)}

    terminated = torch.rand(*shape, 1) < 0.3
    truncated = (torch.rand(*shape, 1) < 0.3) & ~terminated
    after = {
        **state(),
        "reward": torch.randn(*shape, 1, dtype=dtype) + 5,
        "terminated": terminated,
        "truncated": truncated,
        "done": terminated | truncated,
    }
    return TensorDict({**state(), "action": heads.spec(shape).rand().to(dtype), "next": after}, batch_size=list(shape))


def end_all(batch: TensorDict) -> TensorDict:
    """Mark every step terminated, so that the target is the reward and no noise enters the critic loss."""
    for key in ("terminated", "done"):
        batch["next", key] = torch.ones_like(batch["next", key])
    return batch


def gradients(loss: LossModule, prefix: str) -> list[Tensor]:
    """Gradients of the parameters whose names start with `prefix`, zeros for none."""
    return [
        torch.zeros_like(p) if p.grad is None else p.grad
        for name, p in loss.named_parameters()
        if name.startswith(prefix)
    ]


def critic_loss(loss: LossModule, batch: TensorDict) -> tuple[Tensor, dict[str, Tensor]]:
    """The critic part, whatever it is called."""
    return getattr(loss, "qvalue_loss" if hasattr(loss, "qvalue_loss") else "qvalue_v2_loss")(batch)
