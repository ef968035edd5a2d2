import pytest
import torch
from tensordict import TensorDict

from coachable.networks.critics import StyleCritic, make_critic


class ScaledStyle:
    dim = 3

    def encode(self, theta):
        return theta / 2


@pytest.mark.parametrize("num_outputs", [1, 32])
@pytest.mark.parametrize("shape", [(4,), (4, 5)])
def test_keys_and_shapes(num_outputs, shape):
    critic = make_critic(6, 2, ScaledStyle(), (16, 16), num_outputs=num_outputs)
    sizes = {"observation": 6, "action": 2, "style": 3}
    td = TensorDict({key: torch.randn(*shape, size) for key, size in sizes.items()}, shape)
    assert list(critic.in_keys) == ["observation", "action", "style"]
    assert critic(td)["state_action_value"].shape == (*shape, num_outputs)


def test_input_is_observation_encoded_style_action():
    critic = StyleCritic(ScaledStyle(), 6 + 2, 1, (16, 16))
    obs, action, style = torch.randn(4, 6), torch.randn(4, 2), torch.randn(4, 3)
    expected = critic.trunk(torch.cat((obs, style / 2, action), -1))
    torch.testing.assert_close(critic(obs, action, style), expected, rtol=0, atol=0)
    with pytest.raises(ValueError, match="conditioned on a style"):
        critic(obs, action)


def test_without_style():
    critic = make_critic(6, 2, None, (16,))
    assert list(critic.in_keys) == ["observation", "action"]
    td = TensorDict({"observation": torch.randn(3, 6), "action": torch.randn(3, 2)}, [3])
    assert critic(td)["state_action_value"].shape == (3, 1)


class Squares:
    width = 2

    def __call__(self, action):
        return action.square()


def test_features_of_the_action_come_last():
    critic = make_critic(6, 2, ScaledStyle(), (16, 16), action_features=Squares()).module
    obs, action, style = torch.randn(4, 6), torch.randn(4, 2, requires_grad=True), torch.randn(4, 3)
    value = critic(obs, action, style)
    expected = critic.trunk(torch.cat((obs, style / 2, action, action**2), -1))
    torch.testing.assert_close(value, expected, rtol=0, atol=0)
    (gradient,) = torch.autograd.grad(value.sum(), action)
    (through,) = torch.autograd.grad(expected.sum(), action)
    torch.testing.assert_close(gradient, through)
