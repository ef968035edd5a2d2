"""Figures of an evaluation, drawn without a display."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from cycler import cycler
from matplotlib import pyplot as plt

from coachable.domain import Domain
from coachable.evaluation.runs import describe
from coachable.evaluation.style_grid import StyleGrid, mean_of, measured_column, published
from coachable.evaluation.wording import readable, with_unit
from coachable.scene.look import LIGHT, LINES
from coachable.scene.palette import css
from coachable.styles import Choice, StyleSpace

_PANELS_PER_ROW = 4
RARE = 0.2  # shares below this have an axis of their own range
MARKERS = "osD^vP*X"  # distinguishable without colour as well
_LOOK = {
    "axes.prop_cycle": cycler(color=list(map(css, LINES))),
    "text.parse_math": False,  # names and options may contain $
    "axes.spines.top": False,
    "axes.spines.right": False,
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.titlecolor"), css(LIGHT.ink)),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), css(LIGHT.soft)),
    "grid.color": css(LIGHT.line),
}


@contextlib.contextmanager
def drawing(
    path: Path, rows: int = 1, columns: int = 1, *, size: tuple[float, float], grid: bool = True, **options: Any
) -> Iterator[np.ndarray]:
    """Provide the panels (rows, columns) of a figure that is written to a file at the end of the block.

    Args:
        path: PNG, SVG or PDF file in an existing folder.
        rows: Number of rows of panels.
        columns: Number of columns of panels.
        size: Width and height [inch].
        grid: Whether the panels have grid lines.
        **options: Further arguments of `matplotlib.pyplot.subplots`.
    """
    look: dict[Any, Any] = {**_LOOK, "axes.grid": grid}
    with plt.rc_context(look):
        figure, panels = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained", **options)
        try:
            yield panels
            # The version of matplotlib is left out, so that the same numbers give the same file.
            figure.savefig(path, dpi=130, metadata={"Software": None} if path.suffix == ".png" else None)
        finally:
            plt.close(figure)


def shade(index: int, count: int) -> Any:
    """Return the colour, RGBA, of line `index` of `count` ordered lines, for example of rising weights."""
    return plt.get_cmap("viridis")(0.9 * index / max(count - 1, 1))


def draw_heat_map(
    path: Path,
    values: np.ndarray,
    rows: Sequence[str],
    columns: Sequence[str],
    form: str,
    title: str,
    *,
    row_line: int = 0,
    column_line: int = 0,
    high: float | None = None,
) -> None:
    """Draw a table of numbers whose cells are the darker, the larger they are.

    Args:
        path: Image file to write.
        values: Numbers (rows, columns), at least 0.
        rows: Labels of the rows.
        columns: Labels of the columns.
        form: Format specification of the numbers, such as ".2f".
        title: Title of the figure.
        row_line: Number of rows above a horizontal line; 0 for no line.
        column_line: Number of columns to the left of a vertical line; 0 for no line.
        high: Number with the darkest colour; by default the largest one.
    """
    high = max(float(values.max()), 1e-9) if high is None else high
    with drawing(path, size=(2.5 + 0.62 * len(columns), 2.2 + 0.33 * len(rows)), grid=False) as ((axes,),):
        axes.imshow(values, cmap="Blues", vmin=0.0, vmax=high, aspect="auto")
        for (i, j), value in np.ndenumerate(values):
            colour = "white" if value > 0.6 * high else "black"
            axes.text(j, i, format(value, form), ha="center", va="center", fontsize=7, color=colour)
        if 0 < row_line < len(rows):
            axes.axhline(row_line - 0.5, color="0.4", lw=1)
        if 0 < column_line < len(columns):
            axes.axvline(column_line - 0.5, color="0.4", lw=1)
        axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize=8)
        axes.set_yticks(range(len(rows)), rows, fontsize=8)
        axes.set_title(title, fontsize=10)


def draw_style_grid(grid: StyleGrid, domain: Domain, space: StyleSpace, path: Path, title: str) -> None:
    """Draw measured over requested style, and the domain's published metrics over the same axis, as a PNG file."""
    axis, lines = grid_lines(grid.cells, space)
    rows, formats = grid.rows(), published(domain, grid.episodes, grid.cells[0])
    columns = {measured_column(name, grid.cells[0]): name for name in grid.episodes}
    known = [columns[column] for column in formats if column in columns]
    names = [name for name in known if name not in space]
    names = [name for name in ((axis,) if axis in grid.episodes else ()) + tuple(names) if name != f"{axis}_error"]
    names = names or known or list(grid.episodes)
    wide = min(len(names), _PANELS_PER_ROW)
    high = -(-len(names) // wide)
    with drawing(path, high, wide, size=(4.2 * wide, 3.8 * high)) as axes:
        for panel in axes.flat[len(names) :]:
            panel.set_axis_off()
        for panel, name in zip(axes.flat, names, strict=False):
            column = measured_column(name, grid.cells[0])
            for index, (label, cells) in enumerate((lines or {"": list(range(len(grid.cells)))}).items()):
                x = np.array([grid.cells[i][axis] for i in cells] if axis else cells, dtype=float)
                values = np.array([mean_of(grid.episodes[name][i]) for i in cells])
                spread = np.array([[rows[i][f"{column}_low"], rows[i][f"{column}_high"]] for i in cells])
                offset = (index - (len(lines) - 1) / 2) * 0.012 * np.ptp(x)  # so that intervals do not cover each other
                error = np.abs(spread - values[:, None]).T
                style: dict[str, Any] = {"marker": MARKERS[index], "ls": "-" if axis else "", "label": label or None}
                panel.errorbar(x + offset, values, error, capsize=2, ms=5, **style)
            if name == axis:
                bounds = [space[name].low, space[name].high]
                panel.plot(bounds, bounds, color="0.6", ls="--", lw=1, label="as requested")
                panel.set_ylabel(f"measured {with_unit(readable(name), space[name].unit)}")
            else:
                panel.set_ylabel(with_unit(readable(name), domain.units.get(name, "")))
                if formats.get(column, "").endswith("%") and panel.get_ylim()[1] > RARE:
                    panel.set_ylim(-0.03, 1.05)
            panel.set_xlabel(
                f"requested {with_unit(readable(axis), space[axis].unit)}" if axis else "style, by row of the table"
            )
        if axes[0, 0].get_legend_handles_labels()[1]:
            axes[0, 0].legend(fontsize=8)
        axes[0, 0].figure.suptitle(title, fontsize=10)


def grid_lines(cells: Sequence[dict[str, Any]], space: StyleSpace) -> tuple[str | None, dict[str, list[int]]]:
    """Choose the horizontal axis and the lines of a figure of a style grid, whose cells are styles by parameter name.

    Returns:
        The numeric parameter with most values, and the cells of each combination of the others, by label. None and an
        empty dictionary if there is no such parameter, or too many combinations, or a line of a single cell.
    """
    counts = {name: len({c[name] for c in cells}) for name in cells[0] if not isinstance(space[name], Choice)}
    axis = max(counts, key=lambda name: counts[name], default=None)
    if axis is None or counts[axis] < 3:
        return None, {}
    lines: dict[str, list[int]] = {}
    for i, cell in sorted(enumerate(cells), key=lambda pair: pair[1][axis]):
        others = {k: v for k, v in cell.items() if k != axis}
        lines.setdefault(describe(others) if others else "", []).append(i)
    drawable = len(lines) <= len(MARKERS) and all(len(line) > 1 for line in lines.values())
    return (axis, lines) if drawable else (None, {})
