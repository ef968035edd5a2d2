"""Widgets of a style space: one per parameter, what was measured below it, and a chart of both."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from coachable.coach.report import StyleReport, measures_by_parameter
from coachable.styles import Choice, Parameter, StyleSpace

if TYPE_CHECKING:
    import viser

_SLIDER_STEPS = 200
_HISTORY = 150  # points of the chart


class ParameterWidget:
    """A slider with its number box, or a dropdown, that follows the session and asks it.

    Args:
        server: where to add it.
        parameter: what it sets.
        value: present value.
        ask: called in viser's threads after the user changed it.
    """

    def __init__(
        self, server: viser.ViserServer, parameter: Parameter, value: float | str, ask: Callable[[], None]
    ) -> None:
        self.parameter = parameter
        self._shown = value
        hint = parameter.help or None
        if isinstance(parameter, Choice):
            options = [_words(option) for option in parameter.options]
            self.handle: Any = server.gui.add_dropdown(
                label(parameter), options, initial_value=_words(str(value)), hint=hint
            )
        else:
            step = float(f"{(parameter.high - parameter.low) / _SLIDER_STEPS:.1g}")
            self.handle = server.gui.add_slider(
                label(parameter), parameter.low, parameter.high, step, self._inside(float(value)), hint=hint
            )
        self.handle.on_update(lambda _: None if self._same(self.asked) else ask())

    @property
    def asked(self) -> float | str:
        """What the widget shows, as the session understands it."""
        if isinstance(self.parameter, Choice):
            return next(o for o in self.parameter.options if _words(o) == self.handle.value)
        return float(self.handle.value)

    def take(self) -> dict[str, float | str]:
        """The request, which from now on counts as shown."""
        self._shown = self.asked
        return {self.parameter.name: self._shown}

    def follow(self, value: float | str) -> None:
        """Shows what is in force, unless it is what the user asked for already."""
        if self._same(value):
            return
        self._shown = value
        self.handle.value = _words(value) if isinstance(value, str) else self._inside(value)

    def _inside(self, value: float) -> float:
        """Float32 rounds to just beyond the bounds."""
        return min(max(value, self.parameter.low), self.parameter.high)

    def _same(self, value: float | str) -> bool:
        if isinstance(value, str) or isinstance(self._shown, str):
            return value == self._shown
        return abs(value - self._shown) <= 1e-6 * (self.parameter.high - self.parameter.low)


class MeasuredText:
    """The line below a widget: what was measured, whether it complies, whether the request was out of range."""

    def __init__(self, server: viser.ViserServer, parameter: Parameter) -> None:
        self.parameter = parameter
        self.handle = server.gui.add_markdown("measured: nothing yet")

    def update(self, report: StyleReport, measures: list[str]) -> None:
        """Shows the report's values of `measures`."""
        shown = [f"{self._name(m)} **{number(report.measured[m])}**" for m in measures if m in report.measured]
        text = "measured: " + (", ".join(shown) or "nothing yet")
        outside = report.outside.get(self.parameter.name)
        if outside is not None:
            used = report.requested[self.parameter.name]
            text += (
                f"\n\n⚠ **{outside:g} {self.parameter.unit} was never trained**: {used:g} {self.parameter.unit} is used"
            )
        write(self.handle, text)

    def _name(self, measure: str) -> str:
        rest = f"_{measure}_".replace(f"_{self.parameter.name}_", "_").strip("_")
        return _words(rest or measure)


class Chart:
    """Requested against measured over the last seconds, of one parameter at a time."""

    def __init__(self, server: viser.ViserServer, space: StyleSpace, period: float) -> None:
        import viser.uplot as uplot

        self._space, self._period = space, period
        self._history: deque[tuple[float, StyleReport]] = deque(maxlen=_HISTORY)
        names = [p.name for p in space.parameters]
        numeric = [p.name for p in space.parameters if not isinstance(p, Choice)]
        self.choice = server.gui.add_dropdown("show", names, initial_value=(numeric or names)[0])
        self.plot = server.gui.add_uplot(
            data=(np.zeros(1), np.full(1, np.nan), np.full(1, np.nan)),
            series=(
                uplot.Series(label="time [s]"),
                uplot.Series(label="requested", stroke="#d62728", width=2),
                uplot.Series(label="measured", stroke="#1f77b4", width=2),
            ),
            scales={"x": uplot.Scale(time=False)},
            axes=(uplot.Axis(size=26), uplot.Axis(size=44)),
            height=180,
        )

    def add(self, time: float, report: StyleReport) -> None:
        """A further point."""
        if self._history and time <= self._history[-1][0]:
            self._history.clear()  # the session started over
        self._history.append((time, report))
        self.draw()

    def draw(self) -> None:
        """Shows the chosen parameter: a number as it is; of a choice, the share of time in which it was met."""
        name = self.choice.value
        rows = [(t, self._requested(r, name), self._measured(r, name)) for t, r in self._history]
        if rows:
            times, asked, seen = np.array(rows, dtype=float).T
            self.plot.data = (times, asked, seen)

    def _requested(self, report: StyleReport, name: str) -> float:
        value = report.requested[name]
        return 1.0 if isinstance(value, str) else value

    def _measured(self, report: StyleReport, name: str) -> float:
        measures = measures_by_parameter(self._space, report.measured)[name]
        return report.measured[measures[0]] if measures else math.nan


def label(parameter: Parameter) -> str:
    """Name, unit and trained range."""
    if isinstance(parameter, Choice):
        return _words(parameter.name)
    unit = f" {parameter.unit}" if parameter.unit else ""
    return f"{_words(parameter.name)} ({parameter.low:g} to {parameter.high:g}{unit})"


def number(value: float) -> str:
    """Three digits, however large."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _words(name: str) -> str:
    return name.replace("_", " ")


def write(handle: Any, text: str) -> None:
    """Only what changed is sent to the browsers."""
    if handle.content != text:
        handle.content = text
