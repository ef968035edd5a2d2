"""Style grid: several episodes for every combination of style values."""

import csv
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from tensordict.nn import InteractionType, TensorDictModuleBase

from coachable.domain import Domain
from coachable.evaluation.episode_records import RolloutOptions, record_styles
from coachable.evaluation.statistics import bootstrap_interval, rank_correlation, wilson_interval
from coachable.evaluation.wording import with_unit
from coachable.styles import Setpoint, StyleSpace
from coachable.training.weights import LoadedPolicy


@dataclass(frozen=True)
class StyleGrid:
    """Metrics of each cell of the grid.

    Attributes:
        cells: The style of each cell, by parameter name.
        episodes: Values of all episodes (cells, episodes), by metric; NaN where an episode has no value.
        seed: Seed of the initial states.
        steps: Length of a full episode.
    """

    cells: list[dict[str, Any]]
    episodes: dict[str, np.ndarray]
    seed: int
    steps: int

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per cell: style, mean of each metric, and its 95 % interval over episodes (`interval_of`)."""
        rows = []
        for index, cell in enumerate(self.cells):
            row: dict[str, Any] = {**cell, "episodes": self.episodes["survived"].shape[1]}
            for name, values in self.episodes.items():
                low, high = interval_of(name, values[index])
                column = measured_column(name, cell)
                row |= {column: mean_of(values[index]), f"{column}_low": low, f"{column}_high": high}
            rows.append(row)
        return rows

    def response(self, space: StyleSpace) -> list[dict[str, Any]]:
        """Measure how each set-point follows its request, for every combination of the other parameters.

        Returns:
            Rows with the other parameters' values, `slope` of the realised over the requested value (least squares over
            episodes), `rank_correlation`, and `mean_error`. With several set-points, the column of
            the measured one is empty.
        """
        rows = []
        known = self.episodes.keys() & self.cells[0].keys()
        names = [p.name for p in space.parameters if isinstance(p, Setpoint) and p.name in known]
        for name in names:
            own = {name: ""} if len(names) > 1 else {}
            others = [{k: v for k, v in (cell | own).items() if k != name or own} for cell in self.cells]
            for group in (other for i, other in enumerate(others) if other not in others[:i]):
                members = [i for i, other in enumerate(others) if other == group]
                realised = self.episodes[name][members].ravel()
                requested = np.repeat([self.cells[i][name] for i in members], len(realised) // len(members))
                valid = ~np.isnan(realised)
                tells = valid.any() and np.ptp(requested[valid]) > 0
                slope = np.polyfit(requested[valid], realised[valid], 1)[0] if tells else float("nan")
                row = {**group, "parameter": name, "slope": float(slope)}
                row["rank_correlation"] = rank_correlation(requested, realised)
                rows.append(row | {"mean_error": mean_of(np.abs(realised - requested))})
        return rows


def evaluate_grid(
    domain: Domain,
    policy: TensorDictModuleBase,
    space: StyleSpace,
    *,
    episodes: int = 20,
    cells: Sequence[Mapping[str, Any]] | None = None,
    env_options: Mapping[str, Any] | None = None,
    **options: Unpack[RolloutOptions],
) -> StyleGrid:
    """Run `episodes` episodes in every cell, all of them in one batch.

    Args:
        domain: Domain in which the policy acts.
        policy: Policy that reads `observation` and `style`.
        space: Its style space.
        episodes: Number of episodes per cell.
        cells: Styles by parameter name; by default the domain's grid.
        env_options: Further arguments of the domain's `make_env`.
        **options: See `RolloutOptions`.

    Raises:
        ValueError: If there are no episodes.
    """
    if episodes < 1:
        raise ValueError(f"episodes per cell must be at least 1, got {episodes}")
    cells = domain.cells() if cells is None else [dict(cell) for cell in cells]
    default = {p.name: p.default for p in space.parameters}  # as declared; theta is rounded to float32
    names = dict.fromkeys(name for cell in cells for name in cell)
    cells = [{name: cell.get(name, default.get(name)) for name in names} for cell in cells]  # as many columns in each
    theta = space.make_all(cells).repeat_interleave(episodes, 0)
    label = f"{len(cells)} styles x {episodes} episodes"
    record = record_styles(domain, policy, space, theta, label, **options, **(env_options or {}))
    values = {"survived": record.survived.float(), "steps": record.alive.sum(0).float()}
    values |= {"task_return": record.task_return, **domain.measures.summarise(record.measures, record.alive)}
    shaped = {name: value.reshape(len(cells), episodes).double().numpy() for name, value in values.items()}
    return StyleGrid(cells, shaped, options.get("seed", 0), options.get("steps") or domain.episode_steps)


def interval_of(name: str, values: np.ndarray) -> tuple[float, float]:
    """Compute the 95 % interval of the mean of a metric: Wilson's for the share that survived, otherwise by bootstrap.

    If all episodes survived, resampling them would give an interval without width.

    Args:
        name: The metric.
        values: Values (n,) of the episodes; NaN are left out.
    """
    return wilson_interval(round(values.sum()), len(values)) if name == "survived" else bootstrap_interval(values)


def measured_column(name: str, cell: Mapping[str, Any]) -> str:
    """Return the column of a metric; a measured style parameter gets a prefix to tell it from the request, `cell`."""
    return f"measured_{name}" if name in cell else name


def mean_of(values: np.ndarray) -> float:
    """Return the mean of the numbers that are not NaN, or NaN if there are none."""
    return float(np.nanmean(values)) if not np.isnan(values).all() else float("nan")


def rows_where(rows: Sequence[Mapping[str, Any]], **values: Any) -> list[Mapping[str, Any]]:
    """Return the rows that have the given values, by column name.

    Example:
        >>> rows_where([{"weight": 0, "lap": 90.1}, {"weight": 1, "lap": 91.7}], weight=1)
        [{'weight': 1, 'lap': 91.7}]
    """
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def write_csv(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write rows with the same keys as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)


def write_results(
    out: Path, report: str, summary: Mapping[str, Any], tables: Mapping[str, Sequence[Mapping[str, Any]]]
) -> str:
    """Write the results of an evaluation into a folder, and return the report.

    Args:
        out: The folder.
        report: Markdown for `report.md`.
        summary: Numbers for `summary.json`; null stands for NaN there.
        tables: Rows by file name without `.csv`; a table without rows is left out.
    """
    for name, rows in tables.items():
        if rows:
            write_csv(rows, out / f"{name}.csv")
    (out / "summary.json").write_text(json.dumps(without_nan(summary), indent=2) + "\n", encoding="utf-8")
    (out / "report.md").write_text(report, encoding="utf-8")
    return report


def without_nan(value: Any) -> Any:
    """Return nested dictionaries and lists with None instead of NaN and infinity, which JSON does not have."""
    if isinstance(value, Mapping):
        return {name: without_nan(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def markdown_table(
    rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str], units: Mapping[str, str] | None = None
) -> str:
    """Return rows as a Markdown table.

    Args:
        rows: Values by column name.
        columns: Format specification by column name; "" prints the value as it is.
        units: Units by column name, for the headings of columns that have one.

    Example:
        >>> print(markdown_table([{"pose": "t_pose", "speed": 1.234}], {"pose": "", "speed": ".2f"}, {"speed": "m/s"}))
        | pose | speed [m/s] |
        |--|--|
        | t_pose | 1.23 |
        <BLANKLINE>
    """
    headings = [with_unit(name, (units or {}).get(name, "")) for name in columns]
    lines = ["| " + " | ".join(headings) + " |", "|" + "--|" * len(columns)]
    for row in rows:
        cells = (format(row[column], spec).replace("|", "\\|") for column, spec in columns.items())
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def training_counts(agent: LoadedPolicy) -> str:
    """Return how long an agent was trained, such as "800,000 frames, 36,798 updates", or "" if that is unknown."""
    counts = {name: agent.metadata.get(name) for name in ("frames", "updates")}
    return ", ".join(f"{count:,} {name}" for name, count in counts.items() if count)


def published(domain: Domain, episodes: Mapping[str, Any], cell: Mapping[str, Any]) -> dict[str, str]:
    """Return the format of each column of a domain's table: of those that it declares, otherwise of every metric.

    Metrics are given by name, as in `StyleGrid.episodes`, together with one style of the table. Declared columns that
    were not measured are left out, with a warning.
    """
    columns = {name: measured_column(name, cell) for name in episodes}
    if not domain.columns:
        return dict.fromkeys(columns.values(), ".3g") | {"survived": ".0%"}
    declared = {column.removeprefix("measured_"): form for column, form in domain.columns.items()}
    if unknown := declared.keys() - columns.keys():
        warnings.warn(
            f"columns of the domain {domain.name} name {', '.join(sorted(unknown))}: expected some of "
            f"{', '.join(columns)}",
            stacklevel=2,
        )
    return {columns[name]: form for name, form in declared.items() if name in columns}


def policy_sentence(agent: LoadedPolicy) -> str:
    """Return a one-line description of the evaluated policy for the report's heading."""
    trained = training_counts(agent)
    return acting(agent) + (f" after {trained}" if trained else "")


def acting(agent: LoadedPolicy) -> str:
    """Return how the policy acts by default: with the mean, or with a sample."""
    samples = getattr(agent.actor, "default_interaction_type", None) is InteractionType.RANDOM
    return "Policy that samples its actions" if samples else "Deterministic policy"
