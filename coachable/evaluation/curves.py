"""`coachable curves`: draw learning curves of groups of runs, with intervals over seeds."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from coachable.evaluation.figures import drawing
from coachable.evaluation.statistics import bootstrap_interval
from coachable.evaluation.wording import readable
from coachable.outputs import complete_file

_POINTS = 100


def read_metric(run: Path, x: str, y: str) -> tuple[np.ndarray, np.ndarray]:
    """Read two columns of a run's `metrics.csv`, from the rows in which both are numbers, not NaN.

    The stages of a run follow one another: each begins where the one before ended.

    Returns:
        The values (n,) of both columns.

    Raises:
        ValueError: If the file is damaged, there is no such column, or no row has both values.
    """
    tables = {file: _rows(file) for file in metrics_files(run)}
    columns = list(dict.fromkeys(column for rows in tables.values() for row in rows[:1] for column in row))
    for name in (x, y):  # a stage that has just begun may not have it yet
        if tables and name not in columns:
            raise ValueError(f"{run} has no metric {name!r}: expected one of {columns}")
    pairs: list[tuple[float, float]] = []
    start = 0.0
    for table, rows in tables.items():
        own, end = _numbers(table, rows, x, y)
        pairs += [(start + at, value) for at, value in own]
        start += end
    if not pairs:
        raise ValueError(f"{run} has no row with both {x!r} and {y!r}")
    points = np.array(pairs)
    return points[:, 0], points[:, 1]


def metrics_files(run: Path) -> list[Path]:
    """Return the `metrics.csv` of a run, or of its stages in order; nothing if there is none."""
    stages = (run / "stages").glob("*_*/metrics.csv")
    in_order = sorted(stages, key=lambda file: (file.parent.name.index("_"), file.parent.name))  # 10_end after 9_middle
    return in_order or [file for file in (run / "metrics.csv",) if file.is_file()]


def _rows(table: Path) -> list[dict[str, str]]:
    try:
        with table.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{table} is not a table of metrics: {error}") from error


def _numbers(table: Path, rows: list[dict[str, str]], x: str, y: str) -> tuple[list[tuple[float, float]], float]:
    """Return the numbers of both columns from the rows that have both, and the last one of the first column."""
    try:
        positions = [float(row[x]) for row in rows if row.get(x)]
        pairs = [(float(row[x]), float(row[y])) for row in rows if row.get(x) and row.get(y)]
    except ValueError as error:
        raise ValueError(f"{table} is damaged: {error} in {x!r} or {y!r}, expected numbers") from error
    if not all(map(math.isfinite, positions)):
        raise ValueError(f"{table} has values of {x!r} that are not finite: choose another x")
    return [pair for pair in pairs if not math.isnan(pair[1])], positions[-1] if positions else 0.0


def summarise_runs(runs: Sequence[Path], x: str, y: str, smooth: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the mean curve of the runs of several seeds and its 95 % bootstrap interval; see `draw_learning_curves`.

    Returns:
        Horizontal positions (P,) that all runs cover, means (P,), and intervals (2, P).
    """
    curves = []
    for run in runs:
        at, values = read_metric(run, x, y)
        if (np.diff(at) < 0.0).any():
            raise ValueError(f"{run} has values of {x!r} that fall: choose another x")
        window = min(smooth, len(values))
        curves.append((at[window - 1 :], np.convolve(values, np.ones(window) / window, mode="valid")))
    grid = np.linspace(max(at[0] for at, _ in curves), min(at[-1] for at, _ in curves), _POINTS)
    if grid[0] > grid[-1]:
        raise ValueError(f"the runs {', '.join(map(str, runs))} have no {x!r} in common: expected runs that overlap")
    table = np.stack([np.interp(grid, at, values) for at, values in curves])  # (runs, P)
    interval = np.array([bootstrap_interval(column) for column in table.T]).T
    return grid, table.mean(axis=0), interval


def draw_learning_curves(
    groups: Mapping[str, Sequence[Path]], out: Path, *, x: str = "updates", y: str = "episode/return", smooth: int = 5
) -> dict[str, float]:
    """Draw one curve per group of runs.

    Args:
        groups: Folders of the runs of each group, by label.
        out: PNG file to write.
        x: Column of the horizontal axis.
        y: Column to draw.
        smooth: Number of rows of the moving average over each run.

    Returns:
        Mean at the last common position, by label.
    """
    last = {}
    with complete_file(out) as unfinished, drawing(unfinished, size=(5.6, 3.8)) as ((axes,),):
        for label, runs in groups.items():
            grid, mean, (low, high) = summarise_runs(runs, x, y, smooth)
            count = "1 seed" if len(runs) == 1 else f"{len(runs)} seeds"
            (line,) = axes.plot(grid, mean, label=f"{label} ({count})")
            axes.fill_between(grid, low, high, color=line.get_color(), alpha=0.2, lw=0)
            last[label] = float(mean[-1])
        axes.set_xlabel(readable(x))
        axes.set_ylabel(readable(y))
        axes.legend(fontsize=8)
    return last
