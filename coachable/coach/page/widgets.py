"""Widgets of a style space: one per parameter, the measured values below it, and a chart of both."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from coachable.coach.session.readout import StyleReport
from coachable.domain import Domain
from coachable.evaluation.wording import measured_text, measures_by_parameter, readable, readable_number
from coachable.scene import palette
from coachable.scene.palette import css
from coachable.styles import Choice, Parameter, StyleSpace, Weight

if TYPE_CHECKING:
    import viser

_SLIDER_STEPS = 200
_SPAN = 30.0  # [s] of simulated time that the chart shows
_HISTORY = 150  # points of the chart
_REQUESTED, _MEASURED = css(palette.REQUESTED), css(palette.MEASURED)


class ParameterWidget:
    """Slider or dropdown of one parameter, which follows the session and requests changes.

    It is called `title` on the page. Threads of viser call `ask` after the user changed the value.
    """

    def __init__(
        self, server: viser.ViserServer, parameter: Parameter, value: float | str, ask: Callable[[], None], title: str
    ) -> None:
        self.parameter = parameter
        self._shown = value
        name, hint = title, parameter.help or None
        if isinstance(parameter, Choice):
            options = [readable(option) for option in parameter.options]
            self.handle: Any = server.gui.add_dropdown(name, options, initial_value=readable(value), hint=hint)
        else:
            low, high = parameter.low, parameter.high
            step = 10.0 ** math.floor(math.log10((high - low) / _SLIDER_STEPS))
            shown = self._inside(float(value))
            self.handle = server.gui.add_slider(name, low, high, step, shown, hint=hint)
        self.handle.on_update(lambda _: None if self._same(self.asked) else ask())

    @property
    def asked(self) -> float | str:
        """Value of the widget; of a choice, any text that a browser sent, which need not be an option."""
        if isinstance(self.parameter, Choice):
            shown = str(self.handle.value)
            return next((o for o in self.parameter.options if readable(o) == shown), shown)
        return float(self.handle.value)

    def take(self) -> dict[str, float | str]:
        """Return the widget's value by parameter name, as a request, and count it as shown."""
        self._shown = self.asked
        return {self.parameter.name: self._shown}

    def follow(self, value: float | str) -> None:
        """Show the value in force, unless the widget shows it already."""
        shown = value if isinstance(value, str) else self._inside(value)
        if self._same(shown):
            return
        self._shown = shown  # viser calls back when the value is set, which must not look like a request
        self.handle.value = readable(shown) if isinstance(shown, str) else shown

    def _inside(self, value: float) -> float:
        """Round a float32 value to six digits, and clamp it because rounding may exceed the bounds."""
        return min(max(float(f"{value:.6g}"), self.parameter.low), self.parameter.high)

    def _same(self, value: float | str) -> bool:
        if isinstance(value, str) or isinstance(self._shown, str):
            return value == self._shown
        return abs(value - self._shown) <= 1e-6 * (self.parameter.high - self.parameter.low)


class MeasuredText:
    """Line below a widget: the measured values, the trained range, and whether the request lay outside."""

    def __init__(self, server: viser.ViserServer, parameter: Parameter, domain: Domain, space: StyleSpace) -> None:
        self.parameter, self._domain, self._space = parameter, domain, space
        self.handle = server.gui.add_markdown(escaped(trained(parameter)))

    def update(self, report: StyleReport, measures: list[str]) -> None:
        """Show the values of the parameter's measures in a report of the session, or say why there are none."""
        name, values = self.parameter.name, report.measured
        measured = sorted((m for m in measures if m in values), key=lambda m: m != name)  # the nameless one comes first
        shown = [f"{escaped(self._name(m))}**{escaped(self._value(m, values[m]))}**" for m in measured]
        found = "no measure of its own" if report.seconds and not measures else "not measured yet"
        if shown:
            found = f"measured {', '.join(shown)} in {report.seconds:.1f} s"
        text = " · ".join(filter(None, [found, escaped(trained(self.parameter))]))
        outside = report.outside.get(name)
        if outside is not None:
            used, unit = report.requested[name], escaped(f" {self.parameter.unit}".rstrip())
            text += f"\n\n**Outside the trained range:** {outside:g}{unit} was asked for, {used:.3g}{unit} is used."
        write(self.handle, text)

    def _name(self, measure: str) -> str:
        """Return the name of a measure: what the domain calls it, or its own without the parameter's."""
        if measure in self._domain.words.names and measure != self.parameter.name:
            return f"{self._domain.words.name(measure)} "
        rest = f"_{measure}_".replace(f"_{self.parameter.name}_", "_").strip("_")
        return f"{readable(rest)} " if rest else ""

    def _value(self, measure: str, value: float) -> str:
        """Format a value; that of a choice is the share of time in which it was met."""
        if isinstance(self.parameter, Choice):
            return f"{value:.0%}"
        return measured_text(self._domain, self._space, measure, value)


class Chart:
    """Chart of the requested and measured values of one parameter over the last seconds.

    The time axis has a fixed range, because viser's plot otherwise keeps the visible share of the data from before the
    first points were drawn, and may show a part of the axis without data. The axis of the request shows the whole
    trained range, so that small deviations look small.

    Threads of viser call `redraw` after the user chose another parameter; `add` has to follow.
    """

    def __init__(
        self, server: viser.ViserServer, folder: Any, space: StyleSpace, domain: Domain, redraw: Callable[[], None]
    ) -> None:
        self._server, self._folder, self._space, self._domain = server, folder, space, domain
        self._history: deque[tuple[float, StyleReport]] = deque(maxlen=_HISTORY)
        self._names = {domain.words.name(name): name for name in space.names}
        numeric = [p.name for p in space.parameters if not isinstance(p, Choice)]
        self.shown = [*numeric, *space.names][0]
        with folder:
            self.choice = server.gui.add_dropdown(
                "show", list(self._names), initial_value=domain.words.name(self.shown)
            )
            self.note = server.gui.add_markdown("", visible=False)
        self.choice.on_update(lambda _: redraw())
        self.plot: Any = None
        # Parameter of the plot, the ends of its axis, whether it has anything measured, and whether that is all 0.
        self._drawn: tuple[str, tuple[float, float], bool, bool] | None = None

    def follow(self, name: str) -> None:
        """Show a parameter that was just requested."""
        title = self._domain.words.name(name)
        if self.choice.value != title:
            self.choice.value = title

    def add(self, time: float, report: StyleReport) -> None:
        """Add a report at a simulated time of the session [s] as a further point, and draw the chart."""
        if self._history and time < self._history[-1][0]:
            self._history.clear()  # the session started over
        elif self._history and time == self._history[-1][0]:
            self._history.pop()  # shown again, for example while paused
        self._history.append((time, report))
        self._draw()

    def _draw(self) -> None:
        """Show the chosen parameter: the value of a number, or the share of time in which a choice was met."""
        self.shown = self._names.get(str(self.choice.value), self.shown)
        now = self._history[-1][0]
        recent = [(moment - now, report) for moment, report in self._history if moment >= now - _SPAN]
        rows = [(ago, self._requested(report), self._measured(report)) for ago, report in recent]
        measured = [row for row in rows if math.isfinite(row[2])]  # uPlot draws nothing at all if there are NaN
        columns = np.array(measured or rows, dtype=float).T
        shown = tuple(columns if measured else columns[:2])
        ends = _ends(self._space[self.shown], shown[1:2] if self._is_apart(bool(measured)) else shown[1:])
        self._plot((self.shown, ends, bool(measured), not shown[-1].any()), shown)
        write(
            self.note, f"{escaped(self._domain.words.name(self.shown))}: nothing was measured in the last {_SPAN:g} s"
        )
        if self.note.visible == bool(measured):
            self.note.visible = not measured

    def _is_apart(self, measured: bool) -> bool:
        """Return whether the measure has an axis of its own: that of a weight has another unit."""
        return measured and isinstance(self._space[self.shown], Weight)

    def _plot(self, kind: tuple[str, tuple[float, float], bool, bool], data: tuple[np.ndarray, ...]) -> None:
        """Draw data in the plot, or in a new one if its settings change, so that all change together."""
        if kind == self._drawn:
            self.plot.data = data
            return
        if self.plot is not None:
            self.plot.remove()
        with self._folder:
            self.plot = self._server.gui.add_uplot(data=data, height=190, **self._layout(*kind))
        self._drawn = kind

    def _layout(self, name: str, ends: tuple[float, float], measured: bool, nothing_found: bool) -> dict[str, Any]:
        """Return the layout of the plot; a separate axis where every value is 0 ends at 1 instead of the plot's 100."""
        import viser.uplot as uplot

        series = [uplot.Series(label="seconds ago"), uplot.Series(label="requested", stroke=_REQUESTED, width=2)]
        axes = [uplot.Axis(size=34), uplot.Axis(size=48)]
        apart = self._is_apart(measured)
        if apart:
            axes.append(uplot.Axis(scale="right", side=1, size=56, stroke=_MEASURED, grid=uplot.Axis_Grid(show=False)))
        if measured:
            label, scale = ("measured (right)", "right") if apart else ("measured", "y")
            dots = uplot.Series_Points(show=True, size=3, fill=_MEASURED)  # where it was measured; lines only join them
            series.append(uplot.Series(label=label, stroke=_MEASURED, width=2, scale=scale, points=dots))
        scales = {"x": uplot.Scale(time=False, range=(-_SPAN, 0.0)), "y": uplot.Scale(range=ends)}
        if apart and nothing_found:
            scales["right"] = uplot.Scale(range=(0.0, 1.0))
        return {"series": tuple(series), "scales": scales, "axes": tuple(axes)}

    def _requested(self, report: StyleReport) -> float:
        value = report.requested[self.shown]
        return 1.0 if isinstance(value, str) else value

    def _measured(self, report: StyleReport) -> float:
        measures = measures_by_parameter(self._space, report.measured, self._domain.beside)[self.shown]
        return report.measured[measures[0]] if measures else math.nan


def _ends(parameter: Parameter, lines: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the ends of an axis that shows a parameter's range and all values, in steps, so that they seldom change.

    Args:
        parameter: The parameter; the axis of a choice shows shares.
        lines: Values (n,), one array per line.
    """
    low, high = (0.0, 1.0) if isinstance(parameter, Choice) else (parameter.low, parameter.high)
    step = 0.2 * (high - low)
    below = max(0.5, math.ceil((low - min(line.min() for line in lines)) / step))
    above = max(0.5, math.ceil((max(line.max() for line in lines) - high) / step))
    return low - below * step, high + above * step


def trained(parameter: Parameter) -> str:
    """Return the trained range of a numeric parameter, or an empty text for a choice."""
    if isinstance(parameter, Choice):
        return ""
    return f"trained {readable_number(parameter.low)} to {readable_number(parameter.high, parameter.unit)}"


def escaped(text: str) -> str:
    """Escape the characters that are markup in Markdown, in which the page would also render HTML."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>#|~&" else c for c in text)


def write(handle: Any, text: str) -> None:
    """Set the content of a text widget of the page; only changes are sent to the browsers."""
    if handle.content != text:
        handle.content = text
