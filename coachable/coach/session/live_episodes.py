"""A policy in one environment, episode after episode."""

from __future__ import annotations

from collections import Counter

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from coachable.domain import Domain
from coachable.evaluation.rollouts import Rollout
from coachable.styles import StyleSpace

TIME_IS_UP = "time is up"


class LiveEpisodes(Rollout):
    """Step one environment with a policy and count how episodes end.

    Args:
        domain: gives the environment.
        space: its styles.
        endless: go on when the domain's time limit is reached.
        terminated: what a terminated episode is called.

    Attributes:
        env: of batch size 1.
        ended: why the episode is over, None while it runs.
        number: of the episode, from 1.
        steps: since the episode began.
        endings: how many episodes ended for which reason.
    """

    def __init__(self, domain: Domain, space: StyleSpace, *, endless: bool, terminated: str) -> None:
        self.endless, self._terminated = endless, terminated
        self.ended: str | None = None
        self.number = self.steps = 0
        self.endings: Counter[str] = Counter()
        super().__init__(domain.styled_env(space, 1, num_threads=1, **domain.coached))

    @property
    def base_env(self) -> EnvBase:
        """The domain's own environment, below the transforms."""
        env = self.env
        while isinstance(env, TransformedEnv):
            env = env.base_env
        return env

    def seed(self, seed: int) -> None:
        """Start over; `begin` must follow."""
        super().seed(seed)
        self.number = 0
        self.endings.clear()

    def begin(self, style: Tensor) -> None:
        """Begin the next episode with a style (d,)."""
        super().begin(style[None])
        self.number += 1
        self.steps = 0
        self.ended = None

    def step(self, policy: TensorDictModuleBase, style: Tensor) -> TensorDictBase:
        """Make one step under a style (d,); return the transition, batch shape (1,)."""
        transition = super().step(policy, style[None])
        self.steps += 1
        after = transition.get("next")
        if after.get("terminated").any():
            self.ended = self._terminated
        elif after.get("done").any() and not self.endless:
            self.ended = TIME_IS_UP
        if self.ended is not None:
            self.endings[self.ended] += 1
        return transition

    def close(self) -> None:
        """Release the environment."""
        if not self.env.is_closed:
            self.env.close()
