import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate

from coachable.distributions import tanh_gaussian
from coachable.distributions.tanh_gaussian import (
    at_least_float32,
    log_cosh,
    sample_tanh_gaussian,
    tanh_gaussian_entropy,
    tanh_gaussian_log_prob,
)

F64 = torch.float64
# loc, scale, entropy by quadrature, standard deviation of one sample of it
QUADRATURE = [
    (0.0, np.exp(-2.0), -0.599213, 0.682),
    (0.0, 1.0, 0.669804, 0.218),
    (0.5, 1.0, 0.520242, 0.628),
    (0.0, 3.0, -1.095745, 2.742),
    (0.0, np.exp(2.0), -7.074345, 8.144),
]


def expectation(f, loc: float, scale: float) -> float:
    """E f(Z, loc + scale Z) for a standard normal Z."""

    def integrand(z: float) -> float:
        return np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) * f(z, loc + scale * z)

    pieces = [integrate.quad(integrand, a, a + 1, epsabs=1e-13)[0] for a in range(-12, 12)]
    return float(sum(pieces))


def negative_log_density(scale: float):
    return lambda z, u: 0.5 * z * z + np.log(scale) + 0.5 * np.log(2 * np.pi) - 2 * (np.logaddexp(u, -u) - np.log(2))


@pytest.mark.parametrize(("loc", "scale", "entropy", "sd"), QUADRATURE)
def test_entropy_against_quadrature(loc: float, scale: float, entropy: float, sd: float) -> None:
    assert abs(expectation(negative_log_density(scale), loc, scale) - entropy) < 2e-6
    torch.manual_seed(0)
    estimates = tanh_gaussian_entropy(torch.full((200, 1), loc), torch.full((200, 1), scale), shared_noise=False)
    assert ((estimates - entropy).abs() < 5 * sd / 1000**0.5).all()
    # Unbiased: the mean of 200 independent estimates is 14 times as accurate.
    assert abs(estimates.mean().item() - entropy) < 5 * sd / (200 * 1000) ** 0.5
    shared = tanh_gaussian_entropy(torch.full((3, 2), loc), torch.full((3, 2), scale))
    assert ((shared - entropy).abs() < 5 * sd / 1000**0.5).all()
    assert torch.equal(shared[0], shared[2]) and shared[0, 0] != shared[0, 1]  # shared by states, not by axes


@pytest.mark.parametrize(("loc", "scale"), [(0.0, 1.0), (0.5, 1.0), (-1.0, 0.3), (0.2, 3.0)])
def test_entropy_gradient_against_quadrature(loc: float, scale: float) -> None:
    by_loc = expectation(lambda z, u: -2 * np.tanh(u), loc, scale)
    by_scale = 1 / scale + expectation(lambda z, u: -2 * z * np.tanh(u), loc, scale)
    mu = torch.tensor([loc], dtype=F64, requires_grad=True)
    sigma = torch.tensor([scale], dtype=F64, requires_grad=True)
    torch.manual_seed(0)
    n = 400_000
    tanh_gaussian_entropy(mu, sigma, n).sum().backward()
    assert mu.grad is not None and sigma.grad is not None
    assert abs(mu.grad.item() - by_loc) < 5 * 2 / n**0.5
    assert abs(sigma.grad.item() - by_scale) < 5 * 3 / n**0.5


@pytest.mark.parametrize("num_samples", [1, 2, 7, 8, 1000, 1001])
@pytest.mark.parametrize("shared", [True, False])
def test_estimate_and_gradient_against_autograd(
    num_samples: int, shared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The one-pass function equals the textbook expression differentiated by autograd, sample by sample."""
    torch.manual_seed(num_samples)
    loc = torch.randn(3, 5, 2, dtype=F64, requires_grad=True)
    scale = (0.2 + 2 * torch.rand(3, 5, 2, dtype=F64)).requires_grad_()
    torch.manual_seed(0)
    noise = torch.randn(2, 1 if shared else 15, num_samples, dtype=F64)  # by axis, state and sample
    z = noise.permute(2, 1, 0).reshape(num_samples, *((1, 1) if shared else (3, 5)), 2)
    u = loc + scale * z
    slow = (scale.log() + 0.5 * np.log(2 * np.pi) + 0.5 * z**2 - 2 * torch.log(torch.cosh(u))).mean(0)
    torch.manual_seed(0)
    fast = tanh_gaussian_entropy(loc, scale, num_samples, shared_noise=shared)
    torch.testing.assert_close(fast, slow, rtol=1e-10, atol=1e-10)
    weight = torch.randn_like(fast)
    expected = torch.autograd.grad((slow * weight).sum(), (loc, scale))
    actual = torch.autograd.grad((fast * weight).sum(), (loc, scale))
    torch.testing.assert_close(actual, expected, rtol=1e-10, atol=1e-10)
    monkeypatch.setattr(torch, "randn", lambda *shape, **options: noise.float())
    single = tanh_gaussian_entropy(loc.float(), scale.float(), num_samples, shared_noise=shared)
    torch.testing.assert_close(single.double(), slow, rtol=1e-5, atol=1e-5)


def test_blocks_do_not_change_the_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    loc, scale = torch.randn(10, 3, dtype=F64), torch.rand(10, 3, dtype=F64) + 0.1
    torch.manual_seed(0)
    whole = tanh_gaussian_entropy(loc, scale, 9)
    monkeypatch.setattr(tanh_gaussian, "_CHUNK_ELEMENTS_CPU", 30)  # one row at a time
    torch.manual_seed(0)
    torch.testing.assert_close(tanh_gaussian_entropy(loc, scale, 9), whole, rtol=1e-12, atol=1e-12)
    assert tanh_gaussian_entropy(loc[:0], scale[:0], 9).shape == (0, 3)


def test_memory_does_not_grow_with_samples_times_batch() -> None:
    """What the backward pass keeps is one derivative per parameter, not one number per sample."""
    kept: list[int] = []
    loc, scale = torch.zeros(50, 4, requires_grad=True), torch.ones(50, 4, requires_grad=True)
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t.numel()) or t, lambda t: t):
        tanh_gaussian_entropy(loc, scale, 1000).sum()
    assert sum(kept) == 2 * 50 * 4


def test_sample_and_its_density() -> None:
    torch.manual_seed(0)
    loc, scale = torch.randn(100, 2, dtype=F64), 0.3 + torch.rand(100, 2, dtype=F64)
    noise = torch.randn(100, 2, dtype=F64)
    action, log_prob = sample_tanh_gaussian(loc, scale, noise)
    u = (loc + scale * noise).numpy()
    np.testing.assert_allclose(action.numpy(), np.tanh(u), rtol=1e-12)
    normal = -0.5 * noise.numpy() ** 2 - np.log(scale.numpy()) - 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(log_prob.numpy(), normal + 2 * np.log(np.cosh(u)), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(tanh_gaussian_log_prob(action, loc, scale), log_prob, rtol=1e-7, atol=1e-7)


def test_saturated_samples_keep_their_density() -> None:
    """Mean of -log pi at scale e^2 is -7.07; scoring the rounded action gives -4.8 or NaN."""
    torch.manual_seed(0)
    n = 200_000
    action, log_prob = sample_tanh_gaussian(torch.zeros(n), torch.full((n,), float(np.exp(2.0))))
    assert (action.abs() == 1).any()
    assert abs(-log_prob.mean().item() + 7.074345) < 5 * 8.144 / n**0.5


def test_score_at_saturation_is_exact() -> None:
    """d(-log pi)/d loc = -2 tanh(u) even where float32 tanh is 1."""
    loc = torch.tensor([20.0, -50.0, 300.0], requires_grad=True)
    _, log_prob = sample_tanh_gaussian(loc, torch.ones(3), torch.zeros(3))
    (-log_prob.sum()).backward()
    torch.testing.assert_close(loc.grad, torch.tensor([-2.0, 2.0, -2.0]))
    np.testing.assert_allclose(log_cosh(torch.tensor([-1e4, 0.0, 1e4])), [1e4 - np.log(2), 0, 1e4 - np.log(2)])


@settings(max_examples=60, deadline=None)
@given(st.floats(-1e4, 1e4), st.floats(1e-6, 1e4), st.integers(0, 2**31))
def test_no_nan(loc: float, scale: float, seed: int) -> None:
    torch.manual_seed(seed)
    mu = torch.tensor([loc], requires_grad=True)
    sigma = torch.tensor([scale], requires_grad=True)
    action, log_prob = sample_tanh_gaussian(mu, sigma)
    entropy = tanh_gaussian_entropy(mu, sigma, 50)
    assert action.abs().max() <= 1 and log_prob.isfinite().all() and entropy.isfinite().all()
    (entropy.sum() + log_prob.sum() + action.sum()).backward()
    assert mu.grad is not None and mu.grad.isfinite().all()
    assert sigma.grad is not None and sigma.grad.isfinite().all()
    assert tanh_gaussian_log_prob(torch.tensor([1.0]), mu, sigma).isfinite().all()


def test_float32_under_autocast() -> None:
    loc, scale = torch.randn(8, 3), torch.rand(8, 3) + 0.1
    loc.requires_grad_()
    torch.manual_seed(0)
    plain = tanh_gaussian_entropy(loc, scale)
    torch.manual_seed(0)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = tanh_gaussian_entropy(loc, scale)
    assert torch.equal(plain, cast) and cast.dtype == torch.float32
    expected, actual = (torch.autograd.grad(x.sum(), loc)[0] for x in (plain, cast))
    assert torch.equal(expected, actual)
    assert at_least_float32(torch.zeros(1, dtype=torch.float16)).dtype == torch.float32


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match="num_samples must be at least 1, got 0"):
        tanh_gaussian_entropy(torch.zeros(2), torch.ones(2), 0)
