import copy
import pickle

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coachable.distributions.action_heads import ActionHeads, MixedActionSpec
from coachable.distributions.mixed_action import MixedAction
from coachable.networks.mixed import MixedPolicy, make_mixed_actor

F64 = torch.float64
GAMEPAD = ActionHeads(categorical=(4, 6, 3, 3, 2, 2), axes=4)
AXES = ActionHeads(axes=2)
BUTTONS = ActionHeads(categorical=(3, 2))
ALL = pytest.mark.parametrize("heads", [GAMEPAD, AXES, BUTTONS], ids=["mixed", "axes", "categorical"])


class TwiceStyle:
    dim = 3

    def encode(self, theta: torch.Tensor) -> torch.Tensor:
        return 2 * theta


def observations(shape: tuple[int, ...]) -> TensorDict:
    return TensorDict({"observation": torch.randn(*shape, 5), "style": torch.randn(*shape, 3)}, shape)


def distribution(heads: ActionHeads, shape: tuple[int, ...] = ()) -> MixedAction:
    probs = torch.rand(*shape, heads.num_categorical, dtype=F64) + 0.05
    if heads.categorical:
        probs = torch.cat([p / p.sum(-1, keepdim=True) for p in probs.split(heads.categorical, -1)], -1)
    loc, scale = torch.randn(*shape, heads.axes, dtype=F64), torch.rand(*shape, heads.axes, dtype=F64) + 0.2
    return MixedAction(
        probs if heads.categorical else None,
        loc if heads.axes else None,
        scale if heads.axes else None,
        heads=heads,
    )


def test_dimensions_of_the_gamepad() -> None:
    assert (GAMEPAD.num_categorical, GAMEPAD.action_dim, GAMEPAD.num_parameters) == (20, 24, 28)
    assert MixedPolicy(5, GAMEPAD, None, (8,)).trunk.out_features == 28


def test_choices_round_trip() -> None:
    choices = torch.tensor([[3, 5, 2, 0, 1, 0], [0, 0, 0, 0, 0, 0]])
    axes = torch.tensor([[0.1, -1.0, 0.5, 1.0], [0.0, 0.0, 0.0, 0.0]])
    action = GAMEPAD.from_choices(choices, axes)
    assert torch.equal(GAMEPAD.choices(action), choices) and torch.equal(GAMEPAD.split(action)[1], axes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "at least one categorical head or one axis"),
        ({"axes": -1}, "axes must not be negative"),
        ({"categorical": (3, 1)}, "at least 2 values"),
    ],
)
def test_bad_heads(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ActionHeads(**arguments)


@ALL
def test_spec_draws_valid_actions(heads: ActionHeads) -> None:
    torch.manual_seed(0)
    spec = heads.spec((3,))
    action = spec.rand((500,))
    assert action.shape == (500, 3, heads.action_dim) and spec.expand(500, 3, heads.action_dim).is_in(action)
    one_hots, axes = heads.split(action)
    for part, size in zip(one_hots.split(heads.categorical, -1), heads.categorical, strict=True):
        share = part.mean((0, 1))
        assert ((share - 1 / size).abs() < 5 * (1 / size / 1500) ** 0.5).all()
    assert axes.numel() == 0 or (axes.min() < -0.9 and axes.max() > 0.9)


@pytest.mark.parametrize("heads", [GAMEPAD, BUTTONS], ids=["mixed", "categorical"])
def test_spec_of_one_tensor(heads: ActionHeads) -> None:
    spec = heads.spec((2, 3))
    assert isinstance(spec, MixedActionSpec)
    good = spec.rand()
    assert spec.is_in(good) and not spec.is_in(good[0]) and not spec.is_in(good.double())
    relaxed = good.clone()
    relaxed[0, 0, :2] = 0.5
    two = good.clone()
    two[1, 1, : heads.categorical[0]] = 1.0
    assert not spec.is_in(relaxed) and not spec.is_in(two) and not spec.is_in(torch.zeros_like(good))
    projected = spec.project(torch.randn(2, 3, heads.action_dim) * 3)
    assert spec.is_in(projected)
    assert torch.equal(spec.project(good), good)
    if heads.axes:
        outside = good.clone()
        outside[..., -1] = 1.5
        assert not spec.is_in(outside)
    n = heads.action_dim
    for changed, shape in (
        (spec.unsqueeze(0), (1, 2, 3, n)),
        (spec.unsqueeze(0).squeeze(0), (2, 3, n)),
        (spec.expand(5, 2, 3, n), (5, 2, 3, n)),
        (spec[0], (3, n)),
        (spec.reshape(6, n), (6, n)),
        (spec.reshape(6, n).unflatten(0, (2, 3)), (2, 3, n)),
        (spec.flatten(0, 1), (6, n)),
        (spec.unbind(0)[1], (3, n)),
        (spec.clone(), (2, 3, n)),
        (copy.deepcopy(spec), (2, 3, n)),
        (pickle.loads(pickle.dumps(spec)), (2, 3, n)),
        (spec.to("cpu"), (2, 3, n)),
    ):
        assert isinstance(changed, MixedActionSpec) and changed.shape == shape and changed.is_in(changed.rand())
    assert spec.clone() == spec != heads.spec((3,)) and spec.to(F64).rand().dtype == F64
    assert spec.to(F64) != spec and spec.to("meta") != spec and spec != "spec"
    assert Composite(action=spec, shape=(2,))["action"] == spec
    with pytest.raises(ValueError, match="last dimension"):
        spec.reshape(-1)
    with pytest.raises(ValueError, match="cannot unbind"):
        spec.unbind(-1)


def test_spec_enumerates_buttons() -> None:
    spec = BUTTONS.spec()
    every = spec.enumerate()
    assert every.shape == (6, 5) == (spec.cardinality(), 5) and len(every.unique(dim=0)) == 6
    assert GAMEPAD.spec().cardinality() == float("inf")
    with pytest.raises(NotImplementedError):
        GAMEPAD.spec().enumerate()


def test_axes_alone_have_a_plain_box() -> None:
    spec = AXES.spec((4,))
    assert isinstance(spec, Bounded) and spec.shape == (4, 2)


@ALL
@pytest.mark.parametrize("shape", [(4,), (4, 3)])
def test_actor_writes_one_action(heads: ActionHeads, shape: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    actor = make_mixed_actor(5, heads, TwiceStyle(), (16, 16))
    td = observations(shape)
    with set_exploration_type(ExplorationType.RANDOM):
        first, second = actor(td.clone())["action"], actor(td.clone())["action"]
    assert first.shape == (*shape, heads.action_dim) and not torch.equal(first, second)
    assert heads.spec(shape).is_in(first.detach())  # hard one-hots, axes in the box
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        quiet = actor(td.clone())
    assert heads.spec(shape).is_in(quiet["action"].detach())
    if heads.axes:
        torch.testing.assert_close(heads.split(quiet["action"])[1], torch.tanh(quiet["loc"]))
    if heads.categorical:
        best = [p.argmax(-1) for p in quiet["probs"].split(heads.categorical, -1)]
        assert torch.equal(heads.choices(quiet["action"]), torch.stack(best, -1))


def test_actor_encodes_the_style() -> None:
    policy = MixedPolicy(5, AXES, TwiceStyle(), (16,))
    observation, theta = torch.randn(7, 5), torch.randn(7, 3)
    raw = policy.trunk(torch.cat((observation, 2 * theta), -1))
    loc, scale = policy(observation, theta)
    torch.testing.assert_close(loc, raw[:, :2])
    torch.testing.assert_close(scale, torch.exp(2 * torch.tanh(raw[:, 2:])))
    with pytest.raises(ValueError, match="conditioned on a style"):
        policy(observation)


def test_deterministic_axes_reach_their_bounds() -> None:
    torch.manual_seed(0)
    policy = MixedPolicy(5, AXES, None, (16,))
    assert MixedAction(None, *policy(100 * torch.randn(50, 5)), heads=AXES).mode.abs().max() > np.tanh(1)


@ALL
def test_log_prob_of_hard_samples(heads: ActionHeads) -> None:
    torch.manual_seed(0)
    pi = distribution(heads, (50,))
    action, log_prob = pi.hard_sample()
    expected = np.zeros(50)
    one_hots, axes = heads.split(action)
    if heads.categorical:
        assert pi.probs is not None
        expected += np.log((one_hots * pi.probs + (1 - one_hots)).numpy()).sum(-1)
    if heads.axes:
        assert pi.loc is not None and pi.scale is not None
        u = np.arctanh(axes.numpy())
        z = (u - pi.loc.numpy()) / pi.scale.numpy()
        expected += (-0.5 * z**2 - np.log(pi.scale.numpy()) - 0.5 * np.log(2 * np.pi) + 2 * np.log(np.cosh(u))).sum(-1)
    np.testing.assert_allclose(log_prob.numpy(), expected, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(pi.log_prob(action), log_prob, rtol=1e-7, atol=1e-7)
    assert pi.sample((7,)).shape == (7, 50, heads.action_dim)
    torch.testing.assert_close(pi.sample_and_log_prob()[1].shape, log_prob.shape)


def test_mixed_density_integrates_to_one() -> None:
    """Sum over the values of the head and integral over the axis."""
    heads = ActionHeads((3,), axes=1)
    pi = distribution(heads)
    axis = torch.linspace(-1, 1, 20_001, dtype=F64)[1:-1]
    total = 0.0
    for value in torch.eye(3, dtype=F64):
        density = pi.log_prob(torch.cat((value.expand(len(axis), 3), axis[:, None]), -1)).exp()
        total += torch.trapezoid(density, axis).item()
    assert total == pytest.approx(1, abs=1e-3)
    action, log_prob = pi._expanded((2000,)).hard_sample()
    torch.testing.assert_close(pi.log_prob(action), log_prob, rtol=1e-6, atol=1e-6)
    assert action[:, 3].abs().max() < 1
    estimate = pi._expanded((1,)).entropy_estimate(20_000)
    assert estimate.item() == pytest.approx(-log_prob.mean().item(), abs=0.1)


def test_entropy_sums_over_components() -> None:
    torch.manual_seed(0)
    pi = distribution(GAMEPAD, (6,))
    whole = pi.entropy_estimate(4000)
    buttons = MixedAction(pi.probs, heads=ActionHeads(GAMEPAD.categorical)).entropy_estimate()
    sticks = MixedAction(None, pi.loc, pi.scale, heads=ActionHeads(axes=4)).entropy_estimate(4000)
    assert pi.probs is not None
    exact = -(pi.probs * pi.probs.log()).sum(-1)
    torch.testing.assert_close(buttons, exact, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(whole, exact + sticks, rtol=0, atol=0.3)
    assert (whole - exact - sticks).abs().max() > 0  # fresh draws


def test_relaxed_actions_are_differentiable_and_stay_out_of_sample() -> None:
    torch.manual_seed(0)
    pi = distribution(GAMEPAD, (6,))
    assert pi.probs is not None and pi.loc is not None
    pi.probs.requires_grad_()
    pi.loc.requires_grad_()
    relaxed, log_prob = pi.relaxed_sample()
    one_hots, _ = GAMEPAD.split(relaxed)
    assert not ((one_hots == 0) | (one_hots == 1)).all()
    torch.testing.assert_close(GAMEPAD.layout.pad(one_hots).sum(-1), torch.ones(6, 6, dtype=F64))
    (relaxed.square().sum() + log_prob.sum()).backward()
    assert pi.probs.grad is not None and pi.probs.grad.isfinite().all()
    assert not pi.has_rsample and not pi.sample().requires_grad
    with pytest.raises(NotImplementedError, match="RACLoss"):
        pi.rsample()
    axes = distribution(AXES, (6,))
    assert axes.has_rsample and axes.rsample().shape == (6, 2)


def test_distribution_needs_its_parameters() -> None:
    with pytest.raises(ValueError, match="give probs for categorical heads"):
        MixedAction(torch.ones(3), heads=AXES)


def test_policy_keeps_float32_under_autocast() -> None:
    policy = MixedPolicy(5, GAMEPAD, None, (16, 16))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        outputs = policy(torch.randn(8, 5))
    assert [o.dtype for o in outputs] == [torch.float32] * 3
    assert outputs[0].min() > 0


@pytest.mark.parametrize(("categorical", "sampled"), [((3,), True), ((), False)])
def test_actors_with_categorical_heads_act_by_sampling(categorical: tuple[int, ...], sampled: bool) -> None:
    actor = make_mixed_actor(2, ActionHeads(categorical, axes=2), None, widths=(8,))
    observation = TensorDict({"observation": torch.zeros(64, 2)}, [64])
    assert (actor(observation)["action"].unique(dim=0).shape[0] > 1) == sampled
