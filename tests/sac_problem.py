"""A small SAC loss with style, and batches for it."""

import torch
from tensordict import TensorDict
from torchrl.objectives import SACLoss

from coachable.networks import make_critic, make_gaussian_actor

OBS, ACT = 7, 3


class ScaledStyle:
    dim = 2

    def encode(self, theta):
        return theta / 2


def make_loss(seed=0, width=32, fixed_alpha=True, loss_function="l2", **kwargs):
    torch.manual_seed(seed)
    space, widths = ScaledStyle(), (width, width)
    critics = [make_critic(OBS, ACT, space, widths) for _ in range(2)]
    loss = SACLoss(
        make_gaussian_actor(OBS, ACT, space, widths),
        critics,
        loss_function=loss_function,
        fixed_alpha=fixed_alpha,
        alpha_init=0.01,
        action_spec=None,
        **kwargs,
    )
    loss.make_value_estimator(gamma=0.99)
    return loss


def make_batch(*shape, seed=1):
    gen = torch.Generator().manual_seed(seed)

    def normal(n):
        return torch.randn(*shape, n, generator=gen)

    style = normal(2)
    terminated = torch.rand(*shape, 1, generator=gen) < 0.1
    return TensorDict(
        {
            "observation": normal(OBS),
            "style": style,
            "action": torch.tanh(normal(ACT)),
            "next": {
                "observation": normal(OBS),
                "style": style,
                "reward": normal(1),
                "done": terminated,
                "terminated": terminated,
                "truncated": torch.zeros_like(terminated),
            },
        },
        shape,
    )
