"""Evaluation of saving: gain and cost of stints under rising weights, with the frontier (paper, Figure 2)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from coachable.domain import Domain
from coachable.domains.racing.bounds import (
    bounds_report,
    bounds_summary,
    lap_bounds,
    saving_bounds,
    traffic_bounds,
)
from coachable.domains.racing.families import home_track, typical_car
from coachable.domains.racing.frontier import TANK, WORN, sweep
from coachable.domains.racing.laps import circuits_report, circuits_summary, cut_laps, drive_circuits
from coachable.domains.racing.metrics import TelemetryMeasures
from coachable.domains.racing.traffic import draw_traffic, race_in_traffic, traffic_report, traffic_response
from coachable.envs.racing.circuit.circuits import HELD_OUT, load_track
from coachable.envs.racing.physics.cars import Resources
from coachable.envs.racing.race.scenarios import SOLO, Conditions
from coachable.evaluation.episode_records import record_styles
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.figures import drawing, shade
from coachable.evaluation.statistics import bootstrap_interval, comparison_interval, rank_correlation
from coachable.evaluation.style_grid import markdown_table, mean_of, policy_sentence, rows_where, write_results
from coachable.training.weights import LoadedPolicy

WEIGHTS = {"fuel": "fuel", "tyre": "tire"}  # style weight of each resource
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the largest weight
COMPARED = 6  # flying laps of each stint whose times are compared; the first lap is on cold tyres
STINT_STEPS = 9000  # 15 minutes
UNSEEN = HELD_OUT[0]  # circuit of the stints besides the agent's own
_COLD = 40.0  # [°C]
# Fuel of the frontier [l]: a stint on fuel carries about three quarters of a tank in the laps that are compared, one on
# tyres a full tank, because no fuel is used.
LOADS = {"fuel": 0.75 * TANK, "tyre": TANK}
_PRICES = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 9.0, 12.0, 16.0, 24.0, 40.0, 70.0)  # of the frontier, see `LapProgramme.laps`


@dataclass(frozen=True)
class Stint:
    """Result of one car in a stint.

    Attributes:
        laps: Times of the completed laps, counted from the car's start [s].
        clean: Whether each lap had at most two wheels off the track at any time.
        left: State of the resource at the end of each lap: fuel left [l], or wear.
        per_km: Resource used per kilometre after the first lap, or NaN if there is no other lap.
    """

    laps: np.ndarray
    clean: np.ndarray
    left: np.ndarray
    per_km: float

    @property
    def compared(self) -> float:
        """Mean time of the laps that are compared, or NaN if there are none [s]."""
        flying = self.laps[1 : 1 + COMPARED]
        return float(flying.mean()) if len(flying) else float("nan")


def evaluate_resources(domain: Domain, agent: LoadedPolicy, out: Path, settings: EvaluationSettings) -> str:
    """Drive stints under rising weights of one resource at a time, and write the results.

    As in the paper, the other resource is switched off. The stints are on the circuit of the family, or the only one of
    the training, and on one that no preset trains on. The files are `stints.csv` (by circuit, resource and weight),
    `laps.csv` (every lap), `stints.png` (resource left and lap times over laps, on the first circuit), `tradeoff.png`
    (range against pace, with the frontier), `report.md` and `summary.json`. An agent that was trained with several cars
    also races in traffic, see `race_in_traffic`, which adds `traffic.csv` and `traffic.png`. `circuits.csv` has the
    laps of `drive_circuits`, and `bounds.csv` the targets of the family with what was measured.

    Args:
        domain: Domain racing_resources, as the agent was trained in.
        agent: Policy, which acts deterministically.
        out: Folder, which is created if it is missing.
        settings: `episodes` is the number of stints per weight, each from its own place on the track; `steps` is their
            length, by default 9000 (15 minutes).

    Returns:
        The report as Markdown.
    """
    out.mkdir(parents=True, exist_ok=True)
    trained, episodes, seed = agent.config.get("env", {}), settings.episodes, settings.seed
    car, home = typical_car("resources", trained), home_track("resources", trained)
    rates = Resources.calibrated(car)
    options: dict[str, Any] = {**settings.rollout, "steps": settings.steps or STINT_STEPS}
    rows: list[dict[str, Any]] = []
    every: list[dict[str, Any]] = []
    frontiers: dict[tuple[str, str], list[dict[str, float]]] = {}
    for track, (resource, name) in product(dict.fromkeys((home, UNSEEN)), WEIGHTS.items()):
        only = replace(rates, **{"wear" if resource == "fuel" else "fuel": 0.0})
        bound = frontiers[track, resource] = frontier(track, car, resource)
        high = dict(zip(agent.space.names, agent.space.high.tolist(), strict=True))[name]
        cells = [{name: share * high} for share in SHARES]
        asked = {"track": track, "resources": only, "conditions": Conditions(fuel=TANK, heat=_COLD), **options}
        label, metres = f"{track}, {resource}", load_track(track).length
        stints = _drive(domain, agent, cells, episodes, resource, label=label, length=metres, **asked)
        place = {"circuit": track, "resource": resource}
        rows += [place | row for row in _rows(resource, [cell[name] for cell in cells], stints, bound)]
        for cell, group in zip(cells, stints, strict=True):
            for number, stint in enumerate(group):
                every += [
                    {**place, "weight": cell[name], "stint": number, "lap": lap + 1}
                    | {"time": float(time), "left": float(stint.left[lap]), "clean": bool(stint.clean[lap])}
                    for lap, time in enumerate(stint.laps)
                ]
    summary = _summary(rows, episodes, seed)
    traffic = race_in_traffic(domain, agent, settings) if trained.get("cars", 1) > 1 else []
    circuits = drive_circuits(domain, agent, settings)
    summary["circuits"] = circuits_summary(circuits)
    response = traffic_response(traffic)
    bounds = lap_bounds(circuits, home) + saving_bounds(rows) + traffic_bounds(response)
    summary["bounds"] = bounds_summary(bounds)
    report = _report(agent, rows, summary, seed, episodes) + circuits_report(circuits)
    if traffic:
        summary["traffic"] = response
        report += traffic_report(traffic, response)
        draw_traffic(traffic, out / "traffic.png")
    _draw_stints(rows_where(every, circuit=home), out / "stints.png")
    _draw_tradeoff(rows, frontiers, out / "tradeoff.png")
    tables = {"bounds": bounds, "stints": rows, "laps": every, "traffic": traffic, "circuits": circuits}
    return write_results(out, report + bounds_report(bounds), summary, tables)


def frontier(track: str, car: str, resource: str) -> list[dict[str, float]]:
    """Return lap time [s] and range [km] of a point mass on a fixed line, with the fuel of `LOADS`, the fastest first.

    Args:
        track: Name of a shipped circuit.
        car: Name of a shipped car.
        resource: "tyre" or "fuel".
    """
    length = load_track(track).length / 1000.0
    stock, spent = (WORN, "wear_per_lap") if resource == "tyre" else (TANK, "fuel_per_lap")
    laps = sweep(car, resource, _PRICES, track=track, fuel=LOADS[resource])
    return [{"lap_time": lap["lap_time"], "range_km": length * stock / lap[spent]} for lap in laps]


def _drive(
    domain: Domain,
    agent: LoadedPolicy,
    cells: Sequence[Mapping[str, float]],
    episodes: int,
    resource: str,
    *,
    label: str,
    length: float,
    **options: Any,
) -> list[list[Stint]]:
    """Drive the stints of each cell, each from its own place on a track of the given length [m]."""
    space, count = agent.space, len(cells) * episodes
    theta = space.make_all(cells).repeat_interleave(episodes, 0)
    record = record_styles(
        domain,
        agent.actor,
        space,
        theta,
        f"{label}: {count} stints",
        measures=TelemetryMeasures("distance", "fuel", "wear", "off_time"),
        scenarios=SOLO,
        episode_steps=options["steps"] + 1,
        **options,
    )
    measured = {name: values.double().numpy() for name, values in record.measures.items()}
    alive = record.alive.numpy()
    stints = [_stint(measured, alive, row, length, resource) for row in range(count)]
    return [stints[i * episodes : (i + 1) * episodes] for i in range(len(cells))]


def _stint(measured: Mapping[str, np.ndarray], alive: np.ndarray, row: int, length: float, resource: str) -> Stint:
    """Return the stint of one row from the measures (T, N) of all cars."""
    driven = {name: values[:, row][alive[:, row]] for name, values in measured.items()}
    distance, off = driven["distance"], driven["off_time"] > 0.0
    left = driven["fuel" if resource == "fuel" else "wear"]
    running = left > 0.0 if resource == "fuel" else left < 1.0  # later steps use nothing
    distance, off, left = distance[running], off[running], left[running]
    times, clean, steps = cut_laps(distance, off, length)
    per_km = float("nan")
    if len(steps) > 1:  # the first lap contains the start
        first, last = steps[0], steps[-1]
        per_km = float(abs(left[last] - left[first]) / ((distance[last] - distance[first]) / 1000.0))
    return Stint(laps=times, clean=clean, left=left[steps], per_km=per_km)


def _rows(
    resource: str, weights: Sequence[float], stints: Sequence[Sequence[Stint]], bound: Sequence[Mapping[str, float]]
) -> list[dict[str, Any]]:
    """Return range and pace for each weight, and their differences from those at a weight of 0."""
    rows = []
    capacity = TANK if resource == "fuel" else WORN
    reach = capacity / np.maximum([[stint.per_km for stint in group] for group in stints], 1e-9)
    pace = np.array([[stint.compared for stint in group] for group in stints])
    for index, weight in enumerate(weights):
        low, high = bootstrap_interval(reach[index])
        gain = comparison_interval(reach[index], reach[0], lambda own, neutral: own / neutral - 1.0)
        lost = comparison_interval(pace[index], pace[0], np.subtract)
        range_km, lap_time = mean_of(reach[index]), mean_of(pace[index])
        clean = np.concatenate([stint.clean for stint in stints[index]])
        rows.append(
            {
                "weight": weight,
                "range_km": range_km,
                "range_km_low": low,
                "range_km_high": high,
                "range_gain": range_km / mean_of(reach[0]) - 1.0,
                "range_gain_low": gain[0],
                "range_gain_high": gain[1],
                "lap_time": lap_time,
                "seconds_lost": lap_time - mean_of(pace[0]),
                "seconds_lost_low": lost[0],
                "seconds_lost_high": lost[1],
                "frontier_km": range_at(bound, lap_time),
                "laps": len(clean),
                "clean_laps": float(clean.mean()) if len(clean) else 0.0,
            }
        )
    return rows


def range_at(bound: Sequence[Mapping[str, float]], lap_time: float) -> float:
    """Return the range of the frontier at a lap time, or NaN outside its points [km].

    Args:
        bound: Points of `frontier`, the fastest lap first.
        lap_time: Lap time [s].
    """
    times, ranges = ([point[name] for point in bound] for name in ("lap_time", "range_km"))
    return float(np.interp(lap_time, times, ranges, left=np.nan, right=np.nan))


def _summary(rows: Sequence[Mapping[str, Any]], episodes: int, seed: int) -> dict[str, Any]:
    summary: dict[str, Any] = {}
    for track, resource in dict.fromkeys((row["circuit"], row["resource"]) for row in rows):
        own = rows_where(rows, circuit=track, resource=resource)
        weights, reach = (np.array([row[name] for row in own]) for name in ("weight", "range_km"))
        summary.setdefault(track, {})[resource] = {
            "rank_correlation": rank_correlation(weights, reach),
            "range_gain": own[-1]["range_gain"],
            "seconds_lost": own[-1]["seconds_lost"],
        }
    return summary | {"stints_per_weight": episodes, "seed": seed}


def _draw_stints(laps: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the mean resource left and lap times over laps, with one column per resource and one line per weight."""
    labels = {"fuel": "fuel left [l]", "tyre": "mean tyre wear"}
    with drawing(path, 2, len(WEIGHTS), size=(9.5, 6.4)) as axes:
        for column, (resource, name) in enumerate(WEIGHTS.items()):
            own = rows_where(laps, resource=resource)
            weights = sorted({lap["weight"] for lap in own})
            for index, weight in enumerate(weights):
                color = shade(index, len(weights))
                numbers = sorted({lap["lap"] for lap in own if lap["weight"] == weight})
                for row, key in enumerate(("left", "time")):
                    means = [
                        np.mean([lap[key] for lap in own if lap["weight"] == weight and lap["lap"] == number])
                        for number in numbers
                    ]
                    axes[row, column].plot(numbers, means, marker="o", ms=3, color=color, label=f"{name} {weight:g}")
            axes[0, column].set(
                ylabel=labels[resource], title=f"{resource} ({'tyre wear' if column == 0 else 'fuel use'} off)"
            )
            axes[1, column].set(xlabel="lap", ylabel="lap time [s]")
            axes[0, column].legend(fontsize=8)


def _draw_tradeoff(
    rows: Sequence[Mapping[str, Any]], frontiers: Mapping[tuple[str, str], Sequence[Mapping[str, float]]], path: Path
) -> None:
    """Draw the range over the lap time, for the agent and the frontier."""
    tracks = list(dict.fromkeys(track for track, _ in frontiers))
    with drawing(path, len(tracks), len(WEIGHTS), size=(9.5, 4.0 * len(tracks))) as panels:
        for axes, ((track, resource), bound) in zip(panels.flat, frontiers.items(), strict=True):
            own = rows_where(rows, circuit=track, resource=resource)
            times, ranges = ([point[name] for point in bound] for name in ("lap_time", "range_km"))
            axes.plot(times, ranges, ls="--", label="point mass on a fixed line")
            axes.plot([row["lap_time"] for row in own], [row["range_km"] for row in own], marker="o", label="agent")
            for row in own:
                axes.annotate(f"{row['weight']:.0f}", (row["lap_time"], row["range_km"]), fontsize=8)
            axes.set(xlabel="lap time [s]", ylabel="range [km]", title=f"{track}: {resource}, weight at each point")
            axes.legend(fontsize=8)


def _report(
    agent: LoadedPolicy, rows: Sequence[Mapping[str, Any]], summary: Mapping[str, Any], seed: int, episodes: int
) -> str:
    text = "# racing, resources: requested and measured style\n\n"
    text += f"{policy_sentence(agent)}; {episodes} stints per weight, seed {seed}. "
    text += "The other resource is switched off, as in the paper; tyres start at 40 °C, with a full tank.\n\n"
    text += "![stints](stints.png) ![range against pace](tradeoff.png)\n\n"
    formats = {"circuit": "", "resource": "", "weight": ".0f", "range_km": ".1f", "range_gain": "+.0%"}
    formats |= {"lap_time": ".2f"}
    formats |= {"seconds_lost": "+.2f", "frontier_km": ".1f", "laps": "", "clean_laps": ".0%"}
    units = {"range_km": "km", "lap_time": "s", "seconds_lost": "s", "frontier_km": "km"}
    text += markdown_table(rows, formats, units)
    text += f"\nRange: until the tank is empty, or until the tyres are worn by {WORN:.0%} on average, at the mean use. "
    text += f"Lap time: mean of {COMPARED} laps from the second one on. Frontier: range of a point mass on a fixed "
    text += "line at the same lap time, nan where it has none so slow. "
    text += f"It carries {LOADS['fuel']:g} l (fuel) or {LOADS['tyre']:g} l (tyres), about as much as the car does in "
    text += "those laps. Clean: never three wheels off the track at once.\n\n"
    places = dict.fromkeys((row["circuit"], row["resource"]) for row in rows)
    ranks = ", ".join(f"{name} on {track} {summary[track][name]['rank_correlation']:.2f}" for track, name in places)
    return text + f"Rank correlation of weight and range: {ranks}.\n"
