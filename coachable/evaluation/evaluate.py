"""`coachable evaluate`: the style grid, the trials and the switching test of an agent, as tables and a figure."""

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coachable.domain import Domain
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.figures import draw_style_grid
from coachable.evaluation.statistics import wilson_interval
from coachable.evaluation.style_grid import (
    StyleGrid,
    evaluate_grid,
    markdown_table,
    mean_of,
    measured_column,
    policy_sentence,
    published,
    write_results,
)
from coachable.evaluation.switching import SwitchReport, evaluate_switching
from coachable.evaluation.wording import counted, units_of, with_unit
from coachable.training.weights import LoadedPolicy, domain_of, load_policy


def evaluate(source: str | Path, out: Path, *, env_options: Mapping[str, str] | None = None, **settings: Any) -> str:
    """Evaluate an agent and write the results into a folder, by default those of `evaluate_styles`.

    Args:
        source: Checkpoint, run folder, weights file, or the name of a domain that ships with weights.
        out: Folder for the results, created if missing.
        env_options: Options of the domain's environment as texts, see `Domain.env_options`.
        **settings: Further arguments of `EvaluationSettings`.

    Returns:
        The report as Markdown.

    Raises:
        ValueError: If `episodes` is below 1, or if the domain has no such option, or not with such a value.
        CheckpointError: If the source does not hold a usable policy of its domain.
    """
    asked = EvaluationSettings(**settings)
    agent = load_policy(source)
    domain = domain_of(agent)
    asked = replace(asked, env_options=domain.read_options(env_options or {}))
    out.mkdir(parents=True, exist_ok=True)
    if domain.evaluation is not None:
        return domain.evaluation(domain, agent, out, asked)
    return evaluate_styles(domain.with_options(asked.env_options), agent, out, asked)[0]


def evaluate_styles(
    domain: Domain, agent: LoadedPolicy, out: Path, settings: EvaluationSettings
) -> tuple[str, StyleGrid]:
    """Evaluate an agent in the styles of its domain's grid, in the domain's trials, and while the style switches.

    The files in the existing folder `out` are `grid.csv`, `response.csv`, `medians.csv`, `trials.csv`, `report.md`,
    `grid.png` and `summary.json`.

    Returns:
        The report as Markdown, and the measurements in the styles of the grid.
    """
    episodes, switch_episodes = settings.episodes, settings.switch_episodes
    grid = evaluate_grid(domain, agent.actor, agent.space, episodes=episodes, **settings.rollout)
    trials = _evaluate_trials(domain, agent, settings)
    switching = None
    if switch_episodes:
        switching = evaluate_switching(domain, agent.actor, agent.space, episodes=switch_episodes, **settings.rollout)
    tables = {"grid": grid.rows(), "response": grid.response(agent.space)}
    tables |= {"medians": _median_rows(domain, grid), "trials": trials}
    title = f"{domain.name}: {counted(episodes, 'episode')} of {grid.steps} steps per style, 95 % intervals"
    draw_style_grid(grid, domain, agent.space, out / "grid.png", title)
    report = _report(domain, agent, grid, tables, switching, switch_episodes)
    return write_results(out, report, _summary(grid, tables, switching), tables), grid


def _evaluate_trials(domain: Domain, agent: LoadedPolicy, settings: EvaluationSettings) -> list[dict[str, Any]]:
    """Return a row per trial of the domain: how many episodes in the default style survive, with Wilson intervals."""
    rows = []
    count = max(1, round(1.8 * settings.episodes))  # 36 for 20 episodes per style
    style = agent.space.describe(agent.space.default)
    for label, options in domain.trials.items():
        grid = evaluate_grid(
            domain, agent.actor, agent.space, episodes=count, cells=[style], env_options=options, **settings.rollout
        )
        survived = round(grid.episodes["survived"].sum())
        low, high = wilson_interval(survived, count)
        rows.append({"trial": label, "episodes": count, "survived": survived, "share_low": low, "share_high": high})
    return rows


def _median_formats(domain: Domain, grid: StyleGrid) -> dict[str, str]:
    """Return the formats, by name, of the metrics whose medians are reported if the domain has targets.

    These are the published metrics that no parameter requests, and all that have a target.
    """
    if not domain.targets:
        return {}
    names = {measured_column(name, grid.cells[0]): name for name in grid.episodes}
    formats = {names[column]: form for column, form in published(domain, grid.episodes, grid.cells[0]).items()}
    own = {name: form for name, form in formats.items() if name not in grid.cells[0]}
    if unknown := domain.targets.keys() - grid.episodes.keys():
        warnings.warn(
            f"targets of the domain {domain.name} name {', '.join(sorted(unknown))}: expected some of "
            f"{', '.join(grid.episodes)}",
            stacklevel=2,
        )
    return own | {name: formats.get(name, ".3g") for name in domain.targets if name in grid.episodes}


def _median_rows(domain: Domain, grid: StyleGrid) -> list[dict[str, Any]]:
    """Return a row per metric of `_median_formats`: its median, lowest and highest style, and its target."""
    rows = []
    for name in _median_formats(domain, grid):
        means = np.array([mean_of(values) for values in grid.episodes[name]])
        means = means[~np.isnan(means)]
        median, lowest, highest = np.percentile(means, [50, 0, 100]) if len(means) else [math.nan] * 3
        row: dict[str, Any] = {"measure": name, "unit": domain.units.get(name, "")}
        row |= {"median": float(median), "lowest": float(lowest), "highest": float(highest)}
        target = domain.targets.get(name)
        met = "" if target is None else "yes" if median <= target else "no"
        rows.append(row | {"at_most": "" if target is None else f"{target:g}", "met": met})
    return rows


def _summary(
    grid: StyleGrid, tables: dict[str, list[dict[str, Any]]], switching: SwitchReport | None
) -> dict[str, Any]:
    """Return the lowest, mean and highest cell of each metric, and the results of the trials and the switching test."""
    spans = {}
    for name, values in grid.episodes.items():
        means = [mean for mean in map(mean_of, values) if not math.isnan(mean)]
        if means:
            spans[name] = {"lowest_cell": min(means), "mean": sum(means) / len(means), "highest_cell": max(means)}
    summary: dict[str, Any] = {
        "grid": spans,
        "cells": len(grid.cells),
        "episodes_per_cell": grid.episodes["survived"].shape[1],
        "seed": grid.seed,
    }
    if switching:
        counts = {"complied": switching.complied, "switches": switching.switches}
        summary["switching"] = {**switching.metrics, **counts}
    if tables["medians"]:
        summary["medians"] = {row["measure"]: row["median"] for row in tables["medians"]}
    if tables["trials"]:
        summary["trials"] = {row["trial"]: row["survived"] / row["episodes"] for row in tables["trials"]}
    return summary


def _report(
    domain: Domain,
    agent: LoadedPolicy,
    grid: StyleGrid,
    tables: dict[str, list[dict[str, Any]]],
    switching: SwitchReport | None,
    switch_episodes: int,
) -> str:
    rows, response, medians, trials = (tables[name] for name in ("grid", "response", "medians", "trials"))
    columns = {name: ".6g" if isinstance(value, float) else "" for name, value in grid.cells[0].items()}
    columns |= published(domain, grid.episodes, grid.cells[0])
    text = f"# {domain.name}: requested and measured style\n\n"
    text += f"{policy_sentence(agent)}; {counted(int(rows[0]['episodes']), 'episode')} of "
    text += f"{grid.steps} steps per style, seed {grid.seed}.\n\n![style grid](grid.png)\n\n"
    text += markdown_table(rows, columns, units_of(domain, agent.space, columns))
    if medians:
        text += f"\n## Median of the {len(rows)} styles, and its target\n\n"
        numbers = ("median", "lowest", "highest")
        formats = _median_formats(domain, grid)
        shown = [row | {n: format(row[n], formats[row["measure"]]) for n in numbers} for row in medians]
        text += markdown_table(shown, dict.fromkeys(medians[0], ""))
    if response:
        text += "\n## Response to the request\n\n"
        numbers = ("slope", "rank_correlation", "mean_error")
        units = units_of(domain, agent.space, dict.fromkeys(agent.space.names, ""))
        shown = [row | {"parameter": with_unit(row["parameter"], units.get(row["parameter"], ""))} for row in response]
        formats = {name: ".3f" if name in numbers else "" for name in response[0]}
        text += markdown_table(shown, formats, units_of(domain, agent.space, formats))
        text += "\nThe mean error is in the unit of the parameter.\n"
    if trials:
        text += "\n## Trials in the default style\n\n"
        text += markdown_table(
            trials, {"trial": "", "episodes": "", "survived": "", "share_low": ".0%", "share_high": ".0%"}
        )
    if switching is None:
        return text
    median = f"{switching.median_seconds:.2f} s" if len(switching.comply_seconds) else "never"
    text += f"\n## Style switched at random every {switching.period} steps ({counted(switch_episodes, 'episode')})\n\n"
    formats = {name: ".0%" if domain.columns.get(name, "").endswith("%") else ".3f" for name in switching.metrics}
    text += markdown_table([switching.metrics], formats, units_of(domain, agent.space, formats))
    if not switching.switches:
        return text + "\nNo episode reached a switch after which compliance could be judged.\n"
    text += f"\nComplied before the next switch: {switching.complied:.0%} of {switching.switches} switches; "
    return text + f"median time to comply {median}.\n"
