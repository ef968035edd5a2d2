"""Every loss learns to echo the style, for every kind of action that it serves."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type
from torchrl.objectives import LossModule, SACLoss

from coachable.distributions.action_heads import ActionHeads
from coachable.losses import CategoricalSACLoss, CatRACLoss, QRSACLoss, RACLoss
from coachable.networks import make_critic
from coachable.networks.hl_gauss_critic import make_hl_gauss_critic
from coachable.networks.mixed import make_mixed_actor
from coachable.networks.residual import ResidualBlock
from coachable.training import Learner
from tests.style_echo import HEADS, LEVELS, echo_space, levels_and_axes, make_style_echo_env

# A relaxed policy query follows the critic's slope at a corner of the simplex, where hard actions alone have trained
# it. In layers this narrow layer norm bends the slope of scalar critics away from the difference between corners;
# with categorical critics it is the entropy that keeps the policy off a corner until they know better.
SCALAR, BINNED = (64, 64), (32, 32)
BINS: dict[str, Any] = {"v_min": -6.0, "v_max": 2.0, "num_atoms": 41}
# name: loss, critics, options, update order
LOSSES: dict[str, tuple[Callable[..., LossModule], Callable[..., Any], dict[str, Any], str]] = {
    "sac": (SACLoss, make_critic, {"loss_function": "l2", "fixed_alpha": True, "alpha_init": 0.05}, "simultaneous"),
    "qr_sac": (QRSACLoss, make_critic, {"num_quantiles": 16, "alpha": 0.05}, "policy_first"),
    "rac": (RACLoss, make_critic, {"entropy_samples": 50, "alpha": 0.05}, "policy_first"),
    "cat_rac": (CatRACLoss, make_hl_gauss_critic, {"entropy_samples": 50, "alpha": 0.2, **BINS}, "policy_first"),
    "sac_categorical": (CategoricalSACLoss, make_hl_gauss_critic, {"alpha": 0.2, **BINS}, "policy_first"),
}
ONLY_AXES = ("sac", "qr_sac")
UPDATES = {"sac": 90, "qr_sac": 90, "rac": 200, "cat_rac": 300, "sac_categorical": 300}
# Mixed actions have both kinds of component: where a loss serves them, actions of one kind are left to the slow tests.
SERVED = [
    pytest.param(loss, kind, marks=() if loss in ONLY_AXES or kind == "mixed" else pytest.mark.slow)
    for loss in LOSSES
    for kind in HEADS
    if kind == "continuous" or loss not in ONLY_AXES
]
# Mean |a - style| of the deterministic policy over styles in [-1, 1]: always 0 errs by 0.5, the nearest of the three
# levels by 0.25.
THRESHOLD = {"level": 0.32, "axis": 0.15}


def train(name: str, heads: ActionHeads, updates: int, seed: int = 0) -> Any:
    torch.manual_seed(seed)
    kind, make, options, order = LOSSES[name]
    space = echo_space(heads)
    critic_options: dict[str, Any] = {}
    widths, rate = SCALAR, 3e-3
    if make is make_hl_gauss_critic:
        critic_options, widths, rate = BINS, BINNED, 5e-3
    elif "num_quantiles" in options:
        critic_options = {"num_outputs": options["num_quantiles"]}
    actor = make_mixed_actor(1, heads, space, widths)
    critics = [make(1, heads.action_dim, space, widths, **critic_options) for _ in range(2)]
    if widths is SCALAR:
        for block in [part for net in (actor, *critics) for part in net.modules() if isinstance(part, ResidualBlock)]:
            block.norm = nn.Identity()
    loss = kind(actor, critics, **options)
    loss.make_value_estimator(gamma=0.5)
    learner = Learner(
        loss, actor_lr=rate, critic_lr=rate, tau=0.05, max_grad_norm=10.0, update_order=order, precision="fp32"
    )
    env = make_style_echo_env(heads, num_envs=64, seed=seed)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(4096), batch_size=128)
    state = env.reset()
    for _ in range(updates):
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            state = actor(state)
        step, state = env.step_and_maybe_reset(state)
        replay.extend(step.select("observation", "style", "action", "next"))
        learner.update(replay.sample())
    return actor


def answers(actor: Any, heads: ActionHeads) -> tuple[Tensor, Tensor]:
    """Styles on a grid, the same for every component, and what the deterministic policy says to them."""
    styles = torch.linspace(-1, 1, 41)[:, None].expand(-1, len(heads.categorical) + heads.axes)
    observation = torch.full((41, 1), 0.5)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        out = actor(TensorDict({"observation": observation, "style": styles}, [41]))
    return styles, levels_and_axes(out["action"], heads)


@pytest.mark.parametrize(("name", "kind"), SERVED)
def test_learns_to_echo(name: str, kind: str) -> None:
    heads = HEADS[kind]
    actor = train(name, heads, UPDATES[name])
    styles, said = answers(actor, heads)
    error = (said - styles).abs().mean(0)
    components = ["level"] * len(heads.categorical) + ["axis"] * heads.axes
    for i, component in enumerate(components):
        assert error[i] < THRESHOLD[component], f"{component}: {error[i]:.3f}"
        # The output rises with the style.
        correlation = torch.corrcoef(torch.stack((styles[:, i], said[:, i])))[0, 1]
        assert correlation > 0.9
        low, high = said[:10, i].mean(), said[-10:, i].mean()
        assert low < -0.5 < 0.5 < high


@pytest.mark.parametrize("kind", list(HEADS))
def test_environment(kind: str) -> None:
    heads = HEADS[kind]
    env = make_style_echo_env(heads, num_envs=3)
    check_env_specs(env)
    rollout = env.rollout(6, break_when_any_done=False)
    distance = (levels_and_axes(rollout["action"], heads) - rollout["style"]).abs().sum(-1, keepdim=True)
    torch.testing.assert_close(rollout["next", "reward"], -distance)
    assert rollout["next", "truncated"][:, 3].all() and not rollout["next", "terminated"].any()
    best = heads.from_choices(torch.tensor([LEVELS - 1] * len(heads.categorical)), torch.ones(heads.axes))
    assert (levels_and_axes(best, heads) == 1).all()
