"""`coachable curves`: learning curves of several runs, grouped, with intervals over seeds."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from coachable.evaluation.figures import drawing, readable
from coachable.evaluation.statistics import bootstrap_interval

_POINTS = 100


def read_metric(run: Path, x: str, y: str) -> tuple[np.ndarray, np.ndarray]:
    """Two columns of a run's `metrics.csv`, of the rows that have both.

    Args:
        run: the run's folder.
        x: column of the horizontal axis.
        y: column to draw.

    Raises:
        ValueError: if the file is damaged, there is no such column, or no row has both; lists the columns that exist.
    """
    table = run / "metrics.csv"
    try:
        with table.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{table} is no table of metrics: {error}") from error
    columns = list(rows[0]) if rows else []
    for name in (x, y):
        if name not in columns:
            raise ValueError(f"{run} has no metric {name!r}: expected one of {columns}")
    try:
        pairs = [(float(row[x]), float(row[y])) for row in rows if row[x] and row[y]]
    except ValueError as error:
        raise ValueError(f"{table} is damaged: {error} in {x!r} or {y!r}, expected numbers") from error
    if not all(math.isfinite(at) for at, _ in pairs):
        raise ValueError(f"{table} has values of {x!r} that are not finite: choose another x")
    if not pairs:
        raise ValueError(f"{run} has no row with both {x!r} and {y!r}")
    points = np.array(pairs)
    return points[:, 0], points[:, 1]


def summarise_runs(runs: Sequence[Path], x: str, y: str, smooth: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean curve of several runs and its 95 % bootstrap interval.

    Args:
        runs: the runs' folders, one per seed.
        x: column of the horizontal axis.
        y: column to draw.
        smooth: rows of the moving average that each run gets first.

    Returns:
        Horizontal positions (P,) up to where the shortest run ends, means (P,), and intervals (2, P).
    """
    curves = []
    for run in runs:
        at, values = read_metric(run, x, y)
        window = min(smooth, len(values))
        curves.append((at[window - 1 :], np.convolve(values, np.ones(window) / window, mode="valid")))
    grid = np.linspace(max(at[0] for at, _ in curves), min(at[-1] for at, _ in curves), _POINTS)
    table = np.stack([np.interp(grid, at, values) for at, values in curves])  # (runs, P)
    interval = np.array([bootstrap_interval(column) for column in table.T]).T
    return grid, table.mean(axis=0), interval


def draw_learning_curves(
    groups: Mapping[str, Sequence[Path]], out: Path, *, x: str = "updates", y: str = "episode/return", smooth: int = 5
) -> dict[str, float]:
    """Draw one curve per group of runs.

    Args:
        groups: label to the folders of its runs.
        out: PNG file to write.
        x: column of the horizontal axis.
        y: column to draw.
        smooth: rows of the moving average.

    Returns:
        Label to the mean at the last common position.
    """
    last = {}
    out.parent.mkdir(parents=True, exist_ok=True)
    with drawing(out, size=(5.6, 3.8)) as ((axes,),):
        for label, runs in groups.items():
            grid, mean, (low, high) = summarise_runs(runs, x, y, smooth)
            (line,) = axes.plot(grid, mean, label=f"{label} ({len(runs)} seeds)")
            axes.fill_between(grid, low, high, color=line.get_color(), alpha=0.2, lw=0)
            last[label] = float(mean[-1])
        axes.set_xlabel(readable(x))
        axes.set_ylabel(readable(y))
        axes.legend(fontsize=8)
    return last
