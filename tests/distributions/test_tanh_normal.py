import pytest
import torch
from torch.distributions import kl_divergence
from torchrl.modules import TanhNormal

from coachable.distributions.tanh_gaussian import sample_tanh_gaussian
from coachable.distributions.tanh_normal import TanhGaussian


def parameters(*shape):
    torch.manual_seed(0)
    loc = (2 * torch.randn(*shape, dtype=torch.float64)).requires_grad_()
    scale = (torch.rand(*shape, dtype=torch.float64) + 0.05).requires_grad_()
    return loc, scale


@pytest.mark.parametrize("sample_shape", [(), (3,)])
def test_sample_score_and_their_gradients_equal_autograd(sample_shape):
    loc, scale = parameters(5, 4)
    torch.manual_seed(1)
    action, log_prob = TanhGaussian(loc, scale).rsample_and_log_prob(sample_shape)
    torch.manual_seed(1)
    noise = torch.randn(*sample_shape, 5, 4, dtype=torch.float64)
    expected, per_axis = sample_tanh_gaussian(loc, scale, noise)
    torch.testing.assert_close(action, expected)
    torch.testing.assert_close(log_prob, per_axis.sum(-1))
    weight, other = torch.randn_like(action), torch.randn_like(log_prob)
    got = torch.autograd.grad((action * weight).sum() + (log_prob * other).sum(), (loc, scale))
    want = torch.autograd.grad((expected * weight).sum() + (per_axis.sum(-1) * other).sum(), (loc, scale))
    torch.testing.assert_close(got, want)


def test_same_distribution_as_torchrl():
    loc, scale = (t.detach().float() for t in parameters(5, 4))
    ours, theirs = TanhGaussian(loc, scale), TanhNormal(loc, scale)
    action = torch.rand(5, 4) * 1.8 - 0.9
    torch.testing.assert_close(ours.log_prob(action), theirs.log_prob(action), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours.deterministic_sample, theirs.deterministic_sample)
    assert ours.batch_shape == theirs.batch_shape
    assert ours.event_shape == theirs.event_shape
    assert isinstance(ours, TanhNormal)
    torch.testing.assert_close(ours.expand((3, 5)).log_prob(action), ours.log_prob(action).expand(3, 5))


def test_score_of_a_detached_sample_has_the_score_function_gradient():
    loc, scale = parameters(5, 4)
    action, log_prob = TanhGaussian(loc, scale).sample_and_log_prob()
    assert not action.requires_grad
    got = torch.autograd.grad(log_prob.sum(), (loc, scale))
    z = (torch.atanh(action) - loc) / scale
    torch.testing.assert_close(log_prob, TanhGaussian(loc, scale).log_prob(action))
    torch.testing.assert_close(got[0], z / scale)
    torch.testing.assert_close(got[1], (z.square() - 1) / scale)


def test_saturated_actions_have_exact_scores():
    """Standard normal at u = 30 exactly: -log sqrt(2 pi) - 2 log 2 + 2 * 30, up to e^-60."""
    torch.manual_seed(0)
    loc, scale = torch.full((1, 1), 30.0), torch.full((1, 1), 1e-6)
    _, log_prob = TanhGaussian(loc, scale).rsample_and_log_prob()
    torch.manual_seed(0)
    noise = torch.randn(1, 1)
    expected = -0.9189385 - 0.5 * noise.square() + 13.8155106 - 1.3862944 + 60.0
    torch.testing.assert_close(log_prob, expected.squeeze(-1), rtol=1e-6, atol=1e-5)


def test_samples_stay_in_the_box_and_sampling_needs_no_gradient():
    loc, scale = parameters(100, 4)
    sample = TanhGaussian(loc, scale).sample((7,))
    assert sample.shape == (7, 100, 4)
    assert not sample.requires_grad
    assert sample.abs().max() <= 1
    assert TanhGaussian(loc, scale).rsample().requires_grad


def test_divergences_are_those_of_torchrls_distribution():
    first, second = parameters(5, 4), [p.detach() + 0.1 for p in parameters(5, 4)]
    ours = kl_divergence(TanhGaussian(*first), TanhGaussian(*second))
    torch.testing.assert_close(ours, kl_divergence(TanhNormal(*first), TanhNormal(*second)))
