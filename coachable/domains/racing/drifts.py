"""Evaluation of drifting: the sideslip under rising weights, in corners and on straights, and its cost in pace."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coachable.domain import Domain
from coachable.domains.racing.bounds import bounds_report, bounds_summary, drift_bounds, lap_bounds
from coachable.domains.racing.families import home_track
from coachable.domains.racing.laps import circuits_report, circuits_summary, drive_circuits
from coachable.domains.racing.metrics import DRIFT_DEG, DRIFT_SPEED, GRIP_DEG
from coachable.envs.racing.race.features import CORNER_RADIUS, DRIFT_NAMES
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.figures import drawing
from coachable.evaluation.statistics import comparison_interval, rank_correlation
from coachable.evaluation.style_grid import (
    evaluate_grid,
    interval_of,
    markdown_table,
    mean_of,
    policy_sentence,
    rows_where,
    write_results,
)
from coachable.training.weights import LoadedPolicy

ANGLE = "sideslip_corners"
JUDGED = "rear slip angle"  # sweep of the weight that the slider of drifting moves
SWEEPS = {  # weights that rise together
    "rear slip angle": ("slip_angle_rear",),
    "rear slip angle and ratio": ("slip_angle_rear", "slip_ratio_rear"),
    "all four": DRIFT_NAMES,
}
WEIGHTS = (-0.4, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
_METRICS = (
    *("sideslip", "sideslip_corners", "sideslip_straights", "drift_corners", "drift_straights", "slip_angle_rear"),
    *("pace", "off", "turned_per_km", "backwards", "turns", "survived"),
)
_MIDDLE = 3.0  # a middle request
_AT_MIDDLE = ("sideslip_corners", "drift_corners", "drift_straights", "pace_kept", "turned_per_km")


def evaluate_drift(domain: Domain, agent: LoadedPolicy, out: Path, settings: EvaluationSettings) -> str:
    """Evaluate an agent under rising drift weights, from ordinary starts, and write the results.

    The weights of the rear slip angle, of the rear slip angle and ratio, and of all four quantities rise in turn. The
    files are `drift.csv` (by weight), `circuits.csv` (laps of `drive_circuits`), `bounds.csv` (the targets of the
    family and what was measured while the weight of the rear slip angle rises), `drift.png`, `report.md` and
    `summary.json`.

    Args:
        domain: Domain racing_drift, as the agent was trained in.
        agent: Policy, which acts deterministically.
        out: Folder, which is created if it is missing.
        settings: `episodes` is the number of episodes per weight, each from its own place on the track.

    Returns:
        The report as Markdown.
    """
    out.mkdir(parents=True, exist_ok=True)
    cells = [dict.fromkeys(names, weight) for names in SWEEPS.values() for weight in WEIGHTS]
    grid = evaluate_grid(
        domain,
        agent.actor,
        agent.space,
        episodes=settings.episodes,
        cells=cells,
        **settings.rollout,
    )
    values = {name: value.reshape(len(SWEEPS), len(WEIGHTS), -1) for name, value in grid.episodes.items()}
    weights = np.repeat(WEIGHTS, settings.episodes)
    rows: list[dict[str, Any]] = []
    summary: dict[str, Any] = {}
    for index, sweep in enumerate(SWEEPS):
        own = _rows(sweep, {name: value[index] for name, value in values.items()})
        rows += own
        summary[sweep] = {
            "rank_correlation": rank_correlation(weights, values[ANGLE][index].ravel()),
            "angle_at_none": own[WEIGHTS.index(0.0)][ANGLE],
            "angle_at_full": own[-1][ANGLE],
            "pace_kept_at_full": own[-1]["pace_kept"],
            "middle": {name: own[WEIGHTS.index(_MIDDLE)][name] for name in _AT_MIDDLE},
            "most_turns": max(row["most_turns"] for row in own),
        }
    summary |= {"episodes_per_weight": settings.episodes, "seed": settings.seed}
    _draw_drift(rows, out / "drift.png")
    circuits = drive_circuits(domain, agent, settings)
    home = home_track("drift", agent.config.get("env", {}))
    bounds = drift_bounds(rows_where(rows, sweep=JUDGED), _MIDDLE) + lap_bounds(circuits, home)
    summary |= {"circuits": circuits_summary(circuits), "bounds": bounds_summary(bounds)}
    report = _report(agent, rows, summary, grid.steps) + circuits_report(circuits) + bounds_report(bounds)
    return write_results(out, report, summary, {"bounds": bounds, "drift": rows, "circuits": circuits})


def _rows(sweep: str, episodes: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Return the means of values (weights, episodes) by weight, with 95 % intervals."""
    neutral = episodes["pace"][WEIGHTS.index(0.0)]
    rows = []
    for index, weight in enumerate(WEIGHTS):
        row: dict[str, Any] = {"sweep": sweep, "weight": weight}
        for name in _METRICS:
            low, high = interval_of(name, episodes[name][index])
            row |= {name: mean_of(episodes[name][index]), f"{name}_low": low, f"{name}_high": high}
        low, high = comparison_interval(episodes["pace"][index], neutral, np.divide)
        row |= {"pace_kept": row["pace"] / mean_of(neutral), "pace_kept_low": low, "pace_kept_high": high}
        rows.append(row | {"most_turns": float(np.nanmax(episodes["turns"][index]))})
    return rows


def _draw_drift(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the mean sideslip in corners with its 95 % interval, and the pace, over the weight; one line per sweep."""
    with drawing(path, 1, 2, size=(9.0, 3.8)) as ((left, right),):
        for sweep, marker in zip(SWEEPS, "ovs", strict=True):
            own = rows_where(rows, sweep=sweep)
            weights, angle = [row["weight"] for row in own], np.array([row[ANGLE] for row in own])
            error = np.abs(np.array([[row[f"{ANGLE}_low"], row[f"{ANGLE}_high"]] for row in own]) - angle[:, None]).T
            left.errorbar(weights, angle, error, marker=marker, capsize=3)
            right.plot(weights, [row["pace_kept"] for row in own], marker=marker, label=sweep)
        for line in (*DRIFT_DEG, GRIP_DEG):
            left.axhline(line, color="0.6", lw=1, ls=":")
        left.set(xlabel="requested weight", ylabel="sideslip in corners [deg], 95 %")
        right.set(xlabel="requested weight", ylabel="progress, share of that at 0")
        right.legend(fontsize=8, loc="lower left")  # for both panels: the lines of the left one leave no room
        for panel in (left, right):
            panel.set_ylim(0.0, None)


def _report(agent: LoadedPolicy, rows: Sequence[Mapping[str, Any]], summary: Mapping[str, Any], steps: int) -> str:
    text = "# racing, drift: requested and measured style\n\n"
    text += f"{policy_sentence(agent)}; {summary['episodes_per_weight']} episodes of "
    text += f"{steps} steps per weight, ordinary starts, the other weights 0, seed {summary['seed']}.\n\n"
    text += "![sideslip over weight](drift.png)\n\n"
    formats = {"sweep": "", "weight": "g", "sideslip_corners": ".1f", "sideslip_straights": ".1f"}
    formats |= {"drift_corners": ".0%", "drift_straights": ".0%", "slip_angle_rear": ".1f", "pace": ".1f"}
    formats |= {"pace_kept": ".0%", "off": ".1%", "turned_per_km": ".2f", "backwards": ".0%", "turns": ".1f"}
    units = dict.fromkeys((ANGLE, "sideslip_straights", "slip_angle_rear"), "deg") | {"pace": "m/s"}
    text += markdown_table(rows, formats | {"most_turns": ".0f", "survived": ".0%"}, units)
    text += "\nSideslip: mean angle between heading and velocity, 180 when driving backwards. Drift: share of "
    text += f"the time with {DRIFT_DEG[0]:g} to {DRIFT_DEG[1]:g} degrees of it above {DRIFT_SPEED:g} m/s. Corners: "
    text += f"where the track's radius is at most {CORNER_RADIUS:g} m. Rear slip angle: 0 below 5 m/s. "
    text += "Pace: along the track. Turned per km: how often the car turned to face backwards; backwards: share "
    text += "of the time that it faced so. Turns: largest rotation against the track in one direction, in whole turns, "
    text += "mean and most over episodes.\n\n"
    ranks = ", ".join(f"{sweep} {summary[sweep]['rank_correlation']:.2f}" for sweep in SWEEPS)
    return text + f"Rank correlation of weight and sideslip in corners: {ranks}.\n"
