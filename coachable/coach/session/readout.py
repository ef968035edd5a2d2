"""Requested and measured style, as a session reports them."""

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domain import StyleMeasures
from coachable.evaluation.switching import judged_steps
from coachable.keys import TASK_REWARD


@dataclass(frozen=True)
class StyleReport:
    """Requested and measured style in the last seconds of a session.

    Attributes:
        requested: The style in force, by parameter name.
        measured: Mean of each measure over the window; a measure without a value in the window is left out.
        unmeasured: Names of the measures without a value in the window.
        seconds: Length of the window [s]. A request or a new episode starts a new window.
        outside: Requested number by parameter name, where the last request lay outside the trained range.
        asks: Whether the style asks for anything; false if it consists of weights that are all zero.
        complying: Share of the steps that can be judged in which the agent complied with the request, or None if no
            step of the window can be judged.
        needs: What has to happen before compliance can be judged.
        complied_after: Time from the latest request until the agent first complied [s], or None before that.
        since_request: Time since the latest request [s].
        episode: Number of the episode, from 1.
        episode_time: Time since the episode began [s].
        ended: Why the episode is over, or None while it runs.
        endings: Number of episodes that ended so far, by reason.
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


class MeasuredWindow:
    """Measured style over the last steps since the latest request.

    Args:
        measures: The domain's measured style. In addition to `StyleMeasures` it may have a method `judged`, see
            `judged_steps`, and an attribute `needs`, which says what has to happen before, such as "a footstep".
        length: Largest number of steps to keep.
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
        """Add the transition of one step, batch shape (1,)."""
        reward = transition.get(("next", TASK_REWARD)).reshape(1)
        self._rows.append({TASK_REWARD: reward} | self.measures.step(transition))

    def clear(self) -> None:
        """Remove all steps."""
        self._rows.clear()

    def summary(self) -> dict[str, float]:
        """Return the mean task reward and the domain's measures over the window; NaN where there is no value."""
        if not self._rows:
            return {}
        record = _stacked(self._rows)
        alive = torch.ones(len(self._rows), 1, dtype=torch.bool)
        values = {TASK_REWARD: record[TASK_REWARD].mean(0)} | self.measures.summarise(record, alive)
        return {name: value.item() for name, value in values.items()}

    def complies(self) -> bool:
        """Return whether the agent complied with its style in the last step."""
        return bool(self._rows) and bool(self._done(_stacked([self._rows[-1]])).any())

    def complying(self) -> float | None:
        """Return the share of the steps that can be judged in which the agent complied, or None if there are none."""
        if not self._rows:
            return None
        record = _stacked(self._rows)
        judged = judged_steps(self.measures, record)
        return (self._done(record).sum() / judged.sum()).item() if judged.any() else None

    def _done(self, record: Mapping[str, Tensor]) -> Tensor:
        return self.measures.complies(record) & judged_steps(self.measures, record)


def _stacked(rows: Collection[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Stack the values of each name to (T, 1)."""
    return {name: torch.stack([row[name] for row in rows]) for name in next(iter(rows))}
