"""`Rollout`: steps of a policy in a batch of environments, for evaluations, films, sessions and recordings."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from coachable.keys import STYLE
from coachable.training.rng import RandomStream

StyleSchedule = Callable[[int], Tensor]
"""Function from the number of a step, from 0, to theta (N, d)."""


class Rollout:
    """Step-by-step rollout of a policy in a batch of environments, with styles that may change at any step.

    Everything that runs a policy without training it uses this class, so that a seed has the same meaning everywhere.

    Args:
        env: N environments with style transforms.
        seed: Seed of the initial states and of sampled actions. Without one, the environments continue
            their own random streams, and the policy draws from torch's global generator.
    """

    def __init__(self, env: EnvBase, seed: int | None = None) -> None:
        self.env = env
        self._chance: RandomStream | None = None
        if seed is not None:
            self.seed(seed)

    def seed(self, seed: int) -> None:
        """Seed initial states and actions; call `begin` afterwards."""
        self.env.set_seed(seed)
        self._chance = RandomStream(seed)

    def begin(self, style: Tensor | None = None) -> None:
        """Begin new episodes in all environments, with styles (N, d); by default their sampler draws them."""
        start = None if style is None else TensorDict({STYLE: style}, self.env.batch_size)
        self._current: TensorDictBase = self.env.reset(start)

    @property
    def observation(self) -> Tensor:
        """Next observation of the policy (N, F)."""
        return self._current.get("observation")

    @torch.no_grad()
    def step(self, policy: Callable[[TensorDictBase], TensorDictBase], style: Tensor | None = None) -> TensorDictBase:
        """Make one step with styles (N, d), by default those in force; return the transition, batch shape (N,)."""
        if style is not None:
            self._current.set(STYLE, style)
        with nullcontext() if self._chance is None else self._chance.drawn():
            transition = self.env.step(policy(self._current))
        self._current = step_mdp(transition)
        return transition

    def episode(
        self, policy: Callable[[TensorDictBase], TensorDictBase], steps: int, style: StyleSchedule | None = None
    ) -> Iterator[tuple[TensorDictBase, Tensor]]:
        """Step the episodes that `begin` began until each one has ended.

        Episodes that end earlier continue to be stepped.

        Args:
            policy: Policy that writes `action`.
            steps: Largest number of steps.
            style: Styles of each step; by default those in force.

        Yields:
            The transition of each step, batch shape (N,), and the episodes that had not ended before it (N,) bool.
        """
        alive = torch.ones_like(self._current.get("done").squeeze(-1))
        for step in range(steps):
            transition = self.step(policy, None if style is None else style(step))
            yield transition, alive
            alive = alive & ~transition.get(("next", "done")).squeeze(-1)
            if not alive.any():
                break

    def begin_ended(self) -> None:
        """Begin new episodes where the last step ended one."""
        self._current = self.env.maybe_reset(self._current)

    def begin_rows(self, rows: Tensor) -> None:
        """Begin new episodes in some environments, rows (N,) bool, at least one of them."""
        self._current = self.env.reset(self._current.set("_reset", rows.unsqueeze(-1)))
