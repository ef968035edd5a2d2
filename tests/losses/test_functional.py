import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coachable.losses import functional
from coachable.losses.functional import bootstrap_target, pessimistic_quantiles, quantile_huber_loss

F64 = torch.float64


def slow_quantile_loss(z: np.ndarray, y: np.ndarray, tau: np.ndarray, kappa: float) -> tuple[float, np.ndarray]:
    """One sample at a time, one pair at a time: value and gradient with respect to the predictions."""
    value, gradient = 0.0, np.zeros_like(z)
    for i in range(len(z)):
        for j in range(len(y)):
            u = y[j] - z[i]
            weight = abs(tau[i] - (1.0 if u < 0 else 0.0))
            if kappa == 0:
                huber, slope = abs(u), np.sign(u)
            elif abs(u) <= kappa:
                huber, slope = 0.5 * u * u, u
            else:
                huber, slope = kappa * (abs(u) - 0.5 * kappa), kappa * np.sign(u)
            if kappa > 0:
                huber, slope = huber / kappa, slope / kappa
            value += weight * huber
            gradient[i] -= weight * slope
    scale = 1 / len(y) / len(z)
    return value * scale, gradient * scale


@pytest.mark.parametrize("kappa", [0.0, 0.3, 1.0, 2.0])
def test_quantile_loss_against_a_slow_loop(kappa: float) -> None:
    torch.manual_seed(0)
    z = (2 * torch.randn(2, 3, 4, 5, dtype=F64)).requires_grad_()  # critics, batch, labels, quantiles
    y = 2 * torch.randn(3, 4, 7, dtype=F64)
    tau = (2 * np.arange(1, 6) - 1) / 10
    loss = quantile_huber_loss(z, y, kappa=kappa)
    assert loss.shape == (2, 3, 4)
    loss.sum().backward()
    for c, b, n in np.ndindex(2, 3, 4):
        value, gradient = slow_quantile_loss(z.detach()[c, b, n].numpy(), y[b, n].numpy(), tau, kappa)
        assert loss[c, b, n].item() == pytest.approx(value, abs=1e-10)
        np.testing.assert_allclose(z.grad[c, b, n].numpy(), gradient, atol=1e-10)  # type: ignore[index]
    single = z.detach().float().requires_grad_()
    quantile_huber_loss(single, y.float(), kappa=kappa).sum().backward()
    torch.testing.assert_close(single.grad.double(), z.grad, rtol=1e-5, atol=1e-6)  # type: ignore[union-attr]


def test_ten_zeros_against_ten_ones() -> None:
    zeros, ones = torch.zeros(10, dtype=F64), torch.ones(10, dtype=F64)
    assert quantile_huber_loss(zeros, ones).item() == pytest.approx(0.25, abs=1e-15)


def test_two_predictions_three_targets() -> None:
    """Levels (1/4, 3/4): pinball (1.5 + 1.25 + .75)/3 + (1.5 + .75 + .25)/3 = 2, and half of it on average."""
    z, y = torch.tensor([-1.0, 3.0], dtype=F64), torch.tensor([-3.0, 4.0, 2.0], dtype=F64)
    assert quantile_huber_loss(z, y, kappa=0.0).item() == pytest.approx(1.0, abs=1e-12)
    # Huber of (-2, 5, 3) at 2: (2, 8, 4), of (-6, 1, -1): (10, .5, .5); weighted, divided by 2, on average.
    assert quantile_huber_loss(z, y, kappa=2.0).item() == pytest.approx((1.5 + 2 + 1 + 2.5 + 0.375 + 0.125) / 12)


def test_block_size_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    z, y = torch.randn(2, 9, 4, dtype=F64), torch.randn(9, 3, dtype=F64)
    whole = quantile_huber_loss(z, y)
    monkeypatch.setattr(functional, "_BLOCK_ELEMENTS_CPU", 1)
    torch.testing.assert_close(quantile_huber_loss(z, y), whole, rtol=1e-12, atol=1e-14)


def test_targets_get_no_gradient() -> None:
    z, y = torch.randn(3, 4, requires_grad=True), torch.randn(3, 4, requires_grad=True)
    quantile_huber_loss(z, y).sum().backward()
    assert z.grad is not None and y.grad is None


def test_pessimism_takes_a_whole_vector() -> None:
    two = torch.tensor([[0.0, 4.0], [1.0, 2.0]])
    assert pessimistic_quantiles(two).tolist() == [1.0, 2.0]
    tied = torch.tensor([[0.0, 4.0], [1.0, 3.0], [2.0, 2.0]])
    assert pessimistic_quantiles(tied).tolist() == [0.0, 4.0]  # the first at ties
    batch = torch.randn(3, 5, 6, 7, dtype=F64)
    chosen = pessimistic_quantiles(batch)
    for b, n in np.ndindex(5, 6):
        k = int(np.argmin(batch[:, b, n].mean(-1).numpy()))
        assert torch.equal(chosen[b, n], batch[k, b, n])


def test_n_step_targets() -> None:
    """Rewards 1, 2, 4, 8, gamma 1/2, n 3, value 16 everywhere.

    Whole sum: return 1 + 1 + 1 = 3, discount 1/8. Ended at the second step: 2, 1/4, bootstrapping only if truncated.
    From the last step: 8, 1/2.
    """
    reward = torch.tensor([3.0, 2.0, 2.0, 8.0])
    steps = torch.tensor([3, 2, 2, 1])
    terminated = torch.tensor([False, True, False, False])
    target = bootstrap_target(reward, torch.full((4,), 16.0), terminated, 0.5, steps)
    assert target.tolist() == [5.0, 2.0, 6.0, 16.0]
    quantiles = torch.tensor([16.0, 32.0]).expand(4, 2)
    target = bootstrap_target(reward, quantiles, terminated, torch.tensor(0.5), steps)
    assert target.tolist() == [[5.0, 7.0], [2.0, 2.0], [6.0, 10.0], [16.0, 24.0]]


def test_terminal_values_are_selected_out() -> None:
    value = torch.tensor([float("nan"), float("inf"), 2.0])
    target = bootstrap_target(torch.ones(3), value, torch.tensor([True, True, False]), 0.9)
    assert target.tolist() == pytest.approx([1.0, 1.0, 2.8])


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.floats(-1e15, 1e15), min_size=4, max_size=4),
    st.lists(st.floats(-1e15, 1e15), min_size=3, max_size=3),
    st.sampled_from([0.0, 1e-3, 1.0, 100.0]),
)
def test_no_nan(prediction: list[float], target: list[float], kappa: float) -> None:
    z = torch.tensor(prediction, dtype=torch.float32, requires_grad=True)
    loss = quantile_huber_loss(z, torch.tensor(target, dtype=torch.float32), kappa=kappa)
    loss.backward()
    assert loss.isfinite() and loss >= 0 and z.grad is not None and z.grad.isfinite().all()


def test_bad_arguments() -> None:
    z = torch.zeros(2)
    with pytest.raises(ValueError, match="kappa must not be negative"):
        quantile_huber_loss(z, z, kappa=-1.0)
