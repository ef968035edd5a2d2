"""Styles that change while the agent acts: does its episode go on, and how soon does it comply?"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coachable.domain import Domain
from coachable.evaluation.rollouts import record_episodes
from coachable.styles import StyleSpace


@dataclass(frozen=True)
class SwitchReport:
    """Episodes whose style switched at random every `period` steps.

    Attributes:
        metrics: mean over episodes of survival and of the domain's measures.
        comply_seconds: time from each switch until the agent did what was asked, of the switches where it did [s].
        complied: share of the switches after which it did before the next one.
        switches: number of switches that count, i.e. those of agents still in the episode.
    """

    metrics: dict[str, float]
    comply_seconds: Tensor
    complied: float
    switches: int


def evaluate_switching(
    domain: Domain,
    policy: TensorDictModuleBase,
    space: StyleSpace,
    *,
    episodes: int = 60,
    period: int = 100,
    steps: int | None = None,
    seed: int = 0,
    num_threads: int | None = None,
    progress: bool = True,
) -> SwitchReport:
    """Draw a new style from the training distribution every `period` steps.

    Args:
        domain: what to run in.
        policy: reads `observation` and `style`.
        space: the policy's style space.
        episodes: number of episodes.
        period: env steps between switches.
        steps: length of an episode; default: the domain's.
        seed: of the initial states and of the styles.
        num_threads: physics threads.
        progress: show a bar.
    """
    if period < 1:
        raise ValueError(f"period must be at least 1 step, got {period}")
    steps = steps or domain.episode_steps
    generator = torch.Generator().manual_seed(seed)
    styles = space.sample((-(-steps // period), episodes), generator)
    env = domain.styled_env(space, episodes, seed=seed, num_threads=num_threads)
    record = record_episodes(
        env,
        policy,
        lambda step: styles[step // period],
        domain.measures,
        steps=steps,
        seed=seed,
        progress=f"{episodes} episodes, style switched every {period} steps" if progress else None,
    )
    env.close()
    summary = {"survived": record.survived.float(), **domain.measures.summarise(record.measures, record.alive)}
    metrics = {name: value.nanmean().item() for name, value in summary.items()}
    complies = domain.measures.complies(record.measures) & record.alive
    waits, switches = [], 0
    for start in range(period, len(complies), period):
        running = record.alive[start]
        done, first = complies[start : start + period].max(0)
        switches += int(running.sum())
        waits.append((first[running & done] + 1) * domain.control_step)
    times = torch.cat(waits) if waits else torch.empty(0)
    return SwitchReport(metrics, times, len(times) / switches if switches else float("nan"), switches)
