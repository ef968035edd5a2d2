"""tolerance, the term library and StyleReward: closed forms, the same bits in every layout, clear errors."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from dm_control.utils import rewards

from coachable.styles import (
    Choice,
    ChoiceTolerance,
    Setpoint,
    SetpointTolerance,
    StyleReward,
    StyleSpace,
    Term,
    Weight,
    WeightedFeature,
    WeightedSum,
    feature,
    tolerance,
    weighted_sum,
)

SIGMOIDS = ["linear", "long_tail"]


@pytest.mark.parametrize("sigmoid", SIGMOIDS)
@pytest.mark.parametrize(
    "bounds", [(0.0, 0.0), (-0.5, 0.7), (0.25, math.inf), (-math.inf, 0.25), (-math.inf, math.inf)]
)
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 1e-6), (torch.float64, 1e-12)])
def test_tolerance_equals_dm_control(sigmoid, bounds, dtype, atol):
    x = torch.cat([torch.linspace(-5, 5, 401, dtype=dtype), torch.tensor([-0.5, 0.25, 0.7, 1e3, -1e3], dtype=dtype)])
    for margin in (0.0, 0.05, 0.5, 3.0):
        for value in (0.1, 0.5, 0.95):
            expected = rewards.tolerance(x.numpy(), bounds, margin, sigmoid, value)
            got = tolerance(x, *bounds, margin, sigmoid, value)
            assert got.dtype == dtype
            np.testing.assert_allclose(got.numpy(), expected, rtol=0, atol=atol)


def test_tolerance_may_reach_zero_at_the_margin():
    x = torch.linspace(-2, 2, 81, dtype=torch.float64)
    expected = rewards.tolerance(x.numpy(), (-0.5, 0.5), 0.6, "linear", 0.0)
    np.testing.assert_allclose(tolerance(x, -0.5, 0.5, 0.6, "linear", 0.0).numpy(), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("sigmoid", SIGMOIDS)
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 1e-6), (torch.float64, 1e-12)])
def test_tensor_bounds_equal_dm_control_row_by_row(sigmoid, dtype, atol):
    generator = torch.Generator().manual_seed(0)
    lower = torch.randn(4, 1, generator=generator, dtype=dtype)
    upper = lower + torch.rand(4, 1, generator=generator, dtype=dtype)
    x = torch.linspace(-3, 3, 101, dtype=dtype)
    expected = np.stack(
        [rewards.tolerance(x.numpy(), (a.item(), b.item()), 0.3, sigmoid) for a, b in zip(lower, upper, strict=True)]
    )
    np.testing.assert_allclose(tolerance(x, lower, upper, 0.3, sigmoid).numpy(), expected, rtol=0, atol=atol)
    point = np.stack([rewards.tolerance(x.numpy(), (a.item(), a.item()), 0.3, sigmoid) for a in lower])
    np.testing.assert_allclose(tolerance(x, lower, lower, 0.3, sigmoid).numpy(), point, rtol=0, atol=atol)


@pytest.mark.parametrize("sigmoid", SIGMOIDS)
@pytest.mark.parametrize("bounds", [(0.0, 0.0), (-0.5, 0.7), (0.25, math.inf)])
def test_tolerance_has_finite_gradients(sigmoid, bounds):
    x = torch.linspace(-50, 50, 401, requires_grad=True)
    tolerance(x, *bounds, 0.1, sigmoid).sum().backward()
    assert x.grad.isfinite().all()


@pytest.mark.parametrize("sigmoid", SIGMOIDS)
def test_tolerance_has_the_same_bits_in_every_layout(sigmoid):
    """Vectorised and scalar kernels may differ in the last bit; what the terms use must not."""
    x = torch.randn(1024, 7, generator=torch.Generator().manual_seed(0)) * 2
    table = tolerance(x, -0.3, 0.4, 1.3, sigmoid)
    assert tolerance(x[:, 3], -0.3, 0.4, 1.3, sigmoid).equal(table[:, 3])
    assert tolerance(x.T.contiguous().T, -0.3, 0.4, 1.3, sigmoid).equal(table)
    assert tolerance(x[:, None, 3].expand(-1, 5), -0.3, 0.4, 1.3, sigmoid)[:, 2].equal(table[:, 3])
    alone = torch.stack([tolerance(value, -0.3, 0.4, 1.3, sigmoid) for value in x[:200, 3]])
    assert alone.equal(table[:200, 3])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"lower": 1.0, "upper": 0.0}, "expected lower <= upper"),
        ({"margin": -1.0}, "margin = -1.0"),
        ({"margin": 1.0, "sigmoid": "step"}, "unknown sigmoid 'step': expected one of linear, long_tail"),
        ({"margin": 1.0, "value_at_margin": 1.0}, "value_at_margin is 1.0"),
        ({"margin": 1.0, "value_at_margin": 0.0}, "value_at_margin is 0.0 for sigmoid 'long_tail'"),
    ],
)
def test_tolerance_rejects(arguments, message):
    with pytest.raises(ValueError, match=message):
        tolerance(torch.zeros(1), **arguments)


@pytest.mark.parametrize("width", [1, 2, 3, 18])
def test_weighted_sum_adds_first_to_last(width):
    weights, values = torch.randn(2, 7, width)
    expected = []
    for w, g in zip(weights, values, strict=True):
        total = w[0] * g[0]
        for i in range(1, width):
            total = total + w[i] * g[i]
        expected.append(total)
    assert weighted_sum(weights, values).equal(torch.stack(expected))


def test_features_by_index_and_slice():
    tensor = torch.arange(6.0).reshape(2, 3)
    assert feature(tensor, 1).tolist() == [1, 4]
    assert feature(tensor, slice(1, 3)).shape == (2, 2)
    with pytest.raises(KeyError, match="no style feature 3: the environment emits 3 columns"):
        feature(tensor, 3)


def test_terms_closed_form():
    style = {"w": torch.tensor([2.0, -1.0]), "v": torch.tensor([0.5, 0.0]), "length": torch.tensor([0.5, 0.6])}
    features = torch.tensor([[3.0, 4.0, 0.5], [5.0, 6.0, 0.65]])
    assert WeightedFeature("w", 1)(features, style).tolist() == [8.0, -6.0]
    assert WeightedSum(("w", "v"), slice(0, 2))(features, style).tolist() == [8.0, -5.0]
    # long tail: 0.1 at a margin's distance
    at_margin = SetpointTolerance("length", 2, margin=0.05)
    torch.testing.assert_close(at_margin(features, style), torch.tensor([1.0, 0.1]), atol=1e-6, rtol=0)
    gated = SetpointTolerance("length", 2, margin=0.05, gate=1)
    torch.testing.assert_close(gated(features, style), torch.tensor([4.0, 0.6]), atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match=r"reads 3 features for 2 weights \('w', 'v'\)"):
        WeightedSum(("w", "v"))(features, style)


def test_choice_tolerance_uses_the_bounds_of_the_option():
    term = ChoiceTolerance(
        "pose",
        slice(0, 2),
        lower=[[0.0, 0.0], [10.0, 10.0]],
        upper=[[1.0, 1.0], [11.0, 11.0]],
        margin=1.0,
        sigmoid="linear",
    )
    features = torch.tensor([[0.5, 1.5], [0.5, 0.5], [10.0, 11.0]])
    style = {"pose": torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])}
    # linear with 0.1 at the margin: 1 - 0.9 * 0.5 half a margin out
    torch.testing.assert_close(term(features, style), torch.tensor([(1 + 0.55) / 2, 0.0, 1.0]))
    with pytest.raises(ValueError, match="lower <= upper"):
        ChoiceTolerance("pose", 0, lower=[[1.0]], upper=[[0.0]], margin=1.0)
    with pytest.raises(ValueError, match=r"'pose' has the key 0, an index: expected a slice"):
        ChoiceTolerance("pose", 0, lower=[[0.0]], upper=[[1.0]], margin=1.0)
    with pytest.raises(ValueError, match=r"'pose' reads 1 features by key slice\(0, 2, None\): expected 2"):
        term(features[:, :1], style)
    poses = StyleSpace([Choice("pose", ("a", "b", "c"))])
    with pytest.raises(ValueError, match="term 'pose' has bounds for 2 options, pose has 3"):
        StyleReward(poses, {"pose": term})
    with pytest.raises(ValueError, match="term 'pose' is a WeightedFeature of a choice: expected ChoiceTolerance"):
        StyleReward(poses, {"pose": WeightedFeature("pose", 0)})


def combat_reward() -> StyleReward:
    space = StyleSpace([Weight(f"w{i}", -0.05 * (i + 1), i + 1.0) for i in range(18)])
    return StyleReward(space, {"damage": WeightedSum(space.names)})


def mixed_reward() -> StyleReward:
    """Every kind of term; 12 features."""
    space = StyleSpace(
        [
            Choice("pose", ("a", "b", "c")),
            Setpoint("length", 0.3, 0.65),
            Weight("fuel", -3, 105),
            Weight("tire", -60, 12e3),
        ]
    )
    bounds = torch.linspace(-1, 1, 18).reshape(3, 6)

    def own(features, style):
        return style["fuel"] * features[..., 8].clamp(min=0).sqrt() - style["tire"] * features[..., 9]

    terms = {
        "pose": ChoiceTolerance("pose", slice(0, 6), bounds - 0.2, bounds + 0.2, margin=0.5),
        "length": SetpointTolerance("length", 6, margin=0.05, gate=7),
        "own": Term(own, parameters=("fuel", "tire")),
        "costs": WeightedSum(("tire", "fuel"), slice(10, 12)),
    }
    return StyleReward(space, terms, scales={"pose": 0.5, "own": 1 / 3})


REWARDS = {"combat": (combat_reward, 18), "mixed": (mixed_reward, 12)}


@pytest.mark.parametrize("name", REWARDS)
def test_same_bits_in_every_shape_and_layout(name):
    """What relabelling computes from stored transitions equals what the environment saw, step by step."""
    build, width = REWARDS[name]
    reward = build()
    generator = torch.Generator().manual_seed(0)
    steps, envs, labels = 9, 32, 5
    features = torch.randn(steps, envs, width, generator=generator)
    theta = reward.space.sample((steps, envs), generator)
    collected = torch.stack([reward(f, t) for f, t in zip(features, theta, strict=True)])  # (T, N, 1)
    assert collected.dtype == torch.float32 and collected.shape == (steps, envs, 1)

    flat = reward(features.reshape(-1, width), theta.reshape(-1, reward.space.dim))
    assert flat.equal(collected.reshape(-1, 1))
    # [N, T] views that are not contiguous
    assert reward(features.transpose(0, 1), theta.transpose(0, 1)).equal(collected.transpose(0, 1))
    # features with another memory order, as a column store would hand out
    columns = features.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert columns.stride(-1) != 1 and reward(columns, theta).equal(collected)
    # one transition at a time
    assert reward(features[3, 4], theta[3, 4]).equal(collected[3, 4])
    # [B] to [B, n+1]: original label in column 0, features expanded or broadcast
    batch = features.reshape(-1, width)
    relabelled = torch.cat([theta.reshape(-1, 1, reward.space.dim), reward.space.sample((len(batch), labels - 1))], 1)
    expanded = batch.unsqueeze(1).expand(-1, labels, -1)
    for seen in (expanded, expanded.contiguous(), batch.unsqueeze(1)):
        out = reward(seen, relabelled)
        assert out.shape == (len(batch), labels, 1)
        assert out[:, 0].equal(collected.reshape(-1, 1))
        assert out[:, 2].equal(reward(batch, relabelled[:, 2]))


def test_reward_is_the_scaled_sum_of_its_terms():
    reward = mixed_reward()
    features, theta = torch.randn(8, 12), reward.space.sample((8,))
    terms = reward.terms_of(features, theta)
    assert tuple(terms) == tuple(reward.terms) == ("pose", "length", "own", "costs")
    total = 0.5 * terms["pose"] + terms["length"] + (1 / 3) * terms["own"] + terms["costs"]
    torch.testing.assert_close(reward(features, theta).squeeze(-1), total)
    assert reward.scales == {"pose": 0.5, "length": 1.0, "own": 1 / 3, "costs": 1.0}


def test_combat_reward_is_a_dot_product():
    reward = combat_reward()
    features, theta = torch.randn(64, 18), reward.space.sample((64,))
    torch.testing.assert_close(reward(features, theta).squeeze(-1), (features * theta).sum(-1))


def test_zero_weights_give_zero_reward():
    reward = combat_reward()
    assert reward(torch.randn(4, 18), reward.space.default.expand(4, -1)).eq(0).all()


def test_gradient_reaches_theta():
    reward = mixed_reward()
    theta = reward.space.sample((8,)).requires_grad_()
    reward(torch.rand(8, 12), theta).sum().backward()
    assert theta.grad.isfinite().all() and theta.grad[:, 4].abs().min() > 0


def test_copies_agree():
    reward = combat_reward()
    features, theta = torch.randn(3, 18), reward.space.sample((3,))
    for twin in (copy.deepcopy(reward), pickle.loads(pickle.dumps(reward))):
        assert twin(features, theta).equal(reward(features, theta))


def test_a_module_as_term_is_registered():
    class Model(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.linear = torch.nn.Linear(2, 1, dtype=torch.float64)

        def forward(self, features, style):
            return style["w"] * self.linear(features).squeeze(-1)

    space = StyleSpace([Weight("w", 0, 1)])
    reward = StyleReward(space, {"model": Term(Model(), parameters=("w",))}).to(torch.float32)
    assert len(list(reward.parameters())) == 2
    assert reward(torch.randn(3, 2), space.sample((3,))).dtype == torch.float32


SPACE = StyleSpace([Weight("fuel", -3, 105), Weight("tire", -60, 12_000), Setpoint("gap", 0, 2)], name="racing")
FUEL_AND_TIRE = WeightedSum(("fuel", "tire"), slice(0, 2))
GAP = SetpointTolerance("gap", 2, margin=1.0)


@pytest.mark.parametrize(
    ("terms", "scales", "message"),
    [
        ({"costs": FUEL_AND_TIRE}, None, r"space 'racing' .*: no term reads the parameters \['gap'\]"),
        ({}, None, r"no term reads the parameters \['fuel', 'tire', 'gap'\]"),
        (
            {"costs": FUEL_AND_TIRE, "gap": GAP, "x": WeightedFeature("speed", 0)},
            None,
            r"'x' reads \['speed'\], which the space lacks",
        ),
        (
            {"costs": FUEL_AND_TIRE, "gap": GAP, "x": lambda features, style: features[..., 0]},
            None,
            r"'x' declares no parameters: wrap it as Term",
        ),
        ({"costs": FUEL_AND_TIRE, "gap": torch.nn.Linear(3, 1)}, None, "'gap' declares no parameters"),
        ({"costs": FUEL_AND_TIRE, "gap": GAP}, {"cost": 2.0}, r"scales are given for \['cost'\].*\['costs', 'gap'\]"),
    ],
)
def test_reward_must_fit_its_space(terms, scales, message):
    with pytest.raises(ValueError, match=message):
        StyleReward(SPACE, terms, scales)


class Lift:
    """A term of one's own that says what it is like."""

    parameters = ("gap",)
    is_linear = True

    def mismatch(self, space):
        return None if space["gap"].high > 100 else f"lifts to 100 {space['gap'].unit}, gap ends at {space['gap'].high}"

    def __call__(self, features, style):
        return style["gap"] * features[..., 2]


def test_an_own_term_tells_which_parameters_suit_it():
    with pytest.raises(ValueError, match=r"term 'lift' lifts to 100 .*, gap ends at"):
        StyleReward(SPACE, {"costs": FUEL_AND_TIRE, "lift": Lift()})


def test_an_own_term_may_be_linear():
    space = StyleSpace([Setpoint("gap", 0.0, 200.0, unit="m")])
    assert StyleReward(space, {"lift": Lift()}).is_linear
    assert not StyleReward(space, {"lift": Term(Lift(), ("gap",))}).is_linear


def test_all_problems_are_told_at_once():
    with pytest.raises(ValueError, match=r"'gap' declares no parameters.*no term reads.*'tire', 'gap'.*scales"):
        StyleReward(SPACE, {"fuel": WeightedFeature("fuel", 0), "gap": len}, {"gaap": 1.0})


def test_a_term_of_the_wrong_shape_is_named():
    space = StyleSpace([Weight("w", 0, 1)])
    column = StyleReward(space, {"column": Term(lambda f, s: s["w"].unsqueeze(-1) * f[..., :1], parameters=("w",))})
    with pytest.raises(ValueError, match=r"'column' returned shape \(4, 1\) .*expected \(4,\)"):
        column(torch.zeros(4, 2), space.sample((4,)))
    wide = StyleReward(space, {"wide": WeightedFeature("w", 0)})
    with pytest.raises(ValueError, match=r"'wide' returned shape \(4, 3\)"):
        wide(torch.zeros(4, 3, 2), space.sample((4, 1)))


@pytest.mark.parametrize(
    ("setting", "message"),
    [({"sigmoid": "gauss"}, "unknown sigmoid 'gauss'"), ({"margin": math.nan}, "margin = nan: expected a finite")],
)
def test_settings_of_a_tolerance_are_checked_when_a_term_is_made(setting, message):
    with pytest.raises(ValueError, match=message):
        SetpointTolerance("speed", 0, **{"margin": 1.0, **setting})
    with pytest.raises(ValueError, match=message):
        ChoiceTolerance("hat", slice(0, 1), [[0.0]], [[1.0]], **{"margin": 1.0, **setting})


def test_scales_are_finite():
    space = StyleSpace([Weight("fuel", -3, 105)])
    with pytest.raises(ValueError, match=r"the scale of 'fuel' is nan: expected a finite number"):
        StyleReward(space, {"fuel": WeightedFeature("fuel", 0)}, {"fuel": math.nan})
