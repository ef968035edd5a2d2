"""Episodes under given styles, recorded step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from coachable.domain import StyleMeasures
from coachable.keys import STYLE, TASK_REWARD
from coachable.training.rng import RandomStream

StyleSchedule = Callable[[int], Tensor]


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


@torch.no_grad()
def record_episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    style: Tensor | StyleSchedule,
    measures: StyleMeasures,
    *,
    steps: int,
    seed: int,
    on_step: Callable[[int], None] | None = None,
    progress: str | None = None,
) -> EpisodeRecord:
    """Run one episode in each env; the policy acts as it does by default (`default_interaction_type`).

    Args:
        env: N envs with style transforms.
        policy: reads `observation` and `style`.
        style: theta (N, d) for whole episodes, or a function from the step to theta, for styles that change.
        measures: the domain's measured style.
        steps: length of the episodes; an env that ended earlier is stepped on but no longer recorded.
        seed: of the initial states, and of the actions where they are sampled.
        on_step: called with the step after each, to draw frames for example.
        progress: label of a progress bar; None shows none.
    """
    schedule: StyleSchedule = style if callable(style) else lambda _: style
    env.set_seed(seed)
    current = env.reset(TensorDict({STYLE: schedule(0)}, env.batch_size))
    alive = torch.ones(env.batch_size, dtype=torch.bool)
    survived, task_return = alive.clone(), torch.zeros(env.batch_size)
    rows: list[dict[str, Tensor]] = []
    styles, lives = [], []
    with RandomStream(seed).drawn():
        for step in tqdm(range(steps), desc=progress, disable=True if progress is None else None, leave=False):
            theta = schedule(step)
            transition = env.step(policy(current.set(STYLE, theta)))
            after = transition.get("next")
            rows.append(measures.step(transition))
            styles.append(theta)
            lives.append(alive)
            task_return += torch.where(alive, after.get(TASK_REWARD).squeeze(-1), 0.0)
            survived &= ~(alive & after.get("terminated").squeeze(-1))
            if on_step is not None:
                on_step(step)
            alive = alive & ~after.get("done").squeeze(-1)
            if not alive.any():
                break
            current = step_mdp(transition)
    return EpisodeRecord(
        measures={name: torch.stack([row[name] for row in rows]) for name in rows[0]},
        style=torch.stack(styles),
        alive=torch.stack(lives),
        survived=survived,
        task_return=task_return,
    )
