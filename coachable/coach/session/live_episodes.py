"""Episodes of a policy in one environment, one after the other."""

from collections import Counter

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coachable.domain import Domain
from coachable.styles import StyleSpace
from coachable.training.collection import simulation_env
from coachable.training.rollout import Rollout


class LiveEpisodes(Rollout):
    """Rollout in one environment that counts how episodes end.

    A time limit is ignored if the environment has an attribute `runs_past_time_limit` that is true. Others, such as
    those of Gymnasium and dm_control, begin a new episode by themselves when they are stepped after it.

    Args:
        domain: Domain that makes the environment.
        space: The agent's style space.
        terminated: Reason to report for a terminated episode, such as "fell".

    Attributes:
        env: The environment, of batch size 1.
        ended: Why the episode is over, or None while it runs.
        number: Number of the episode, from 1.
        steps: Number of steps since the episode began.
        endings: Number of episodes that ended, by reason.
    """

    def __init__(self, domain: Domain, space: StyleSpace, *, terminated: str) -> None:
        self._terminated = terminated
        self.ended: str | None = None
        self.number = self.steps = 0
        self.endings: Counter[str] = Counter()
        super().__init__(domain.styled_env(space, 1, num_threads=1, **domain.coached), seed=0)

    @property
    def base_env(self) -> EnvBase:
        """The domain's environment without the transforms around it."""
        return simulation_env(self.env)

    def seed(self, seed: int) -> None:
        """Seed the environment and the actions, and count episodes from 1 again; call `begin` afterwards."""
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
        """Make one step under a raw style (d,), and return the transition, batch shape (1,)."""
        transition = super().step(policy, style[None])
        self.steps += 1
        if transition["next", "terminated"].any():
            self.ended = self._terminated
        elif transition["next", "truncated"].any() and not getattr(self.base_env, "runs_past_time_limit", False):
            self.ended = "reached the time limit"
        if self.ended is not None:
            self.endings[self.ended] += 1
        return transition

    def close(self) -> None:
        """Release the environment."""
        if not self.env.is_closed:
            self.env.close()
