"""Evaluation of overtaking and defending in traffic under rising weights, for the tyre and fuel family."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domains.racing.metrics import TelemetryMeasures
from coachable.domains.racing.races import race_alike
from coachable.envs.racing.race.features import DEFEND, OVERTAKE
from coachable.envs.racing.race.scenarios import Conditions, Scenario
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.figures import drawing
from coachable.evaluation.statistics import bootstrap_interval, rank_correlation
from coachable.evaluation.style_grid import markdown_table
from coachable.keys import STYLE_FEATURES

if TYPE_CHECKING:
    from coachable.domain import Domain
    from coachable.training.weights import LoadedPolicy

CARS = 3
SLOTS = {"overtake": CARS - 1, "defend": 0}  # slot of the car whose weight rises: last, or first
TRAFFIC_WEIGHTS = (0.0, 0.5, 1.0, 1.5, 2.0)
OTHERS_WEIGHT = 1.0  # of all weights of overtaking and defending that do not rise
TRAFFIC_STEPS = 600  # 60 s
RACES = 128  # per weight, for each of `EvaluationSettings.episodes`; four leave intervals of 1 to 2 m
_START = (Scenario("passing", 1.0, "passing", CARS),)


class _TrafficMeasures(TelemetryMeasures):
    """Telemetry, and the metres gained on cars ahead and on cars behind."""

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        features = transition.get(("next", STYLE_FEATURES))
        return super().step(transition) | {"overtake": features[:, OVERTAKE], "defend": features[:, DEFEND]}


def race_in_traffic(domain: Domain, agent: LoadedPolicy, settings: EvaluationSettings) -> list[dict[str, Any]]:
    """Race three copies of an agent that start close together on a straight, with random tyres and fuel, for a minute.

    The last car's weight of overtaking rises, or the first car's weight of defending. The races of all weights have
    equal starts.

    Args:
        domain: Domain racing_resources, as the agent was trained in, with several cars.
        agent: Policy of all cars, which acts deterministically.
        settings: `episodes` times 128 is the number of races per weight; `steps` is their length, 600 at most and by
            default.

    Returns:
        A row per weight with the metres gained on cars ahead and on cars behind (negative if lost), the places gained,
        and the shares of time in contact and off the track, each with a 95 % interval.
    """
    races, steps = RACES * settings.episodes, min(settings.steps or TRAFFIC_STEPS, TRAFFIC_STEPS)
    cells = [(name, weight) for name in SLOTS for weight in TRAFFIC_WEIGHTS]
    space = agent.space
    theta = space.make(strict=True, overtake=OTHERS_WEIGHT, defend=OTHERS_WEIGHT).repeat(CARS, len(cells) * races, 1)
    for index, (name, weight) in enumerate(cells):
        theta[SLOTS[name], index * races : (index + 1) * races, space.slices[name]] = weight
    measured, _ = race_alike(
        domain,
        agent,
        theta,
        _TrafficMeasures("contact", "off", "place"),
        settings,
        copies=len(cells),
        steps=steps,
        scenarios=_START,
        conditions=Conditions.resources(),
    )
    values = {name: value.double() for name, value in measured.items()}
    found = {name: values[name].sum(0) for name in ("overtake", "defend")}
    found["places_gained"] = torch.arange(1.0, CARS + 1.0)[:, None] - values["place"][-1]
    found |= {name: values[name].mean(0) for name in ("contact", "off")}
    rows = []
    for index, (name, weight) in enumerate(cells):
        row: dict[str, Any] = {"sweep": name, "weight": weight, "races": races}
        for measure, by_slot in found.items():
            own = by_slot[SLOTS[name], index * races : (index + 1) * races].numpy()
            low, high = bootstrap_interval(own)
            row |= {measure: float(own.mean()), f"{measure}_low": low, f"{measure}_high": high}
        rows.append(row)
    return rows


def traffic_response(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return the rank correlations of each weight with the metres and places gained.

    Args:
        rows: Rows of `race_in_traffic`.

    Returns:
        Correlations "metres" and "places" in [-1, 1], by weight.
    """

    def follows(sweep: str, measure: str) -> float:
        pairs = [(row["weight"], row[measure]) for row in rows if row["sweep"] == sweep]
        return rank_correlation(*np.array(pairs).T)

    return {name: {"metres": follows(name, name), "places": follows(name, "places_gained")} for name in SLOTS}


def traffic_report(rows: Sequence[dict[str, Any]], response: dict[str, dict[str, float]]) -> str:
    """Return the section on traffic of the report, as Markdown.

    Args:
        rows: Result of `race_in_traffic`.
        response: Result of `traffic_response`.
    """
    text = f"\n## Among others\n\n{CARS} copies close together on a straight, on tyres and fuel of any state, for a "
    text += f"minute; {rows[0]['races']} races per weight, the same starts for each. The weight of overtaking of the "
    text += (
        f"last car rises, or that of defending of the first; all others are {OTHERS_WEIGHT:g}, and no car saves.\n\n"
    )
    text += "![traffic](traffic.png)\n\n"
    formats = {"sweep": "", "weight": "g", "overtake": "+.1f", "defend": "+.1f", "places_gained": "+.2f"}
    text += markdown_table(rows, formats | {"contact": ".2%", "off": ".2%"}, {"overtake": "m", "defend": "m"})
    text += "\nOvertake, defend: metres gained on cars ahead and on cars behind. Rank correlation with the weight of "
    found = [f"{name} {v['metres']:.2f} in metres, {v['places']:.2f} in places" for name, v in response.items()]
    return text + "; of ".join(found) + ".\n"


def draw_traffic(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw the metres and places gained over the weight that asks for them, with 95 % intervals.

    Args:
        rows: One row per weight, with metres and places and the ends of their 95 % intervals.
        path: Image file to write.
    """
    titles = {"overtake": "on cars ahead, starting last", "defend": "on cars behind, starting first"}
    with drawing(path, 2, len(SLOTS), size=(9.5, 6.4), sharex=True) as panels:
        for column, name in zip(panels.T, SLOTS, strict=True):
            own = [row for row in rows if row["sweep"] == name]
            weights = [row["weight"] for row in own]
            for axes, measure, unit in zip(column, (name, "places_gained"), ("metres", "places"), strict=True):
                low, high = ([row[f"{measure}_{end}"] for row in own] for end in ("low", "high"))
                axes.plot(weights, [row[measure] for row in own], marker="o")
                axes.fill_between(weights, low, high, alpha=0.2)
                axes.set(ylabel=f"{unit} gained in a minute")
            column[0].set(title=titles[name])
            column[1].set(xlabel=f"weight of {name}")
