import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coachable.networks.actors import GaussianPolicy, make_gaussian_actor
from coachable.networks.critics import make_critic
from coachable.networks.residual import ResidualBlock


class ScaledStyle:
    """The part of a style space that a network uses: theta / 2."""

    dim = 3

    def encode(self, theta):
        return theta / 2


def _batch(*shape):
    return TensorDict({"observation": torch.randn(*shape, 5), "style": torch.randn(*shape, 3)}, shape)


def test_keys_and_shapes():
    actor = make_gaussian_actor(5, 2, ScaledStyle(), (16, 16))
    assert list(actor.in_keys) == ["observation", "style"]
    out = actor(_batch(4, 3))
    assert out["action"].shape == (4, 3, 2)
    assert out["loc"].shape == out["scale"].shape == (4, 3, 2)
    assert out["action"].abs().max() <= 1
    spec = actor.spec["action"]
    assert (spec.shape, spec.low.tolist(), spec.high.tolist()) == ((2,), [-1.0, -1.0], [1.0, 1.0])


def test_networks_have_the_papers_widths_unless_told_otherwise():
    for network in (make_gaussian_actor(5, 2, ScaledStyle()), make_critic(5, 2, ScaledStyle())):
        widths = [part.linear.out_features for part in network.modules() if isinstance(part, ResidualBlock)]
        assert widths == [512, 512, 512]


def test_style_is_encoded_inside():
    policy = GaussianPolicy(5, 2, ScaledStyle(), (16, 16), log_scale_range=(-5.0, 2.0))
    td = _batch(4)
    loc, _ = policy(td["observation"], td["style"])
    expected = policy.trunk(torch.cat((td["observation"], td["style"] / 2), -1))[:, :2]
    torch.testing.assert_close(loc, expected, rtol=0, atol=0)


def test_scale_stays_in_its_range_and_is_rac_scale_for_symmetric_range():
    policy = GaussianPolicy(5, 2, None, (16, 16), log_scale_range=(-2.0, 2.0))
    x = 100 * torch.randn(50, 5)
    loc_raw = policy.trunk(x)
    _, scale = policy(x)
    torch.testing.assert_close(scale, torch.exp(2 * torch.tanh(loc_raw[:, 2:])))
    assert scale.min() >= math.exp(-2) * 0.999
    assert scale.max() <= math.exp(2) * 1.001


def test_deterministic_action_is_tanh_of_location():
    actor = make_gaussian_actor(5, 2, None, (16, 16))
    td = TensorDict({"observation": torch.randn(4, 5)}, [4])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        out = actor(td)
    torch.testing.assert_close(out["action"], torch.tanh(out["loc"]))


def test_entropy_estimate_agrees_with_quadrature():
    """Entropy of tanh(N(mu, sigma^2)) by quadrature, with the standard deviation of one sample."""
    torch.manual_seed(0)
    actor = make_gaussian_actor(5, 1, None, (16, 16))
    for mu, sigma, entropy, sd in [
        (0.0, math.exp(-2), -0.599213, 0.682),
        (0.0, 1.0, 0.669804, 0.218),
        (0.5, 1.0, 0.520242, 0.628),
        (0.0, math.exp(2), -7.074345, 8.144),
    ]:
        n = 4000
        params = TensorDict({"loc": torch.full((n, 1), mu), "scale": torch.full((n, 1), sigma)}, [n])
        _, log_prob = actor.build_dist_from_params(params).rsample_and_log_prob()
        assert log_prob.shape == (n,)
        assert abs(-log_prob.mean().item() - entropy) < 5 * sd / math.sqrt(n)


def test_missing_style_and_bad_range_raise():
    with pytest.raises(ValueError, match="conditioned on a style"):
        GaussianPolicy(5, 2, ScaledStyle(), (16,), log_scale_range=(-5.0, 2.0))(torch.zeros(1, 5))
    with pytest.raises(ValueError, match=r"under 'style', of which losses also read \('next', 'style'\)"):
        make_gaussian_actor(5, 2, ScaledStyle(), (16,))(TensorDict({"observation": torch.zeros(1, 5)}, [1]))
    with pytest.raises(ValueError, match="low < high"):
        GaussianPolicy(5, 2, None, (16,), log_scale_range=(2.0, -2.0))
