"""Requested against measured style, as a session reports it."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Mapping
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
        unmeasured: names of what had no value in it.
        seconds: length of the window, which begins anew with each request and each episode [s].
        outside: number that was asked for, by parameter, where the last request lay outside the trained range.
        asks: whether anything is asked for; false if the style consists of weights that are all zero.
        complying: share of the moments of the window that can be judged in which the agent did what was asked for; None
            if there are none.
        needs: what has to happen before it can be judged.
        complied_after: time from the latest request until the agent first did what it asks for, None while it has not
            [s].
        since_request: time since the latest request [s].
        episode: number of the episode, from 1.
        episode_time: since the episode began [s].
        ended: why the episode is over, None while it runs.
        endings: how many episodes ended for that reason so far.
    """

    requested: dict[str, float | str]
    measured: dict[str, float]
    unmeasured: tuple[str, ...]
    seconds: float
    outside: dict[str, float]
    asks: bool
    complying: float | None
    needs: str
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
    """What the agent did in the last steps since the latest request.

    Args:
        measures: the domain's measured style. In addition to `StyleMeasures` it may have a method `judged`, which gives
            the steps, (T, N) bool, in which one can tell whether the agent complies, and `needs`, which says what they
            take, such as "a footstep". Without them, every step is judged.
        length: number of steps.
    """

    def __init__(self, measures: StyleMeasures, length: int) -> None:
        self.measures = measures
        self._rows: deque[dict[str, Tensor]] = deque(maxlen=max(1, length))

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def needs(self) -> str:
        """What has to happen before compliance can be judged."""
        return getattr(self.measures, "needs", "a step")

    def add(self, transition: TensorDictBase) -> None:
        """Notes a step, of batch shape (1,)."""
        reward = transition.get(("next", TASK_REWARD)).reshape(1)
        self._rows.append({TASK_REWARD: reward} | self.measures.step(transition))

    def clear(self) -> None:
        """Forgets everything."""
        self._rows.clear()

    def summary(self) -> dict[str, float]:
        """The domain's measures over the window and the mean task reward; NaN for what had no value in it."""
        if not self._rows:
            return {}
        record = _stacked(self._rows)
        alive = torch.ones(len(self._rows), 1, dtype=torch.bool)
        values = {TASK_REWARD: record[TASK_REWARD].mean(0)} | self.measures.summarise(record, alive)
        return {name: value.item() for name, value in values.items()}

    def complies(self) -> bool:
        """Whether the agent did what its style asks for in the last step."""
        return bool(self._rows) and bool(self._done(_stacked([self._rows[-1]])).any())

    def complying(self) -> float | None:
        """Share of the steps that can be judged in which it did so, None if there are none."""
        if not self._rows:
            return None
        record = _stacked(self._rows)
        judged = self._judged(record)
        return (self._done(record).sum() / judged.sum()).item() if judged.any() else None

    def _judged(self, record: Mapping[str, Tensor]) -> Tensor:
        judge = getattr(self.measures, "judged", None)
        return torch.ones_like(record[TASK_REWARD], dtype=torch.bool) if judge is None else judge(record)

    def _done(self, record: Mapping[str, Tensor]) -> Tensor:
        return self.measures.complies(record) & self._judged(record)


def _stacked(rows: Collection[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Name to (T, 1)."""
    return {name: torch.stack([row[name] for row in rows]) for name in next(iter(rows))}
