"""Small losses with style, learners of them, and batches."""

import torch
from tensordict import TensorDict
from torchrl.objectives import SACLoss

from coachable.distributions.action_heads import ActionHeads
from coachable.fast import accelerate
from coachable.losses import CatRACLoss, QRSACLoss
from coachable.networks import make_critic, make_gaussian_actor
from coachable.networks.hl_gauss_critic import make_hl_gauss_critic
from coachable.networks.mixed import make_mixed_actor
from coachable.training import Learner

OBS, ACT = 7, 3
WIDTHS = (64, 48)


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


def qr_sac():
    actor = make_gaussian_actor(OBS, ACT, ScaledStyle(), WIDTHS)
    critics = [make_critic(OBS, ACT, ScaledStyle(), WIDTHS, num_outputs=8) for _ in range(2)]
    return QRSACLoss(actor, critics, num_quantiles=8)


def cat_rac():
    heads = ActionHeads(axes=ACT)
    critics = [make_hl_gauss_critic(OBS, ACT, ScaledStyle(), WIDTHS) for _ in range(2)]
    return CatRACLoss(make_mixed_actor(OBS, heads, ScaledStyle(), WIDTHS), critics, entropy_samples=10)


def make_learner(loss, fast, **options):
    """A learner in plain torch, or one with hand-written passes."""
    learner = Learner(loss, **options)
    assert accelerate(learner, "on" if fast else "off") is fast
    return learner


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
