"""Widgets of a style space: one per parameter, what was measured below it, and a chart of both."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from coachable.coach.grammar import readable_number
from coachable.coach.report import StyleReport, measures_by_parameter
from coachable.styles import Choice, Parameter, StyleSpace, Weight

if TYPE_CHECKING:
    import viser

_SLIDER_STEPS = 200
_HISTORY = 150  # points of the chart
_REQUESTED, _MEASURED = "#d62728", "#1f77b4"


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
            step = 10.0 ** math.floor(math.log10((parameter.high - parameter.low) / _SLIDER_STEPS))
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
        """Float32 has digits that nobody asked for, and rounds to just beyond the bounds."""
        return min(max(float(f"{value:.6g}"), self.parameter.low), self.parameter.high)

    def _same(self, value: float | str) -> bool:
        if isinstance(value, str) or isinstance(self._shown, str):
            return value == self._shown
        return abs(value - self._shown) <= 1e-6 * (self.parameter.high - self.parameter.low)


class MeasuredText:
    """The line below a widget: what was measured, whether it complies, whether the request was out of range."""

    def __init__(self, server: viser.ViserServer, parameter: Parameter) -> None:
        self.parameter = parameter
        self.handle = server.gui.add_markdown(trained(parameter))

    def update(self, report: StyleReport, measures: list[str]) -> None:
        """Shows the report's values of `measures`."""
        shown = [f"{self._name(m)}**{readable_number(report.measured[m])}{self._unit(m)}**" for m in measures]
        text = " · ".join(filter(None, [f"measured {', '.join(shown)}" if shown else "", trained(self.parameter)]))
        outside = report.outside.get(self.parameter.name)
        if outside is not None:
            used, unit = report.requested[self.parameter.name], f" {self.parameter.unit}".rstrip()
            text += f"\n\n**Outside the trained range:** {outside:g}{unit} was asked for, {used:.3g}{unit} is used."
        write(self.handle, text)

    def _name(self, measure: str) -> str:
        """Without the parameter's own name."""
        rest = f"_{measure}_".replace(f"_{self.parameter.name}_", "_").strip("_")
        return f"{_words(rest)} " if rest else ""

    def _unit(self, measure: str) -> str:
        return f" {self.parameter.unit}" if self.parameter.unit and measure == self.parameter.name else ""


class Chart:
    """Requested against measured over the last seconds, of one parameter at a time."""

    def __init__(self, server: viser.ViserServer, space: StyleSpace) -> None:
        self._space = space
        self._history: deque[tuple[float, StyleReport]] = deque(maxlen=_HISTORY)
        self._names = {_words(name): name for name in space.names}
        numeric = [_words(p.name) for p in space.parameters if not isinstance(p, Choice)]
        self.choice = server.gui.add_dropdown("show", list(self._names), initial_value=[*numeric, *self._names][0])
        self.plot = server.gui.add_uplot(data=(np.zeros(1), np.zeros(1), np.zeros(1)), height=190, **self._layout())
        self.choice.on_update(lambda _: self._lay_out())

    def _layout(self) -> dict[str, Any]:
        """Of the chosen parameter: a weight and what it brings about have no common unit, hence an axis each."""
        import viser.uplot as uplot

        apart = isinstance(self._space[self._names[self.choice.value]], Weight)
        scale = "measured" if apart else "y"
        axes = [uplot.Axis(size=34), uplot.Axis(size=48)]
        if apart:
            axes.append(uplot.Axis(scale=scale, side=1, size=56, stroke=_MEASURED, grid=uplot.Axis_Grid(show=False)))
        return {
            "series": (
                uplot.Series(label="time [s]"),
                uplot.Series(label="requested", stroke=_REQUESTED, width=2),
                uplot.Series(label="measured (right)" if apart else "measured", stroke=_MEASURED, width=2, scale=scale),
            ),
            "scales": {"x": uplot.Scale(time=False)},
            "axes": tuple(axes),
        }

    def _lay_out(self) -> None:
        for name, value in self._layout().items():
            setattr(self.plot, name, value)

    def add(self, time: float, report: StyleReport) -> None:
        """A further point."""
        if self._history and time < self._history[-1][0]:
            self._history.clear()  # the session started over
        elif self._history and time == self._history[-1][0]:
            self._history.pop()  # shown again, for example while paused
        self._history.append((time, report))
        self.draw()

    def draw(self) -> None:
        """Shows the chosen parameter: a number as it is; of a choice, the share of time in which it was met."""
        name = self._names[self.choice.value]
        rows, seen = [], math.nan
        for moment, report in self._history:
            seen = self._measured(report, name, otherwise=seen)
            if math.isfinite(seen):  # uPlot draws nothing at all if there are NaN
                rows.append((moment, self._requested(report, name), seen))
        if rows:
            times, asked, measured = np.array(rows, dtype=float).T
            self.plot.data = (times, asked, measured)

    def _requested(self, report: StyleReport, name: str) -> float:
        value = report.requested[name]
        return 1.0 if isinstance(value, str) else value

    def _measured(self, report: StyleReport, name: str, otherwise: float) -> float:
        measures = measures_by_parameter(self._space, report.measured)[name]
        return report.measured[measures[0]] if measures else otherwise


def label(parameter: Parameter) -> str:
    """Name and unit."""
    return _words(parameter.name) + (f" [{parameter.unit}]" if parameter.unit else "")


def trained(parameter: Parameter) -> str:
    """The trained range, of a number."""
    if isinstance(parameter, Choice):
        return ""
    return f"trained {parameter.low:g} to {parameter.high:g} {parameter.unit}".rstrip()


def _words(name: str) -> str:
    return name.replace("_", " ")


def write(handle: Any, text: str) -> None:
    """Only what changed is sent to the browsers."""
    if handle.content != text:
        handle.content = text
