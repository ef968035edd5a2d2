"""Switching test: the style changes while the agent acts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Unpack

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coachable.domain import Domain
from coachable.evaluation.episode_records import RolloutOptions, record_styles
from coachable.styles import StyleSpace


@dataclass(frozen=True)
class SwitchReport:
    """Results of episodes whose style switched at random every `period` steps.

    Attributes:
        metrics: Mean over episodes of survival and of the domain's measures.
        comply_seconds: Time from a switch until the agent complied (S,) [s], for the switches after which it did.
        complied: Share of the switches after which the agent complied before the next one.
        switches: Number of switches in episodes that had not ended; 0 if no step shows whether the agent complied.
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
    **options: Unpack[RolloutOptions],
) -> SwitchReport:
    """Evaluate a policy with a new style from the training distribution every `period` steps.

    No switch counts if the measures have a method `judged`, as in `MeasuredWindow`, that is false in every step. Then
    compliance cannot be judged, such as savings of fuel without a comparison.

    Args:
        domain: Domain in which the policy acts.
        policy: Policy that reads `observation` and `style`.
        space: Its style space.
        episodes: Number of episodes.
        period: Number of env steps between switches.
        **options: See `RolloutOptions`.

    Raises:
        ValueError: If the period is below 1.
    """
    if period < 1:
        raise ValueError(f"period must be at least 1 step, got {period}")
    generator = torch.Generator().manual_seed(options.get("seed", 0))
    steps = options.get("steps") or domain.episode_steps
    styles = space.sample((-(-steps // period), episodes), generator)
    label = f"{episodes} episodes, style switched every {period} steps"
    record = record_styles(domain, policy, space, lambda step: styles[step // period], label, **options)
    summary = {"survived": record.survived.float(), **domain.measures.summarise(record.measures, record.alive)}
    metrics = {name: value.nanmean().item() for name, value in summary.items()}
    complies = domain.measures.complies(record.measures) & record.alive
    judge = getattr(domain.measures, "judged", None)
    is_known = judge is None or bool((judge(record.measures) & record.alive).any())
    waits, switches = [], 0
    for start in range(period, len(complies) if is_known else 0, period):
        running = record.alive[start]
        done, first = complies[start : start + period].max(0)
        switches += int(running.sum())
        waits.append((first[running & done] + 1) * domain.control_step)
    times = torch.cat(waits) if waits else torch.empty(0)
    return SwitchReport(metrics, times, len(times) / switches if switches else float("nan"), switches)
