"""Evaluation of several agents, such as those of several training seeds, and a table that puts them side by side."""

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coachable.evaluation.evaluate import evaluate
from coachable.evaluation.style_grid import markdown_table, write_csv
from coachable.training.weights import load_policy


def evaluate_agents(sources: Sequence[str | Path], out: Path, **settings: Any) -> str:
    """Evaluate one agent, or several and compare their results.

    The results of several agents are in folders of their own, numbered in the order of `sources`, and `agents.csv` has
    the table of `side_by_side`: of the domain's bounds if its evaluation has any, otherwise of all numbers of
    `summary.json`.

    Args:
        sources: Checkpoints, run folders, weights files, or names of domains that ship with weights.
        out: Folder for the results, created if missing.
        **settings: Further arguments of `evaluate`.

    Returns:
        The report of a single agent, or the table, as Markdown.

    Raises:
        ValueError: If the agents belong to different domains.
    """
    if len(sources) == 1:
        return evaluate(sources[0], out, **settings)
    domains = dict.fromkeys(load_policy(source).metadata["domain"] for source in sources)
    if len(domains) > 1:
        raise ValueError(f"agents of {' and '.join(domains)} given: expected agents of one domain")
    summaries = {}
    for number, source in enumerate(sources, start=1):
        folder = out / f"{number}_{Path(source).name}"
        evaluate(source, folder, **settings)
        summary = json.loads((folder / "summary.json").read_text())
        summaries[folder.name] = _numbers(summary.get("bounds", summary))
    rows = side_by_side(summaries)
    if rows:
        write_csv(rows, out / "agents.csv")
    return table_of(rows, ".4g")


def side_by_side(summaries: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    """Return a row per number that all agents name, with its mean and standard deviation over the agents.

    Args:
        summaries: Numbers by name, by agent. The mean and the deviation leave out NaN; a number that is NaN everywhere
            has no row.

    Example:
        >>> side_by_side({"0": {"laps": 3.0, "off": 0.1}, "1": {"laps": 5.0}})
        [{'quantity': 'laps', '0': 3.0, '1': 5.0, 'mean': 4.0, 'std': 1.4142135623730951}]
    """
    first, *others = summaries.values()
    rows = []
    for name in first:
        if all(name in other for other in others):
            values = {agent: summary[name] for agent, summary in summaries.items()}
            known = [value for value in values.values() if not math.isnan(value)]
            if known:
                spread = statistics.stdev(known) if len(known) > 1 else math.nan
                rows.append({"quantity": name, **values, "mean": statistics.fmean(known), "std": spread})
    return rows


def table_of(rows: Sequence[Mapping[str, Any]], form: str) -> str:
    """Return the rows of `side_by_side` as Markdown, numbers in a format, or an empty text if there are none."""
    return markdown_table(rows, {name: "" if name == "quantity" else form for name in rows[0]}) if rows else ""


def _numbers(summary: Any, name: str = "") -> dict[str, float]:
    """Return the numbers of a nested summary by their paths, such as "trial, laps"; NaN for those that are missing."""
    if isinstance(summary, dict):
        parts = summary.items()
    elif isinstance(summary, list):
        parts = enumerate(summary)
    else:
        number = isinstance(summary, int | float) and not isinstance(summary, bool)
        return {name: float(summary)} if number else {name: math.nan} if summary is None else {}
    return {
        path: value
        for key, part in parts
        for path, value in _numbers(part, f"{name}, {key}" if name else str(key)).items()
    }
