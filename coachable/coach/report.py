"""Requested against measured style, as a session reports it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domain import StyleMeasures
from coachable.keys import TASK_REWARD
from coachable.styles import StyleSpace


@dataclass(frozen=True)
class StyleReport:
    """The last seconds of a session.

    Attributes:
        requested: the style in force.
        measured: means over the window, without what had no value in it.
        outside: number that was asked for, by parameter, where the last request lay outside the trained range.
        complied_after: time from the latest request until the agent did what it asks for, None while it has not [s].
        since_request: time since the latest request [s].
        episode: number of the episode, from 1.
        episode_time: since the episode began [s].
        ended: why the episode is over, None while it runs.
        endings: how many episodes ended for that reason so far.
    """

    requested: dict[str, float | str]
    measured: dict[str, float]
    outside: dict[str, float]
    complied_after: float | None
    since_request: float
    episode: int
    episode_time: float
    ended: str | None
    endings: Mapping[str, int]


def measures_by_parameter(space: StyleSpace, names: Iterable[str]) -> dict[str, list[str]]:
    """Which measures belong to which parameter, those of none under "".

    A measure belongs to the parameter whose words occur in its name, in order and next to each other: `pose_held` to
    `pose`, `damage_melee` to `melee`. Of several parameters the longest name wins.

    Example:
        >>> from coachable.styles import Setpoint
        >>> measures_by_parameter(StyleSpace([Setpoint("gap", 0, 2)]), ["gap", "gap_error", "speed"])
        {'gap': ['gap', 'gap_error'], '': ['speed']}
    """
    groups: dict[str, list[str]] = {name: [] for name in space.names} | {"": []}
    by_length = sorted(space.names, key=len, reverse=True)
    for measure in names:
        owner = next((name for name in by_length if f"_{name}_" in f"_{measure}_"), "")
        groups[owner].append(measure)
    return groups


class MeasuredWindow:
    """What the agent did in the last steps of an episode.

    Args:
        measures: the domain's measured style.
        length: number of steps.
    """

    def __init__(self, measures: StyleMeasures, length: int) -> None:
        self.measures = measures
        self._rows: deque[dict[str, Tensor]] = deque(maxlen=max(1, length))

    def add(self, transition: TensorDictBase) -> None:
        """Notes a step, of batch shape (1,)."""
        reward = transition.get(("next", TASK_REWARD)).reshape(1)
        self._rows.append({TASK_REWARD: reward} | self.measures.step(transition))

    def clear(self) -> None:
        """Forgets everything."""
        self._rows.clear()

    def summary(self) -> dict[str, float]:
        """The domain's measures over the window and the mean task reward, without those that are no number."""
        if not self._rows:
            return {}
        record = self._record()
        alive = torch.ones(len(self._rows), 1, dtype=torch.bool)
        values = {TASK_REWARD: record[TASK_REWARD].mean(0)} | self.measures.summarise(record, alive)
        return {name: value.item() for name, value in values.items() if math.isfinite(value.item())}

    def complies(self, steps: int) -> bool:
        """Whether the agent did what its style asks for in one of the last `steps` steps of the window."""
        return bool(self._rows) and bool(self.measures.complies(self._record())[-steps:].any())

    def _record(self) -> dict[str, Tensor]:
        """Name to (T, 1)."""
        return {name: torch.stack([row[name] for row in self._rows]) for name in self._rows[0]}
