"""Evaluation of aggressiveness: races of five agents with different margins (paper).

Two of the five cars have the margin under test, the other three have moderate ones. The pair starts last
("pursuer") or first ("leader"), as in Werner et al. (2023). The results are its wins, places, overtakes and contacts.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domain import Domain
from coachable.domains.racing.bounds import FOLLOWS, bound, bounds_report, bounds_summary, lap_bounds, rank_interval
from coachable.domains.racing.families import home_track
from coachable.domains.racing.laps import circuits_report, circuits_summary, drive_circuits
from coachable.domains.racing.metrics import TelemetryMeasures, nearest_gaps
from coachable.envs.racing.physics.cars import POOL_GT3
from coachable.envs.racing.physics.simulation import CONTROL_STEP
from coachable.envs.racing.race.garage import POOLS
from coachable.envs.racing.race.run import Run
from coachable.envs.racing.race.scenarios import rolling_start
from coachable.evaluation.episode_records import record_episodes
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.figures import drawing, shade
from coachable.evaluation.statistics import bootstrap_interval, rank_correlation
from coachable.evaluation.style_grid import markdown_table, mean_of, policy_sentence, rows_where, write_results
from coachable.keys import STYLE_FEATURES
from coachable.training.weights import LoadedPolicy

CARS = 5
SETTINGS = {"pursuer": (3, 4), "leader": (0, 1)}  # slots of the pair on the grid, 0 in front
MARGINS = {"lateral": (0.0, 0.25, 0.5, 0.75, 1.0), "longitudinal": (0.0, 0.5, 1.0, 1.5, 2.0)}  # [m], of the pair
FIXED = {"lateral": 0.5, "longitudinal": 0.0}  # [m], of the pair, while the other margin changes
OTHERS = tuple(product((0.5, 0.75), repeat=3))  # [m], lateral margins of the other three
LAPS = 4
RACE_STEPS = 10_000
START_STEPS = 600  # a minute, in which the order of the start settles
_AGAIN = 1.0  # [s], after which touching counts as another contact
_PASSED = 5.0  # [m], about a car's length: lead at which a car that was behind has overtaken another
_METRICS = {
    "win_rate": "wins",
    "places_gained": "places gained",
    "overtakes": "overtakes per race",
    "contacts": "contacts per race",
}
_RANKED = _METRICS | {
    "places_later": "places gained after the first minute",
    "beside": "time beside others",
    "in_line": "time close ahead or behind",
}
_MEANS = ("places_gained", "places_later", "overtakes", "contacts", "contacts_per_minute", "beside", "in_line")
_MEANS += ("gap_beside", "gap_in_line", "stranded")


class _RaceMeasures(TelemetryMeasures):
    """Telemetry, the gaps to opponents beside the car and in line with it, and whether they are below all margins."""

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        features = transition.get(("next", STYLE_FEATURES))
        ahead, aside = nearest_gaps(features)
        beside, in_line = aside < MARGINS["lateral"][-1], ahead < MARGINS["longitudinal"][-1]  # False for NaN
        found = {"beside": beside.float(), "in_line": in_line.float(), "gap_beside": aside, "gap_in_line": ahead}
        return super().step(transition) | found


def evaluate_aggressiveness(domain: Domain, agent: LoadedPolicy, out: Path, settings: EvaluationSettings) -> str:
    """Race pairs with rising margins against three other copies of the agent, and write the results.

    The lateral margin of the pair rises while its longitudinal one is 0; then the longitudinal margin rises while the
    lateral one is 0.5 m. The paper gives no value of the longitudinal margin, which the opponents share. The files are
    `races.csv` (by margin, setting and requested value), `circuits.csv` (laps of `drive_circuits`), `bounds.csv` (the
    targets of the family with what was measured), `radar.png`, `report.md` and `summary.json`.

    Args:
        domain: Domain racing_aggressiveness, as the agent was trained in.
        agent: Policy of all five cars, which acts deterministically.
        out: Folder, which is created if it is missing.
        settings: `episodes` is the number of races per setting, margin and combination of the other cars' margins, of
            which there are eight; with seven, each of the 50 GT3 cars of a pool drives. A race ends when the first car
            has driven four laps, or after `steps`, 10,000 by default.

    Returns:
        The report as Markdown.
    """
    episodes, seed = settings.episodes, settings.seed
    out.mkdir(parents=True, exist_ok=True)
    cells = [(setting, name, metres) for name, margins in MARGINS.items() for setting in SETTINGS for metres in margins]
    races = [(*cell, others) for cell in cells for others in OTHERS for _ in range(episodes)]
    found = _race(domain, agent, races, len(cells), settings)
    values = {name: value.reshape(len(cells), -1, 2) for name, value in found.items()}
    rows = _rows(cells, values)
    summary: dict[str, Any] = {}
    for margin, setting in product(MARGINS, SETTINGS):
        own = rows_where(rows, margin=margin, setting=setting)
        gained = {name: np.array([row[name] for row in own]) for name in ("requested", *_RANKED)}
        ranks = {name: rank_correlation(gained["requested"], gained[name]) for name in _RANKED}
        summary.setdefault(margin, {})[setting] = ranks
    summary |= {"races_per_row": len(OTHERS) * episodes, "seed": seed}
    _draw_radar(rows, out / "radar.png")
    circuits = drive_circuits(domain, agent, settings)
    bounds = _bounds(cells, values) + lap_bounds(circuits, home_track("aggressiveness", agent.config.get("env", {})))
    summary |= {"circuits": circuits_summary(circuits), "bounds": bounds_summary(bounds)}
    report = _report(agent, rows, summary) + circuits_report(circuits) + bounds_report(bounds)
    return write_results(out, report, summary, {"bounds": bounds, "races": rows, "circuits": circuits})


def _bounds(cells: Sequence[tuple[str, str, float]], values: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Return the bounds of values (cells, races, 2): rank correlations with the margins, and stranded cars."""
    judged = {"contacts": "contacts", "overtakes": "overtakes", "places_gained": "places gained", "top_two": "wins"}
    asked = [("lateral", name, text) for name, text in judged.items()]
    asked.append(("longitudinal", "in_line", _RANKED["in_line"]))
    rows = []
    for (margin, name, text), setting in product(asked, SETTINGS):
        own = [index for index, cell in enumerate(cells) if cell[:2] == (setting, margin)]
        requested, races = np.array(MARGINS[margin]), values[name][own].mean(2)
        rank, interval = rank_correlation(requested, races.mean(1)), rank_interval(requested, races)
        label = f"{setting}: rank correlation of {text} and {margin} margin"
        rows.append(bound(label, rank, interval, at_most=-FOLLOWS))
    return [*rows, bound("stranded cars, per car and race", values["stranded"].mean(), at_most=0.0)]


def _race(
    domain: Domain,
    agent: LoadedPolicy,
    races: Sequence[tuple[str, str, float, tuple[float, ...]]],
    cells: int,
    settings: EvaluationSettings,
) -> dict[str, np.ndarray]:
    """Return the values of `_pair_results` in each race, (races, 2); the races of all cells have equal starts."""
    space, count = agent.space, len(races)
    theta = space.default.repeat(CARS, count, 1)
    theta[..., space.slices["longitudinal"]] = FIXED["longitudinal"]
    pair = np.zeros((CARS, count), dtype=bool)
    for race, (setting, margin, metres, others) in enumerate(races):
        own, lateral = FIXED | {margin: metres}, list(others)
        for slot in SETTINGS[setting]:
            lateral.insert(slot, own["lateral"])
            pair[slot, race] = True
            theta[slot, race, space.slices["longitudinal"]] = own["longitudinal"]
        theta[:, race, space.slices["lateral"]] = torch.tensor(lateral)[:, None]
    measured, length = race_alike(
        domain,
        agent,
        theta,
        _RaceMeasures("distance", "contact", "off", "stranded"),
        settings,
        copies=cells,
        steps=settings.steps or RACE_STEPS,
        scenarios=rolling_start(CARS),
    )
    values, slots = {name: value.numpy() for name, value in measured.items()}, np.arange(CARS)
    cars = [
        _pair_results({name: value[:, :, race] for name, value in values.items()}, slots, pair[:, race], LAPS * length)
        for race in range(count)
    ]
    return {name: np.stack([car[name] for car in cars]) for name in cars[0]}


def race_alike(
    domain: Domain,
    agent: LoadedPolicy,
    theta: Tensor,
    measures: TelemetryMeasures,
    settings: EvaluationSettings,
    *,
    copies: int,
    steps: int,
    **options: Any,
) -> tuple[dict[str, Tensor], float]:
    """Race copies of an agent against each other from equal starts.

    Cars are numbered by the slots that they start from, 0 in front. Stranded cars are put back on the track.

    Args:
        domain: Domain, as the agent was trained in.
        agent: Policy of all cars, which acts deterministically.
        theta: Styles of A cars in B races (A, B, d).
        measures: Measures of each step.
        settings: `seed`, and `progress` for a progress bar.
        copies: Number of races with equal starts: race b starts like race b + B / copies.
        steps: Number of steps of each race.
        **options: Options of the environment.

    Returns:
        The measures, (T, A, B) each, and the length of the track [m].
    """
    cars, races, _ = theta.shape
    env = domain.styled_env(
        agent.space,
        cars * races,
        settings.seed,
        cars=cars,
        controlled=cars,
        driver=None,
        episode_steps=steps + 1,
        put_back=True,
        copies=copies,
        **options,
    )
    simulation: Any = env.base_env
    # The slots are drawn at the start. Read them, and start again with the same seed.
    env.set_seed(settings.seed)
    env.reset()
    distance = Run(*simulation.run.unbind(0)).distance  # 0 for the first car, then negative
    car_at = (-distance.reshape(cars, races)).argsort(0)  # car in each slot
    rows = theta.gather(0, car_at.argsort(0)[..., None].expand_as(theta))
    record = record_episodes(
        env,
        agent.actor,
        rows.reshape(cars * races, -1),
        measures,
        steps=steps,
        seed=settings.seed,
        progress=f"{races} races of {cars} cars" if settings.progress else None,
    )
    measured = {name: values.reshape(-1, cars, races) for name, values in record.measures.items()}
    by_slot = {name: values.gather(1, car_at.expand_as(values)) for name, values in measured.items()}
    return by_slot, simulation.course.length


def _pair_results(
    race: Mapping[str, np.ndarray], slots: np.ndarray, chosen: np.ndarray, finish: float
) -> dict[str, np.ndarray]:
    """Return the results (2,) of the two chosen cars of a race, from the measures (T, A) of its steps."""
    distance = race["distance"]
    done = np.flatnonzero(distance.max(1) >= finish)
    end = int(done[0]) + 1 if len(done) else len(distance)
    places, early = ((-distance[step - 1]).argsort().argsort() for step in (end, min(START_STEPS, end)))
    cars = np.flatnonzero(chosen).tolist()
    touched, stranded = (race[name][:end] > 0 for name in ("contact", "stranded"))
    contacts = np.array([_count(touched[:, car]) for car in cars], dtype=float)
    return {
        "top_two": (places < 2)[chosen].astype(float),
        "won": (places == 0)[chosen].astype(float),
        "places_gained": (slots - places)[chosen].astype(float),
        "places_later": (early - places)[chosen].astype(float),
        "overtakes": np.array([_overtakes(distance[:end], car) for car in cars], dtype=float),
        "contacts": contacts,
        "contacts_per_minute": contacts / (end * CONTROL_STEP / 60.0),
        "stranded": np.array([_count(stranded[:, car]) for car in cars], dtype=float),
        **{name: race[name][:end, chosen].mean(0) for name in ("beside", "in_line", "off")},
        **{name: np.array([mean_of(race[name][:end, car]) for car in cars]) for name in ("gap_beside", "gap_in_line")},
        "metres": distance[end - 1, chosen].astype(float),
    }


def _count(touched: np.ndarray) -> int:
    """Count events of a car from its steps (T,) bool; an event within a second of the last one is the same."""
    steps = np.flatnonzero(touched)
    return int((np.diff(steps, prepend=-np.inf) > _AGAIN / CONTROL_STEP).sum()) if len(steps) else 0


def _overtakes(distance: np.ndarray, car: int) -> int:
    """Count how often a car overtook one of the others, from the distances (T, A) of all [m]."""
    gap = distance[:, [car]] - np.delete(distance, car, axis=1)
    return sum(int((np.diff(np.sign(one[np.abs(one) >= _PASSED])) > 0.0).sum()) for one in gap.T)


def _rows(cells: Sequence[tuple[str, str, float]], found: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Return the means of values (cells, races, 2) by setting and margin, with 95 % intervals."""
    rows = []
    for index, (setting, margin, requested) in enumerate(cells):
        of = {name: values[index] for name, values in found.items()}
        row: dict[str, Any] = {"margin": margin, "setting": setting, "requested": requested, "races": len(of["won"])}
        # Per race, as the two cars of a pair are not independent of each other.
        row["win_rate"] = float(of["top_two"].mean())
        row["win_rate_low"], row["win_rate_high"] = bootstrap_interval(of["top_two"].mean(1))
        row["either_won"] = float(of["won"].max(1).mean())
        for name in _MEANS:
            per_race = np.array([mean_of(pair) for pair in of[name]])
            row[name] = mean_of(per_race)
            row[f"{name}_low"], row[f"{name}_high"] = bootstrap_interval(per_race)
        rows.append(row | {"off": float(of["off"].mean()), "kilometres": float(of["metres"].mean() / 1000.0)})
    return rows


def _draw_radar(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw a radar per margin and setting, with a polygon per requested value; axes span the values of the setting."""
    angles = np.linspace(0.0, 2.0 * np.pi, len(_METRICS), endpoint=False) + np.pi / 2
    shape = (len(MARGINS), len(SETTINGS))
    with drawing(path, *shape, size=(9.5, 9.2), grid=False, subplot_kw={"projection": "polar"}) as panels:
        for panel, (margin, setting) in zip(panels.flat, product(MARGINS, SETTINGS), strict=True):
            own = rows_where(rows, margin=margin, setting=setting)
            table = np.array([[row[name] for name in _METRICS] for row in own])
            low, high = table.min(0), table.max(0)
            scaled = 0.15 + 0.85 * (table - low) / np.maximum(high - low, 1e-9)
            for index, row in enumerate(own):
                color, label = shade(index, len(own)), f"{row['requested']:g} m"
                closed = np.append(scaled[index], scaled[index, 0])
                panel.plot(np.append(angles, angles[0]), closed, color=color, marker="o", ms=3, label=label)
            labels = [f"{text}\n{a:.2f} to {b:.2f}" for text, a, b in zip(_METRICS.values(), low, high, strict=True)]
            panel.set_xticks(angles, labels, fontsize=8)
            panel.tick_params(axis="x", pad=26)  # clear of the circle, left and right
            panel.set_yticks([])
            panel.set_ylim(0.0, 1.05)
            panel.set_title(setting)
        for panel, margin in zip(panels[:, -1], MARGINS, strict=True):
            panel.legend(title=f"{margin} margin", loc="upper left", bbox_to_anchor=(1.1, 1.0), fontsize=8)


def _report(agent: LoadedPolicy, rows: Sequence[Mapping[str, Any]], summary: Mapping[str, Any]) -> str:
    text = "# racing, aggressiveness: requested margin and measured behaviour\n\n"
    text += f"{policy_sentence(agent)} in all five cars; {summary['races_per_row']} races per row, {LAPS} laps, "
    if agent.config.get("env", {}).get("car") in POOLS:
        text += f"the {POOL_GT3} GT3-like cars of the pool in turn, one model per race, "
    text += f"rolling start, seed {summary['seed']}. Two cars, which start last (pursuer) or first (leader), keep the "
    text += f"requested margin; their lateral margin is {FIXED['lateral']:g} m and their longitudinal one "
    text += f"{FIXED['longitudinal']:g} m otherwise. The other three keep 0.5 or 0.75 m laterally.\n\n"
    text += "![radar](radar.png)\n\n"
    formats = {"win_rate": ".0%", "places_gained": "+.2f", "places_later": "+.2f", "overtakes": ".1f"}
    formats |= {"contacts": ".1f", "contacts_per_minute": ".2f", "beside": ".1%", "in_line": ".1%"}
    formats |= {"gap_beside": ".2f", "gap_in_line": ".2f", "stranded": ".2f"}
    shown = [{**row, **{name: _with_interval(row, name, form) for name, form in formats.items()}} for row in rows]
    columns = {"margin": "", "setting": "", "requested": "g", **dict.fromkeys(formats, ""), "either_won": ".0%"}
    columns |= {"off": ".1%", "kilometres": ".1f"}
    text += markdown_table(shown, columns, dict.fromkeys(("requested", "gap_beside", "gap_in_line"), "m"))
    text += "\nWin rate: share of the pair that ends among the first two. Overtakes, contacts: per car and race; a "
    text += f"car has overtaken another when it is {_PASSED:g} m ahead; contacts within a second count once. "
    text += "Places later: gained after the first minute. "
    beside, in_line = MARGINS["lateral"][-1], MARGINS["longitudinal"][-1]
    text += f"Beside: share of the time with another car alongside, less than {beside:g} m away. "
    text += f"In line: share of the time with another car straight ahead or behind, less than {in_line:g} m away. "
    text += "Gap beside, in line: mean distance to the nearest car there, of those within 10 m. "
    text += "Stranded: how often a car had to be put back on the track. Brackets: 95 % intervals over races."
    text += "\n\nRank correlation with the margin: "
    parts = []
    for margin, setting in product(MARGINS, SETTINGS):
        ranks = ", ".join(f"{_RANKED[name]} {value:.2f}" for name, value in summary[margin][setting].items())
        parts.append(f"{margin}, {setting}: {ranks}")
    return text + "; ".join(parts) + ".\n"


def _with_interval(row: Mapping[str, Any], name: str, form: str) -> str:
    """Return a value of a row with its interval, such as "1.3 [1.1, 1.6]"."""
    value, low, high = (format(row[key], form) for key in (name, f"{name}_low", f"{name}_high"))
    return f"{value} [{low}, {high}]"
