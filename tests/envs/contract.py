"""What the tests of every simulator do with an environment."""

from collections.abc import Callable, Iterable

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase


def roll(env: EnvBase, actions: Iterable[torch.Tensor]) -> TensorDictBase:
    """Return `next` of each step (steps, N), without resets in between."""
    current, seen = env.reset(), []
    for action in actions:
        current = env.step(current.set("action", action))["next"]
        seen.append(current.clone())
    return torch.stack(seen)


def assert_set_seed_restarts_the_stream(make_env: Callable[..., EnvBase]) -> None:
    """Check that the episodes after `set_seed` are those of the seed, and that later ones differ from them."""
    env = make_env()
    env.set_seed(5)
    first = env.reset()["observation"]
    env.set_seed(5)
    assert torch.equal(env.reset()["observation"], first)
    assert not torch.equal(env.reset()["observation"], first)
    assert torch.equal(make_env(seed=5).reset()["observation"], first)
