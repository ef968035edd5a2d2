"""A policy in one environment, episode after episode."""

from __future__ import annotations

from collections import Counter

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import step_mdp

from coachable.domain import Domain
from coachable.keys import STYLE
from coachable.styles import StyleSpace
from coachable.training.rng import RandomStream

TIME_IS_UP = "time is up"


class LiveEpisodes:
    """Steps one environment with a policy and counts how episodes end.

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
        self.env = domain.styled_env(space, 1, num_threads=1, **domain.coached)
        self.endless, self._terminated = endless, terminated
        self.ended: str | None = None
        self.number = self.steps = 0
        self._chance = RandomStream(0)
        self.endings: Counter[str] = Counter()

    @property
    def base_env(self) -> EnvBase:
        """The domain's own environment, below the transforms."""
        env: EnvBase = self.env
        while isinstance(env, TransformedEnv):
            env = env.base_env
        return env

    @property
    def observation(self) -> Tensor:
        """What the policy will see next, (1, F)."""
        return self._current.get("observation")

    def seed(self, seed: int) -> None:
        """Starts over; `begin` must follow."""
        self.env.set_seed(seed)
        self._chance = RandomStream(seed)
        self.number = 0
        self.endings.clear()

    def begin(self, theta: Tensor) -> None:
        """Begins the next episode with a style (d,)."""
        self._current: TensorDictBase = self.env.reset(TensorDict({STYLE: theta[None]}, [1]))
        self.number += 1
        self.steps = 0
        self.ended = None

    def step(self, policy: TensorDictModuleBase, theta: Tensor) -> TensorDictBase:
        """One step under a style (d,); returns the transition, batch shape (1,)."""
        with self._chance.drawn():
            action = policy(self._current.set(STYLE, theta[None]))
        transition = self.env.step(action)
        self.steps += 1
        after = transition.get("next")
        if after.get("terminated").any():
            self.ended = self._terminated
        elif after.get("done").any() and not self.endless:
            self.ended = TIME_IS_UP
        if self.ended is not None:
            self.endings[self.ended] += 1
        self._current = step_mdp(transition)
        return transition

    def close(self) -> None:
        """Releases the environment."""
        if not self.env.is_closed:
            self.env.close()
