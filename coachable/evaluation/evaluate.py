"""`coachable evaluate`: the style grid and the switching test of a trained agent, as tables and a figure."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from coachable.domain import Domain
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.figures import draw_style_grid
from coachable.evaluation.style_grid import (
    StyleGrid,
    evaluate_grid,
    markdown_table,
    mean_of,
    policy_sentence,
    published,
    write_results,
)
from coachable.evaluation.switching import SwitchReport, evaluate_switching
from coachable.training.weights import LoadedPolicy, domain_of, load_policy


def evaluate(source: str | Path, out: Path, **settings: Any) -> str:
    """Evaluate an agent and write `grid.csv`, `response.csv`, `report.md`, `grid.png` and `summary.json` into a folder.

    Args:
        source: Checkpoint, run folder, weights file, or the name of a domain that ships with weights.
        out: Folder for the results, created if missing.
        **settings: Arguments of `EvaluationSettings`; styles switch every 100 steps.

    Returns:
        The report as Markdown.

    Raises:
        ValueError: If `episodes` is below 1.
        CheckpointError: If the source does not hold a usable policy of its domain.
    """
    agent = load_policy(source)
    domain = domain_of(agent)
    out.mkdir(parents=True, exist_ok=True)
    asked = EvaluationSettings(**settings)
    if domain.evaluation is not None:
        return domain.evaluation(domain, agent, out, asked)
    episodes, switch_episodes = asked.episodes, asked.switch_episodes
    grid = evaluate_grid(domain, agent.actor, agent.space, episodes=episodes, **asked.rollout)
    switching = evaluate_switching(domain, agent.actor, agent.space, episodes=switch_episodes, **asked.rollout)
    rows, response = grid.rows(), grid.response(agent.space)
    title = f"{domain.name}: {episodes} episodes of {grid.steps} steps per style, 95 % intervals"
    draw_style_grid(grid, domain, agent.space, out / "grid.png", title)
    report = _report(domain, agent, grid, rows, response, switching, switch_episodes)
    return write_results(out, report, _summary(grid, rows, switching), {"grid": rows, "response": response})


def _summary(grid: StyleGrid, rows: list[dict[str, Any]], switching: SwitchReport) -> dict[str, Any]:
    """Return the lowest, mean and highest cell of each metric, and the results of the switching test."""
    spans = {}
    for name, values in grid.episodes.items():
        means = [mean for mean in map(mean_of, values) if not math.isnan(mean)]
        if means:
            spans[name] = {"lowest_cell": min(means), "mean": sum(means) / len(means), "highest_cell": max(means)}
    return {
        "grid": spans,
        "cells": len(rows),
        "episodes_per_cell": grid.episodes["survived"].shape[1],
        "seed": grid.seed,
        "switching": {**switching.metrics, "complied": switching.complied, "switches": switching.switches},
    }


def _report(
    domain: Domain,
    agent: LoadedPolicy,
    grid: StyleGrid,
    rows: list[dict[str, Any]],
    response: list[dict[str, Any]],
    switching: SwitchReport,
    switch_episodes: int,
) -> str:
    columns = {name: ".6g" if isinstance(value, float) else "" for name, value in grid.cells[0].items()}
    columns |= published(domain, grid.episodes)
    text = f"# {domain.name}: requested and measured style\n\n"
    text += f"{policy_sentence(agent)}; {rows[0]['episodes']} episodes of "
    text += f"{grid.steps} steps per style, seed {grid.seed}.\n\n![style grid](grid.png)\n\n"
    text += markdown_table(rows, columns)
    if response:
        text += "\n## Response to the request\n\n"
        numbers = ("slope", "rank_correlation", "mean_error")
        text += markdown_table(response, {name: ".3f" if name in numbers else "" for name in response[0]})
    times = switching.comply_seconds
    median = f"{times.median():.2f} s" if len(times) else "never"
    text += f"\n## Style switched at random every 100 steps ({switch_episodes} episodes)\n\n"
    text += markdown_table([switching.metrics], dict.fromkeys(switching.metrics, ".3f"))
    if not switching.switches:
        return text + "\nThe episodes are too short for a switch.\n"
    text += f"\nComplied before the next switch: {switching.complied:.0%} of {switching.switches} switches; "
    return text + f"median time to comply {median}.\n"
