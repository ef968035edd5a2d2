"""Rollouts with given styles, recorded step by step."""

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
    """Keyword arguments of all evaluations.

    Attributes:
        steps: Length of an episode; by default the domain's.
        seed: Seed of the initial states, of drawn styles and of sampled actions; by default 0. The same seed gives the
            same results.
        num_threads: Number of physics threads, if the simulator has its own; by default all free cores.
        progress: Whether to show a progress bar; by default true.
    """

    steps: int | None
    seed: int
    num_threads: int | None
    progress: bool


class Rollout:
    """Step-by-step rollout of a policy in a batch of environments, with styles that may change at any step.

    All evaluations, films and sessions use this class, so that a seed has the same meaning everywhere.

    Args:
        env: N environments with style transforms.
        seed: Seed of the initial states and of sampled actions.
    """

    def __init__(self, env: EnvBase, seed: int = 0) -> None:
        self.env = env
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Seed initial states and actions; call `begin` afterwards."""
        self.env.set_seed(seed)
        self._chance = RandomStream(seed)

    def begin(self, style: Tensor) -> None:
        """Begin new episodes in all environments, with styles (N, d)."""
        self._current: TensorDictBase = self.env.reset(TensorDict({STYLE: style}, self.env.batch_size))

    @property
    def observation(self) -> Tensor:
        """Next observation of the policy (N, F)."""
        return self._current.get("observation")

    @torch.no_grad()
    def step(self, policy: TensorDictModuleBase, style: Tensor) -> TensorDictBase:
        """Make one step with styles (N, d) and return the transition, batch shape (N,)."""
        with self._chance.drawn():
            transition = self.env.step(policy(self._current.set(STYLE, style)))
        self._current = step_mdp(transition)
        return transition

    def begin_ended(self) -> None:
        """Begin new episodes where the last step ended one."""
        self._current = self.env.maybe_reset(self._current)

    def begin_rows(self, rows: Tensor) -> None:
        """Begin new episodes in some environments, rows (N,) bool, at least one of them."""
        self._current = self.env.reset(self._current.set("_reset", rows.unsqueeze(-1)))


@dataclass(frozen=True)
class EpisodeRecord:
    """N episodes of up to T steps.

    Attributes:
        measures: The domain's measures of each step (T, N), by name.
        style: Theta that the policy observed (T, N, d).
        alive: Steps up to and including the end of the episode (T, N) bool.
        survived: Whether the episode did not terminate (N,) bool; it may have been truncated.
        task_return: Sum of task rewards (N,).
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
    """Run one episode in each env, with the policy's `default_interaction_type`.

    Args:
        env: N envs with style transforms; they are closed at the end.
        policy: Policy that reads `observation` and `style`.
        style: Theta (N, d) for whole episodes, or a function from the step to theta, for styles that change.
        measures: The domain's measured style.
        steps: Length of the episodes. Steps after the end of an episode are not counted as alive.
        seed: Seed of the initial states and of sampled actions.
        progress: Label of the progress bar, or None for no bar.
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
        domain: Domain in which the policy acts.
        policy: Policy that reads `observation` and `style`.
        space: Its style space.
        style: Theta (N, d) for whole episodes, or a function from the step to theta, for styles that change.
        label: Label of the progress bar.
        measures: Measures to record; by default the domain's measured style.
        steps: See `RolloutOptions`.
        seed: See `RolloutOptions`.
        num_threads: See `RolloutOptions`.
        progress: See `RolloutOptions`.
        **env_options: Further arguments of `Domain.styled_env`.
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
