"""Episodes under given styles, recorded step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypedDict

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from coachable.domain import Domain, StyleMeasures
from coachable.keys import STYLE, TASK_REWARD
from coachable.styles import StyleSpace
from coachable.training.rng import RandomStream

StyleSchedule = Callable[[int], Tensor]


class RolloutOptions(TypedDict, total=False):
    """How episodes are run, whatever is measured in them: keyword arguments that all evaluations share.

    Attributes:
        steps: length of an episode; default: the domain's.
        seed: of the initial states, of styles that are drawn, and of sampled actions; default 0. The same seed gives
            the same results.
        num_threads: physics threads, where the simulator has its own; default: all free cores.
        progress: whether to show a progress bar; default: yes.
    """

    steps: int | None
    seed: int
    num_threads: int | None
    progress: bool


class Rollout:
    """Let a policy act in a batch of environments, step by step, under styles that may change at any step.

    Every loop in this package that acts does it through this class, so that seeds mean the same everywhere.

    Args:
        env: N environments with style transforms.
        seed: of the initial states, and of the actions where they are sampled.
    """

    def __init__(self, env: EnvBase, seed: int = 0) -> None:
        self.env = env
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Seed initial states and actions; `begin` must follow."""
        self.env.set_seed(seed)
        self._chance = RandomStream(seed)

    def begin(self, style: Tensor) -> None:
        """Begin new episodes in all environments, with styles (N, d)."""
        self._current: TensorDictBase = self.env.reset(TensorDict({STYLE: style}, self.env.batch_size))

    @property
    def observation(self) -> Tensor:
        """What the policy will see next, (N, F)."""
        return self._current.get("observation")

    @torch.no_grad()
    def step(self, policy: TensorDictModuleBase, style: Tensor) -> TensorDictBase:
        """Make one step under styles (N, d); return the transition, batch shape (N,)."""
        with self._chance.drawn():
            transition = self.env.step(policy(self._current.set(STYLE, style)))
        self._current = step_mdp(transition)
        return transition

    def begin_ended(self) -> None:
        """Begin new episodes where the last step ended one."""
        self._current = self.env.maybe_reset(self._current)


@dataclass(frozen=True)
class EpisodeRecord:
    """N episodes of up to T steps.

    Attributes:
        measures: name to (T, N), what the domain measures in each step.
        style: (T, N, d) theta that the policy saw.
        alive: (T, N) bool, steps before and including the end of the episode.
        survived: (N,) bool, the episode did not terminate (it may have been truncated).
        task_return: (N,) sum of task rewards.
    """

    measures: dict[str, Tensor]
    style: Tensor
    alive: Tensor
    survived: Tensor
    task_return: Tensor


def record_episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    style: Tensor | StyleSchedule,
    measures: StyleMeasures,
    *,
    steps: int,
    seed: int,
    progress: str | None = None,
) -> EpisodeRecord:
    """Run one episode in each env; the policy acts as it does by default (`default_interaction_type`).

    Args:
        env: N envs with style transforms. It is closed at the end.
        policy: reads `observation` and `style`.
        style: theta (N, d) for whole episodes, or a function from the step to theta, for styles that change.
        measures: the domain's measured style.
        steps: length of the episodes; an env that ended earlier is stepped on but no longer recorded.
        seed: of the initial states, and of the actions where they are sampled.
        progress: label of a progress bar; None shows none.
    """
    schedule: StyleSchedule = style if callable(style) else lambda _: style
    rollout = Rollout(env, seed)
    rollout.begin(schedule(0))
    alive = torch.ones(env.batch_size, dtype=torch.bool)
    survived, task_return = alive.clone(), torch.zeros(env.batch_size)
    rows: list[dict[str, Tensor]] = []
    styles, lives = [], []
    for step in tqdm(range(steps), desc=progress, disable=True if progress is None else None, leave=False):
        theta = schedule(step)
        transition = rollout.step(policy, theta)
        after = transition.get("next")
        rows.append(measures.step(transition))
        styles.append(theta)
        lives.append(alive)
        task_return += torch.where(alive, after.get(TASK_REWARD).squeeze(-1), 0.0)
        survived &= ~(alive & after.get("terminated").squeeze(-1))
        alive = alive & ~after.get("done").squeeze(-1)
        if not alive.any():
            break
    env.close()
    return EpisodeRecord(
        measures={name: torch.stack([row[name] for row in rows]) for name in rows[0]},
        style=torch.stack(styles),
        alive=torch.stack(lives),
        survived=survived,
        task_return=task_return,
    )


def record_styles(
    domain: Domain,
    policy: TensorDictModuleBase,
    space: StyleSpace,
    style: Tensor | StyleSchedule,
    label: str,
    *,
    measures: StyleMeasures | None = None,
    steps: int | None = None,
    seed: int = 0,
    num_threads: int | None = None,
    progress: bool = True,
    **env_options: Any,
) -> EpisodeRecord:
    """Run one episode per style in a domain, all of them in one batch.

    Args:
        domain: what to run in.
        policy: reads `observation` and `style`.
        space: its styles.
        style: theta (N, d) for whole episodes, or a function from the step to theta, for styles that change.
        label: of the progress bar.
        measures: what is measured; default: the domain's measured style.
        steps: see `RolloutOptions`.
        seed: see `RolloutOptions`.
        num_threads: see `RolloutOptions`.
        progress: see `RolloutOptions`.
        **env_options: further arguments of `Domain.styled_env`.
    """
    count = len(style(0) if callable(style) else style)
    return record_episodes(
        domain.styled_env(space, count, seed=seed, num_threads=num_threads, **env_options),
        policy,
        style,
        domain.measures if measures is None else measures,
        steps=steps or domain.episode_steps,
        seed=seed,
        progress=label if progress else None,
    )
