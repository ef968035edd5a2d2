"""Switching test: the style changes while the agent acts."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Unpack

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coachable.domain import Domain, StyleMeasures
from coachable.evaluation.episode_records import RolloutOptions, record_styles
from coachable.styles import StyleSpace

SWITCH_PERIOD = 100
"""Number of env steps between switches of the style, in episodes of at least four times as many."""


@dataclass(frozen=True)
class SwitchReport:
    """Results of episodes whose style switched at random.

    Attributes:
        period: Number of env steps between switches.
        metrics: Mean over episodes of survival and of the domain's measures.
        comply_seconds: Time from a switch until the agent complied (S,) [s], for the switches after which it did.
        complied: Share of the switches after which the agent complied before the next one.
        switches: Number of switches in episodes that had not ended; 0 if all ended before, or no step shows whether the
            agent complied.
    """

    period: int
    metrics: dict[str, float]
    comply_seconds: Tensor
    complied: float
    switches: int

    @property
    def median_seconds(self) -> float:
        """Median of `comply_seconds` [s], the mean of the two middle ones if their number is even; NaN without any."""
        return self.comply_seconds.quantile(0.5).item() if len(self.comply_seconds) else float("nan")


def evaluate_switching(
    domain: Domain, policy: TensorDictModuleBase, space: StyleSpace, *, episodes: int, **options: Unpack[RolloutOptions]
) -> SwitchReport:
    """Evaluate a policy with a new style from the training distribution every 100 steps, or four times an episode.

    No switch counts if compliance cannot be judged in any step, such as savings of fuel without a comparison. The
    arguments are those of `evaluate_grid`, but `episodes` is the number of all episodes.
    """
    generator = torch.Generator().manual_seed(options.get("seed", 0))
    steps = options.get("steps") or domain.episode_steps
    period = min(SWITCH_PERIOD, max(1, steps // 4))
    styles = space.sample((-(-steps // period), episodes), generator)
    label = f"{episodes} episodes, style switched every {period} steps"
    record = record_styles(domain, policy, space, lambda step: styles[step // period], label, **options)
    summary = {"survived": record.survived.float(), **domain.measures.summarise(record.measures, record.alive)}
    summary.pop("complied", None)  # racing's share of the steps; below are the shares of the switches
    metrics = {name: value.nanmean().item() for name, value in summary.items()}
    complies = domain.measures.complies(record.measures) & record.alive
    is_known = bool((judged_steps(domain.measures, record.measures) & record.alive).any())
    waits, switches = [], 0
    last = min(len(complies) - 1, steps - period) if is_known else 0  # a whole period may follow each switch
    for start in range(period, last + 1, period):
        running = record.alive[start]
        done, first = complies[start : start + period].max(0)
        switches += int(running.sum())
        waits.append((first[running & done] + 1) * domain.control_step)
    times = torch.cat(waits) if waits else torch.empty(0)
    return SwitchReport(period, metrics, times, len(times) / switches if switches else float("nan"), switches)


def judged_steps(measures: StyleMeasures, record: Mapping[str, Tensor]) -> Tensor:
    """Return the steps (T, N) bool in which compliance can be judged.

    Args:
        measures: The domain's measured style. If it has a method `judged`, which maps a record to such steps, that
            decides; otherwise every step can be judged.
        record: Outputs of `StyleMeasures.step` (T, N), by name.
    """
    judge = getattr(measures, "judged", None)
    return torch.ones_like(next(iter(record.values())), dtype=torch.bool) if judge is None else judge(record)
