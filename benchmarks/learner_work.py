"""The work of the learner's benchmark: sizes, its operations, and a batch.

Batch 256, observation 84 + style 4, action 21, policy and twin critics of 3 x 512 (or LEARNER_WIDTH), fixed temperature
0.01, squared error, Adam, Polyak 0.005.
"""

import os

B, OBS, STYLE, ACT, LAYERS = 256, 84, 4, 21, 3
WIDTH = int(os.environ.get("LEARNER_WIDTH", "512"))
ALPHA, GAMMA, TAU, LR = 0.01, 0.99, 0.005, 1e-4


def macs_per_sample() -> int:
    """Multiply-accumulates of one update per sample: what the algorithm needs, without any shortcut.

    No gradients for inputs that need none, none for the critics' weights in the policy's loss.
    """
    trunk = (LAYERS - 1) * WIDTH * WIDTH
    actor = (OBS + STYLE) * WIDTH + trunk + WIDTH * 2 * ACT
    critic = (OBS + STYLE + ACT) * WIDTH + trunk + WIDTH
    actor_dx = trunk + WIDTH * 2 * ACT
    critic_dx = trunk + WIDTH
    target = actor + 2 * critic
    critic_loss = 2 * (critic + critic + critic_dx)
    actor_loss = actor + 2 * critic + 2 * (critic_dx + ACT * WIDTH) + actor + actor_dx
    return target + critic_loss + actor_loss


def flops_per_update() -> int:
    return 2 * B * macs_per_sample()


def make_batch(size=B):
    """Return `size` random transitions, which are the same at each call."""
    import torch
    from tensordict import TensorDict

    gen = torch.Generator().manual_seed(0)

    def normal(n):
        return torch.randn(size, n, generator=gen)

    style = torch.rand(size, STYLE, generator=gen)
    done = torch.zeros(size, 1, dtype=torch.bool)
    done[::50] = True
    batch = {"observation": normal(OBS), "style": style, "action": torch.tanh(normal(ACT))}
    following = {"observation": normal(OBS), "style": style, "reward": normal(1), "done": done, "terminated": done}
    return TensorDict(batch | {"next": following}, [size])


class ScaledStyle:
    dim = STYLE

    def encode(self, theta):
        return theta * 0.5
