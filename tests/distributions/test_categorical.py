import copy
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from coachable.distributions.categorical import (
    EPSILON,
    HeadLayout,
    categorical_entropy,
    exponential_noise,
    hard_one_hots,
    log_probabilities,
    most_likely_one_hots,
    regret_matching_probabilities,
    relaxed_one_hots,
)

F64 = torch.float64
GAMEPAD = HeadLayout((4, 6, 3, 3, 2, 2))


def regret_gradient(x: list[float], g: list[float]) -> list[float]:
    """Gradient that arrives at x when the loss has gradient g with respect to pi."""
    leaf = torch.tensor(x, dtype=F64, requires_grad=True)
    pi = regret_matching_probabilities(leaf, HeadLayout((len(x),)))
    pi.backward(torch.tensor(g, dtype=F64))
    assert leaf.grad is not None
    return leaf.grad.tolist()


def test_probabilities_of_the_positive_part() -> None:
    x = torch.tensor([2.0, 1.0, 1.0, -1.0], dtype=F64)
    u = np.maximum(x.numpy(), 0) + 1e-8 / 4
    pi = regret_matching_probabilities(x, HeadLayout((4,)))
    np.testing.assert_allclose(pi.numpy(), u / u.sum(), rtol=1e-12)


def test_nothing_positive_is_uniform() -> None:
    pi = regret_matching_probabilities(torch.tensor([-1.0, -5.0, 0.0, -2.0, -3.0]), HeadLayout((3, 2)))
    torch.testing.assert_close(pi, torch.tensor([1 / 3] * 3 + [1 / 2] * 2))


def test_heads_in_one_tensor_equal_heads_one_by_one() -> None:
    torch.manual_seed(0)
    x = torch.randn(7, 5, GAMEPAD.total, dtype=F64)
    weight = torch.randn_like(x)
    together = x.clone().requires_grad_()
    pi = regret_matching_probabilities(together, GAMEPAD)
    (pi * weight).sum().backward()
    first = 0
    for size in GAMEPAD.sizes:
        at = slice(first, first + size)
        alone = x[..., at].clone().requires_grad_()
        own = regret_matching_probabilities(alone, HeadLayout((size,)))
        (own * weight[..., at]).sum().backward()
        first += size
        torch.testing.assert_close(pi[..., at], own, rtol=1e-12, atol=0)
        torch.testing.assert_close(together.grad[..., at], alone.grad, rtol=1e-12, atol=1e-15)  # type: ignore[index]


# x, dL/dpi, gradient by hand: regret = sum g pi - g, masked where x < 0 and regret < 0.
@pytest.mark.parametrize(
    ("x", "g", "expected"),
    [
        ([2, 1, 1, -1], [1, 2, 0, -2], [0, 1, -1, -3]),  # inactive and cheaper than average: comes back
        ([2, 1, 1, -1], [1, 2, 0, 5], [0, 1, -1, 0]),  # inactive and dearer: left alone
        ([2, 1, 1, 0], [1, 2, 0, 5], [0, 1, -1, 4]),  # zero is not masked
    ],
)
def test_regret_gradient_by_hand(x: list[float], g: list[float], expected: list[float]) -> None:
    np.testing.assert_allclose(regret_gradient(x, g), expected, atol=3e-8)  # epsilon moves pi by 1e-8


def slow_regret_gradient(x: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Independent scalar-by-scalar version."""
    d = len(x)
    u = [max(0.0, xi) + 1e-8 / d for xi in x]
    total = sum(u)
    pi = [ui / total for ui in u]
    rho = [sum(gj * pj for gj, pj in zip(g, pi, strict=True)) - gi for gi in g]
    return np.array([0.0 if xi < 0 and ri < 0 else -ri for xi, ri in zip(x, rho, strict=True)])


def test_regret_gradient_against_scalars() -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        d = rng.integers(2, 7)
        x, g = rng.normal(size=d), rng.normal(size=d)
        x[rng.integers(d)] = 0.0
        np.testing.assert_allclose(
            regret_gradient(x.tolist(), g.tolist()), slow_regret_gradient(x, g), rtol=1e-10, atol=1e-10
        )


def test_regret_gradient_does_not_depend_on_the_scale() -> None:
    x, g = [2.0, 1.0, 1.0, -1.0], [1.0, 2.0, 0.0, -2.0]
    np.testing.assert_allclose(regret_gradient([20.0, 10.0, 10.0, -10.0], g), regret_gradient(x, g), atol=1e-7)


def test_dead_value_revives() -> None:
    x = torch.tensor([1.0, 0.2, -0.5])
    for _ in range(400):
        leaf = x.requires_grad_()
        pi = regret_matching_probabilities(leaf, HeadLayout((3,)))
        (grad,) = torch.autograd.grad(pi, leaf, torch.tensor([1.0, 2.0, 0.0]))
        x = (x - 0.02 * grad).detach()
    assert regret_matching_probabilities(x, HeadLayout((3,)))[2] > 0.99


def test_self_play_finds_the_equilibrium() -> None:
    """Both players of a zero-sum game descend by regrets; the average strategies approach (.25, .5, .25)."""
    payoff = torch.tensor([[0.0, -1.0, 2.0], [1.0, 0.0, -1.0], [-2.0, 1.0, 0.0]], dtype=F64)  # row player's gain
    torch.manual_seed(0)
    layout = HeadLayout((3,))
    x, average = torch.rand(2, 3, dtype=F64), torch.zeros(2, 3, dtype=F64)
    steps = 2_000
    for _ in range(steps):
        leaf = x.requires_grad_()
        pi = regret_matching_probabilities(leaf, layout)
        loss_gradient = torch.stack((-(payoff @ pi[1]), -(-payoff.T @ pi[0]))).detach()
        (grad,) = torch.autograd.grad(pi, leaf, loss_gradient)
        x = (x - grad).detach()
        average += pi.detach() / steps
    best_replies = (payoff @ average[1]).max() + (-payoff.T @ average[0]).max()
    assert best_replies < 0.05  # the game's value is 0, so this is the exploitability
    torch.testing.assert_close(average, torch.tensor([[0.25, 0.5, 0.25]] * 2, dtype=F64), atol=0.05, rtol=0)


def test_relaxed_sample_is_gumbel_softmax() -> None:
    torch.manual_seed(0)
    pi = regret_matching_probabilities(torch.randn(50, GAMEPAD.total, dtype=F64), GAMEPAD)
    torch.manual_seed(1)
    noise = exponential_noise(pi)
    expected = [
        torch.softmax(p.log() - e.log(), -1)
        for p, e in zip(pi.split(GAMEPAD.sizes, -1), noise.split(GAMEPAD.sizes, -1), strict=True)
    ]
    torch.manual_seed(1)
    relaxed = relaxed_one_hots(pi, GAMEPAD)
    torch.testing.assert_close(relaxed, torch.cat(expected, -1), rtol=1e-10, atol=1e-14)
    torch.manual_seed(1)
    hard = hard_one_hots(pi, GAMEPAD)
    assert torch.equal(hard, most_likely_one_hots(relaxed, GAMEPAD))


def test_gradient_of_relaxed_sample() -> None:
    """dL/dpi_i = y_i / pi_i (g_i - sum g_j y_j), also for values of no probability to speak of."""
    torch.manual_seed(1)
    layout = HeadLayout((4,))
    pi = regret_matching_probabilities(torch.tensor([[1.0, 0.3, -1.0, -2.0]], dtype=F64), layout).requires_grad_()
    g = torch.randn(1, 4, dtype=F64)
    y = relaxed_one_hots(pi, layout)
    y.backward(g)
    by_hand = y / pi * (g - (g * y).sum(-1, keepdim=True))
    torch.testing.assert_close(pi.grad, by_hand.detach(), rtol=1e-10, atol=0)
    assert pi.grad is not None and abs((pi.grad * pi).sum().item()) < 1e-10  # the critic's part has no mean regret


def test_hard_samples_follow_the_probabilities() -> None:
    torch.manual_seed(2)
    layout, n = HeadLayout((4, 2)), 40_000
    pi = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.75, 0.25])
    samples = hard_one_hots(pi.expand(n, -1), layout)
    assert torch.equal(layout.pad(samples).sum(-1), torch.ones(n, 2))
    sigma = (pi * (1 - pi) / n).sqrt()
    assert ((samples.mean(0) - pi).abs() < 5 * sigma).all()


def test_entropy_and_its_gradient() -> None:
    pi = torch.tensor([[0.5, 0.5, 0.1, 0.2, 0.7], [1.0, 0.0, 0.25, 0.25, 0.5]], dtype=F64, requires_grad=True)
    entropy = categorical_entropy(pi)
    expected = [np.log(2) - 0.1 * np.log(0.1) - 0.2 * np.log(0.2) - 0.7 * np.log(0.7), 1.5 * np.log(2)]
    np.testing.assert_allclose(entropy.detach().numpy(), expected, rtol=1e-12)
    entropy[0].backward()
    np.testing.assert_allclose(pi.grad[0].numpy(), -np.log([0.5, 0.5, 0.1, 0.2, 0.7]) - 1, rtol=1e-12)  # type: ignore[index]


def test_regret_of_entropy_alone() -> None:
    """With L = -alpha H the regret is alpha (-H - log pi_i): rare values gain."""
    x = torch.tensor([2.0, 1.0, 0.5], dtype=F64, requires_grad=True)
    pi = regret_matching_probabilities(x, HeadLayout((3,)))
    (-0.1 * categorical_entropy(pi)).backward()
    p = pi.detach()
    entropy = -(p * p.log()).sum()
    torch.testing.assert_close(x.grad, -0.1 * (-entropy - p.log()), rtol=1e-10, atol=1e-12)


def test_float32_rounding() -> None:
    torch.manual_seed(3)
    x = torch.randn(100, GAMEPAD.total, dtype=F64)
    outcomes = []
    for dtype in (F64, torch.float32):
        leaf = x.to(dtype, copy=True).requires_grad_()
        pi = regret_matching_probabilities(leaf, GAMEPAD)
        categorical_entropy(pi).sum().backward()
        outcomes.append((pi.detach().double(), leaf.grad.double()))  # type: ignore[union-attr]
    torch.testing.assert_close(outcomes[1][0], outcomes[0][0], rtol=1e-6, atol=1e-14)
    torch.testing.assert_close(outcomes[1][1], outcomes[0][1], rtol=1e-5, atol=1e-5)


def test_half_precision_inputs_are_promoted() -> None:
    x = torch.tensor([[1.0, -1.0, -1.0]], dtype=torch.float16, requires_grad=True)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        pi = regret_matching_probabilities(x, HeadLayout((3,)))
        loss = categorical_entropy(pi).sum() + relaxed_one_hots(pi, HeadLayout((3,)))[..., 0].sum()
    assert pi.dtype == loss.dtype == torch.float32
    assert pi.min() > 0  # epsilon survives
    loss.backward()
    assert x.grad is not None and x.grad.isfinite().all()


PREFERENCES = st.one_of(
    st.floats(width=32, allow_nan=False, allow_infinity=False), st.sampled_from([0.0, -0.0, 3e38, -3e38, 1.0, -1.0])
)


@settings(max_examples=100, deadline=None)
@given(st.lists(PREFERENCES, min_size=6, max_size=6), st.integers(0, 2**31))
def test_no_nan_for_any_preferences(values: list[float], seed: int) -> None:
    torch.manual_seed(seed)
    layout = HeadLayout((2, 4))
    x = torch.tensor(values, dtype=torch.float32, requires_grad=True)
    pi = regret_matching_probabilities(x, layout)
    relaxed = relaxed_one_hots(pi, layout)
    torch.testing.assert_close(layout.pad(relaxed).sum(-1), torch.ones(2))
    torch.testing.assert_close(layout.pad(pi).sum(-1), torch.ones(2))
    assert torch.equal(layout.pad(hard_one_hots(pi, layout)).sum(-1), torch.ones(2))
    (categorical_entropy(pi) + (relaxed * torch.randn(6)).sum() + log_probabilities(pi).sum()).backward()
    assert x.grad is not None and x.grad.isfinite().all()


def test_noise_is_bounded_away_from_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tensor, "exponential_", lambda self: self.zero_())
    assert exponential_noise(torch.ones(3)).min() > 0


@pytest.mark.parametrize("sizes", [(), (1,), (3, 0), (2, -1)])
def test_heads_too_small(sizes: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="at least 2 values"):
        HeadLayout(sizes)


def test_layout_copies() -> None:
    GAMEPAD.pad(torch.ones(GAMEPAD.total))  # fills the cache
    assert copy.deepcopy(GAMEPAD).sizes == pickle.loads(pickle.dumps(GAMEPAD)).sizes == GAMEPAD.sizes
    assert len(GAMEPAD) == 6 and EPSILON == 1e-8


def test_constants_first_used_in_inference_mode_still_differentiate():
    layout = HeadLayout((2, 3))
    with torch.inference_mode():
        layout.constants(torch.zeros(1))
    values = torch.zeros(4, 2, 3, requires_grad=True)
    (values * layout.constants(values)[2]).sum().backward()
    assert values.grad is not None
