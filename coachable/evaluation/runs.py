"""Several evaluations of the same styles, one per seed or per trained agent, and their joint estimates."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from coachable.domain import Domain
from coachable.evaluation.statistics import interquartile_mean, stratified_interval
from coachable.evaluation.style_grid import StyleGrid, evaluate_grid, mean_of, measured_column
from coachable.evaluation.sweep import WeightSweep, sweep_weights
from coachable.evaluation.switching import SwitchReport, evaluate_switching
from coachable.styles import StyleSpace
from coachable.training.weights import LoadedPolicy

_MOST_COLUMNS = 3  # of style parameters in a table


class Estimate(NamedTuple):
    """Interquartile mean over runs and tasks, with its 95 % stratified bootstrap interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Run:
    """One complete evaluation.

    Attributes:
        label: Label of the run, such as "seed 3" or the agent's name.
        grid: Episodes in every style of the grid.
        switching: Episodes in which the style switches.
        sweeps: Episodes along each weight.
    """

    label: str
    grid: StyleGrid
    switching: SwitchReport
    sweeps: list[WeightSweep]


def evaluate_run(
    label: str,
    domain: Domain,
    agent: LoadedPolicy,
    *,
    episodes: int,
    switch_episodes: int,
    sweep_points: int,
    **options: Any,
) -> Run:
    """Evaluate one agent with one seed; see `coachable.evaluation.report.write_report` for the numbers."""
    return Run(
        label,
        evaluate_grid(domain, agent.actor, agent.space, episodes=episodes, **options),
        evaluate_switching(domain, agent.actor, agent.space, episodes=switch_episodes, **options),
        sweep_weights(domain, agent, points=sweep_points, episodes=episodes, **options),
    )


def estimate(scores: np.ndarray | Sequence[float]) -> Estimate:
    """Aggregate scores (runs, tasks), or scores (runs,) of one task."""
    table = np.asarray(scores)
    table = table[:, None] if table.ndim == 1 else table
    return Estimate(float(interquartile_mean(table.ravel())), *stratified_interval(table))


def sweep_estimate(sweeps: Sequence[WeightSweep], metric: str, position: int) -> Estimate:
    """Aggregate a metric over the runs' sweeps of one weight, at its value number `position`."""
    return estimate([mean_of(sweep.episodes[metric][position]) for sweep in sweeps])


class StyleTable:
    """Metrics of several runs in each style.

    Attributes:
        cells: The styles, by parameter name.
        labels: The styles in words; of more than three parameters only those that differ from the default.
        scores: Mean over each run's episodes (runs, cells), by metric.
    """

    def __init__(self, runs: Sequence[Run], space: StyleSpace) -> None:
        self.cells = runs[0].grid.cells
        self._wide = len(self.cells[0]) > _MOST_COLUMNS
        self.labels = [describe(_requested(cell, space) if self._wide else cell) for cell in self.cells]
        self.scores = {
            name: np.array([[mean_of(cell) for cell in run.grid.episodes[name]] for run in runs])
            for name in runs[0].grid.episodes
        }

    def column(self, metric: str) -> str:
        """Return the name of a metric in tables, see `measured_column`."""
        return measured_column(metric, self.cells[0])

    def of(self, metric: str, cells: Sequence[int]) -> Estimate:
        """Estimate a metric over the runs and some of the cells."""
        return estimate(self.scores[metric][:, list(cells)])

    def rows(self, metrics: Sequence[str]) -> list[dict[str, Any]]:
        """Return one row per style: its values, and an `Estimate` of each metric."""
        return [
            {
                **({"style": self.labels[i]} if self._wide else cell),
                **{self.column(metric): self.of(metric, [i]) for metric in metrics},
            }
            for i, cell in enumerate(self.cells)
        ]

    def summary(self, metrics: Sequence[str]) -> list[dict[str, Any]]:
        """Return one row per metric: all styles together, the plain mean, and the lowest and highest style."""
        rows = []
        everywhere = range(len(self.cells))
        for metric in metrics:
            per_cell = [self.of(metric, [i]) for i in everywhere]
            values = np.array([cell.value for cell in per_cell])
            row: dict[str, Any] = {
                "metric": self.column(metric),
                "all styles": self.of(metric, everywhere),
                "mean": mean_of(self.scores[metric]),
            }
            known = not np.isnan(values).all()
            for title, extreme in (("lowest", np.nanargmin), ("highest", np.nanargmax)):
                i = int(extreme(values)) if known else 0
                row |= {title: per_cell[i], f"{title} at": self.labels[i] if known else ""}
            rows.append(row)
        return rows


def response_rows(runs: Sequence[Run], space: StyleSpace) -> list[dict[str, Any]]:
    """Estimate over runs of the same grid how measured set-points follow their requests (`StyleGrid.response`).

    Returns:
        One row per set-point; `slope`, `rank_correlation` and `mean_error` are estimates over the runs.
    """
    per_run = [run.grid.response(space) for run in runs]
    rows = []
    for entries in zip(*per_run, strict=True):
        row: dict[str, Any] = {}
        for name, value in entries[0].items():
            numeric = name in ("slope", "rank_correlation", "mean_error")
            row[name] = estimate([entry[name] for entry in entries]) if numeric else value
        rows.append(row)
    return rows


def describe(cell: dict[str, Any]) -> str:
    """Return a style as text, such as "t pose, step length 0.4"."""
    if not cell:
        return "default"
    return ", ".join(f"{k} {v:g}" if isinstance(v, float | int) else f"{v}" for k, v in cell.items()).replace("_", " ")


def _requested(cell: dict[str, Any], space: StyleSpace) -> dict[str, Any]:
    return {name: value for name, value in cell.items() if value != space[name].default}


def flat_row(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row for CSV, with every `Estimate` in three columns."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Estimate):
            flat |= {name: value.value, f"{name}_low": value.low, f"{name}_high": value.high}
        else:
            flat[name] = value
    return flat
