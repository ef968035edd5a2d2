"""Laps on circuits that an agent was trained on and on others, beside quasi-steady-state laps."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coachable.domain import Domain
from coachable.domains.racing.families import training_tracks, typical_car
from coachable.domains.racing.frontier import TANK, LapProgramme
from coachable.domains.racing.metrics import TelemetryMeasures
from coachable.envs.racing.circuit.circuits import HELD_OUT, SHIPPED, load_tracks
from coachable.envs.racing.physics.cars import Resources, load_car
from coachable.envs.racing.physics.simulation import CONTROL_STEP
from coachable.envs.racing.race.scenarios import FUEL, SOLO, Conditions
from coachable.evaluation.episode_records import record_styles
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.statistics import bootstrap_interval
from coachable.evaluation.style_grid import markdown_table, mean_of, rows_where
from coachable.training.weights import LoadedPolicy

TRIAL_STEPS = 6000  # ten minutes: two laps of the longest circuit
DRIVEN = (*SHIPPED, *HELD_OUT)
_SHOWN = {"circuit": "", "trained": "", "kilometres": ".1f", "fuel": ".0f", "laps": "", "clean_laps": ".0%"}
_SHOWN |= {"mean_lap": ".2f", "quasi_steady_state": ".2f", "over": "+.1%", "off": ".2%", "retired": ".0%"}
_UNITS = {"fuel": "l", "mean_lap": "s", "quasi_steady_state": "s"}


def cut_laps(distance: np.ndarray, off: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a drive into laps.

    Args:
        distance: Distance covered at each step (T,) [m].
        off: Whether three wheels are off the track at any time of each step (T,).
        length: Length of the circuit [m].

    Returns:
        For each completed lap, counted from the start: its time [s], whether the car was never off the track, and the
        step in which it ends.
    """
    if not len(distance):
        return np.zeros(0), np.zeros(0, dtype=bool), np.zeros(0, dtype=np.int64)
    furthest = np.maximum.accumulate(distance)
    ends = length * np.arange(1, int(furthest[-1] // length) + 1)
    steps = np.searchsorted(furthest, ends)
    before = np.where(steps > 0, furthest[np.maximum(steps - 1, 0)], 0.0)
    crossed = CONTROL_STEP * (steps + (ends - before) / (furthest[steps] - before))
    return np.diff(crossed, prepend=0.0), np.diff(np.cumsum(off)[steps], prepend=0.0) == 0.0, steps


def drive_circuits(domain: Domain, agent: LoadedPolicy, settings: EvaluationSettings) -> list[dict[str, Any]]:
    """Drive alone on the shipped circuits, on held-out ones and on the user's, in the default style.

    Args:
        domain: Racing domain, as the agent was trained in.
        agent: Policy, which acts deterministically.
        settings: `episodes` is the number of cars on each circuit, each from its own place; `steps` is the length of
            their drives, 6000 (ten minutes) at most and by default; the option `track` is a further circuit.

    Returns:
        A row per circuit: whether the agent was trained on it, completed laps, share of them that never left the track,
        mean lap after the first one and quasi-steady-state lap [s], share of time off the track, share of cars that
        retired. "over" and its 95 % interval are of the lap times above the quasi-steady state, as a share of it. The
        family "resources" starts with three quarters of a tank [l], the others with the fuel of their trainings.
    """
    family, trained_in = domain.name.removeprefix("racing_"), agent.config.get("env", {})
    # Enough for the whole trial, and half a tank; the other families keep the fuel that they start with.
    fuel, load = (0.75 * TANK, TANK / 2) if family == "resources" else (FUEL, FUEL)
    tracks = load_tracks(DRIVEN)
    if "track" in settings.env_options:
        tracks += (settings.env_options["track"],)
    steps = min(settings.steps or TRIAL_STEPS, TRIAL_STEPS)
    count = len(tracks) * settings.episodes
    record = record_styles(
        domain,
        agent.actor,
        agent.space,
        agent.space.default.repeat(count, 1),
        f"{len(tracks)} circuits",
        measures=TelemetryMeasures("distance", "off", "off_time"),
        track=tracks,  # row i is on circuit i modulo their number
        cars=1,
        controlled=1,
        driver=None,
        scenarios=SOLO,
        conditions=Conditions(fuel=fuel),
        episode_steps=steps + 1,
        **{**settings.rollout, "steps": steps},
    )
    distance, off, off_time = (record.measures[name].double().numpy() for name in ("distance", "off", "off_time"))
    alive = record.alive.numpy()
    trained, car = training_tracks(family, trained_in), load_car(typical_car(family, trained_in))
    rows = []
    for index, track in enumerate(tracks):
        own = range(index, count, len(tracks))
        driven = [(distance[:, i][alive[:, i]], off_time[:, i][alive[:, i]] > 0.0) for i in own]
        times, clean, _ = zip(*(cut_laps(*drive, track.length) for drive in driven), strict=True)
        [bound] = LapProgramme(track, car, Resources(), fuel=load).laps("fuel", [0.0])
        flying = np.array([*np.concatenate([lap[1:] for lap in times]), np.nan])
        mean, (low, high) = mean_of(flying), bootstrap_interval(flying / bound.time - 1.0)
        rows.append(
            {
                "circuit": track.name,
                "trained": "yes" if track.name in trained else "no",
                "kilometres": track.length / 1000.0,
                "fuel": fuel,
                "laps": sum(map(len, times)),
                "clean_laps": float(np.concatenate(clean).mean()) if sum(map(len, clean)) else 0.0,
                "mean_lap": mean,
                "quasi_steady_state": bound.time,
                "over": mean / bound.time - 1.0,
                "over_low": low,
                "over_high": high,
                "off": float(np.concatenate([off[:, i][alive[:, i]] for i in own]).mean()),
                "retired": float(1.0 - record.survived.double().numpy()[list(own)].mean()),
            }
        )
    return rows


def circuits_report(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the section on circuits of a report as Markdown, from `drive_circuits`."""
    text = "\n## Circuits\n\nAlone, in the default style.\n\n" + markdown_table(rows, _SHOWN, _UNITS)
    text += "\nTrained: whether the agent was trained on the circuit. Fuel: at the start; only the family `resources` "
    text += "uses fuel up, and its bound is on half a tank. Laps: completed ones; clean if three wheels were never off "
    text += "the track at once. Mean lap: after the first one; over: above the quasi-steady state of a point mass. "
    text += "Off: share of the time off the track. Retired: share of the cars that stopped, drove backwards or left "
    return text + "the track for good.\n"


def circuits_summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Return the means of `drive_circuits` over the circuits that the agent was trained on, and over the others.

    "circuits" is their number, and "circuits_timed" that of circuits with a lap after the first one, over which "over"
    is the mean.
    """
    summary = {}
    for label, trained in (("trained", "yes"), ("unseen", "no")):
        own = rows_where(rows, trained=trained)
        if own:
            names = ("clean_laps", "over", "off", "retired")
            means = {name: mean_of(np.array([row[name] for row in own])) for name in names}
            timed = sum(not np.isnan(row["over"]) for row in own)
            summary[label] = {"circuits": len(own), "circuits_timed": timed, **means}
    return summary
