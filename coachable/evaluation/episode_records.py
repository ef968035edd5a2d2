"""Episodes with given styles, recorded step by step."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Any, TypedDict

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm import tqdm

from coachable.domain import Domain, StepMeasures, accepts
from coachable.keys import STYLE, TASK_REWARD
from coachable.styles import StyleSpace
from coachable.training.rollout import Rollout, StyleSchedule


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
    measures: StepMeasures,
    *,
    steps: int,
    seed: int,
    progress: str | None = None,
    watch: Callable[[Tensor], None] = lambda alive: None,
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
        watch: Function that is called at the start and after each step, with the rows (N,) whose episodes ran until
            then.
    """
    schedule: StyleSchedule = style if callable(style) else lambda _: style
    with closing(env):
        rollout = Rollout(env, seed)
        rollout.begin(schedule(0))
        survived = torch.ones(env.batch_size, dtype=torch.bool)
        task_return = torch.zeros(env.batch_size)
        rows: list[dict[str, Tensor]] = []
        styles, lives = [], []
        watch(survived)
        run = rollout.episode(policy, steps, schedule)
        for transition, alive in tqdm(run, progress, steps, disable=True if progress is None else None, leave=False):
            after = transition.get("next")
            rows.append(measures.step(transition))
            styles.append(transition.get(STYLE))
            lives.append(alive)
            task_return += torch.where(alive, after.get(TASK_REWARD).squeeze(-1), 0.0)
            survived &= ~(alive & after.get("terminated").squeeze(-1))
            watch(alive)
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
    measures: StepMeasures | None = None,
    steps: int | None = None,
    seed: int = 0,
    num_threads: int | None = None,
    progress: bool = True,
    **env_options: Any,
) -> EpisodeRecord:
    """Run one episode per style in a domain, all of them in one batch, and record the domain's or other measures.

    Styles are theta (N, d) for whole episodes, or a function from the step to theta, for styles that change. The label
    is that of the progress bar. `RolloutOptions` describes `steps`, `seed`, `num_threads` and `progress`; other options
    are those of `Domain.styled_env`.

    Raises:
        ValueError: If `steps` exceeds the length of an episode, and the environment takes no `episode_steps`.
    """
    if steps is not None and steps > domain.episode_steps:
        if not accepts(domain.make_env, "episode_steps"):
            raise ValueError(f"steps is {steps}: expected at most {domain.episode_steps}, the length of an episode")
        env_options = {"episode_steps": steps, **env_options}
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
