"""Figures of a report: metrics per style, requested and measured values, switches, Pareto curves."""

import contextlib
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from coachable.evaluation.figures import MARKERS, RARE, drawing, grid_lines
from coachable.evaluation.runs import Estimate, Run, StyleTable, estimate, sweep_estimate
from coachable.evaluation.sweep import UNIT_REWARD
from coachable.evaluation.wording import readable, with_unit
from coachable.styles import Choice, StyleSpace

_COLUMNS = 3
_LABEL = 36  # characters of a line of a style's name
_GROWTH_POINTS = 200


def draw_metrics(
    table: StyleTable,
    space: StyleSpace,
    metrics: Sequence[str],
    formats: Mapping[str, str],
    path: Path,
    titles: Mapping[str, str],
) -> None:
    """Draw each metric in every style: as lines over a numeric parameter if there is one, else as one point each.

    Args:
        table: The metrics.
        space: The style space.
        metrics: Metrics to draw.
        formats: Format specification by column; shares end in "%".
        path: PNG file to write.
        titles: Labels of the axes by metric.
    """
    axis, lines = grid_lines(table.cells, space)
    if axis is None:
        _draw_points(table, metrics, formats, path, titles)
        return
    with _panels(path, len(metrics)) as panels:
        for panel, metric in zip(panels, metrics, strict=False):
            for index, (label, cells) in enumerate(lines.items()):
                estimates = [table.of(metric, [i]) for i in cells]
                _line(panel, [table.cells[i][axis] for i in cells], estimates, index, label, len(lines))
            panel.set_xlabel(f"requested {with_unit(readable(axis), space[axis].unit)}")
            panel.set_ylabel(titles.get(metric, readable(metric)))
            _as_share(panel, formats.get(table.column(metric), ""))
        _legend(panels[0], len(lines))


def draw_requests(table: StyleTable, space: StyleSpace, parameters: Sequence[str], path: Path) -> None:
    """Draw measured over requested values of some set-points, a panel each, one line per option of the first choice."""
    choice = next((p for p in space.parameters if isinstance(p, Choice) and p.name in table.cells[0]), None)
    options: Sequence[Any] = choice.options if choice else (None,)
    with _panels(path, len(parameters)) as panels:
        for panel, name in zip(panels, parameters, strict=False):
            values = sorted({cell[name] for cell in table.cells})
            panel.plot(values, values, color="0.6", ls="--", lw=1, label="as requested")
            for index, option in enumerate(options):
                own = [i for i, cell in enumerate(table.cells) if not choice or cell[choice.name] == option]
                members = [[i for i in own if table.cells[i][name] == value] for value in values]
                shown = [(value, table.of(name, cells)) for value, cells in zip(values, members, strict=True) if cells]
                label = readable(option) if choice else "measured"
                _line(panel, [x for x, _ in shown], [y for _, y in shown], index, label, len(options))
            panel.set_xlabel(f"requested {with_unit(readable(name), space[name].unit)}")
            panel.set_ylabel(f"measured {with_unit(readable(name), space[name].unit)}")
        _legend(panels[0], len(options) + 1)


def draw_switches(runs: Sequence[Run], period_seconds: float, path: Path) -> None:
    """Draw the share of the switches that the agent complied with over the time since the switch.

    The 95 % interval is over the runs; `period_seconds` is the time between two switches [s].
    """
    with _panels(path, 1) as (panel,):
        times = np.linspace(0.0, period_seconds, _GROWTH_POINTS)
        counts = np.array([run.switching.switches or np.nan for run in runs])
        waits = [run.switching.comply_seconds.double().numpy() for run in runs]
        complied = np.array([(wait[:, None] <= times + 1e-9).sum(0) for wait in waits])  # (runs, times)
        estimates = [estimate(shares) for shares in complied.T / counts]
        panel.plot(times, [e.value for e in estimates])
        panel.fill_between(times, [e.low for e in estimates], [e.high for e in estimates], alpha=0.25, lw=0)
        panel.set_xlabel("time since the switch [s]")
        panel.set_ylabel("switches complied with")
        panel.set_xlim(0, period_seconds)
        _as_share(panel, ".0%")


def draw_tradeoffs(runs: Sequence[Run], success: str, form: str, path: Path, titles: Mapping[str, str]) -> None:
    """Draw task success over the amount of style along each weight, from neutral to maximum (Pareto curves).

    The 95 % intervals are over the runs. `success` names a metric and `form` the format of its values, such as ".0%";
    `titles` are labels of the axes by metric.
    """
    with _panels(path, len(runs[0].sweeps)) as panels:
        for panel, sweeps in zip(panels, zip(*(run.sweeps for run in runs), strict=True), strict=False):
            score = sweeps[0].score
            positions = range(len(sweeps[0].values))
            x, y = ([sweep_estimate(sweeps, metric, i) for i in positions] for metric in (score, success))
            points = [e.value for e in x], [e.value for e in y]
            panel.errorbar(*points, _reach(y), _reach(x), marker="o", ms=5, capsize=2, lw=1)
            for position, (value, at, height) in enumerate(zip(sweeps[0].values, x, y, strict=True)):
                if position in (0, len(x) - 1) and not np.isnan(at.value + height.value):
                    point = at.value, height.value
                    panel.annotate(f"{value:g}", point, (5, 5), textcoords="offset points", fontsize=8)
            panel.set_title(readable(sweeps[0].weight), fontsize=10)
            unit_reward = "style reward per step at weight 1"
            panel.set_xlabel(unit_reward if score == UNIT_REWARD else f"measured {titles.get(score, readable(score))}")
            panel.set_ylabel(titles.get(success, readable(success)))
            _as_share(panel, form)


def _draw_points(
    table: StyleTable, metrics: Sequence[str], formats: Mapping[str, str], path: Path, titles: Mapping[str, str]
) -> None:
    labels = [textwrap.fill(label, _LABEL) for label in table.labels]
    lines = sum(label.count("\n") + 1 for label in labels)
    height = 0.9 + 0.16 * lines + 0.06 * len(labels)
    with _panels(path, len(metrics), size=(2.6, height), margin=2.2, sharey=True) as panels:
        rows = list(range(len(labels)))
        for panel, metric in zip(panels, metrics, strict=True):
            estimates = [table.of(metric, [i]) for i in rows]
            panel.errorbar([e.value for e in estimates], rows, xerr=_reach(estimates), fmt="o", ms=4, capsize=2)
            panel.set_xlabel(titles.get(metric, readable(metric)))
            if formats.get(table.column(metric), "").endswith("%"):
                rare = panel.get_xlim()[1] < RARE
                panel.set_xlim(*((None, None) if rare else (-0.03, 1.03)))
                panel.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=None if rare else 0))
            panel.tick_params(axis="y", labelsize=8)
        panels[0].set_yticks(rows, labels)
        panels[0].invert_yaxis()


def _line(panel: Axes, x: Sequence[float], estimates: Sequence[Estimate], index: int, label: str, lines: int) -> None:
    span = max(x) - min(x) if len(x) > 1 else 1.0
    offset = (index - (lines - 1) / 2) * 0.012 * span  # so that intervals do not cover each other
    y = [e.value for e in estimates]
    style: dict[str, Any] = {"marker": MARKERS[index % len(MARKERS)], "color": f"C{index}", "label": label}
    panel.errorbar(np.array(x) + offset, y, _reach(estimates), capsize=2, ms=5, lw=1.2, **style)


def _reach(estimates: Sequence[Estimate]) -> np.ndarray:
    """Return lengths of error bars (2, n), at least 0 because an interquartile mean may lie outside its interval."""
    return np.array([[e.value - e.low for e in estimates], [e.high - e.value for e in estimates]]).clip(min=0)


@contextlib.contextmanager
def _panels(
    path: Path, count: int, size: tuple[float, float] = (4.0, 3.2), margin: float = 0.0, **options: Any
) -> Iterator[list[Axes]]:
    """Provide `count` panels of a figure of some width and height each [inch], right of a margin; see `drawing`."""
    columns = 2 if count == 4 else min(count, _COLUMNS)
    rows = -(-count // columns)
    width, height = size
    with drawing(path, rows, columns, size=(max(5.4, margin + width * columns), height * rows), **options) as grid:
        for panel in grid.flat[count:]:
            panel.set_visible(False)
        yield list(grid.flat[:count])


def _legend(panel: Axes, entries: int) -> None:
    handles, labels = panel.get_legend_handles_labels()
    if any(labels):
        look = {"loc": "outside lower center", "ncols": min(entries, 4), "fontsize": 8, "frameon": False}
        panel.figure.legend(handles, labels, **look)


def _as_share(panel: Axes, form: str) -> None:
    if form.endswith("%"):
        rare = panel.get_ylim()[1] < RARE
        panel.set_ylim(*((None, None) if rare else (-0.03, 1.05)))
        panel.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=None if rare else 0))
