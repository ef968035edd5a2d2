"""Evaluation of overtaking and defending in traffic under rising weights, for the tyre and fuel family."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domain import Domain
from coachable.domains.racing.metrics import TelemetryMeasures
from coachable.domains.racing.races import race_alike
from coachable.envs.racing.race.features import DEFEND, OVERTAKE
from coachable.envs.racing.race.scenarios import Conditions, Scenario
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.figures import drawing, shade
from coachable.evaluation.statistics import bootstrap_interval, rank_correlation
from coachable.evaluation.style_grid import markdown_table, rows_where
from coachable.keys import STYLE_FEATURES
from coachable.training.weights import LoadedPolicy

CARS = 3
SLOTS = {"overtake": CARS - 1, "defend": 0}  # slot of the car whose weight rises: last, or first
TRAFFIC_WEIGHTS = (0.0, 0.5, 1.0, 1.5, 2.0)
OTHERS_WEIGHT = 1.0  # of all weights of overtaking and defending that do not rise
TRAFFIC_STEPS = 600  # 60 s
RACES = 128  # per weight, for each of `EvaluationSettings.episodes`; four leave intervals of 1 to 2 m
TRAFFIC_STARTS = ("passing", "slipstream", "rolling")  # kinds of starts, see `Scenario`
SAVERS = ("nobody", "all")  # cars that save tyres and fuel, with the largest weights


class _TrafficMeasures(TelemetryMeasures):
    """Telemetry, and the metres gained on cars ahead and on cars behind."""

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        features = transition.get(("next", STYLE_FEATURES))
        return super().step(transition) | {"overtake": features[:, OVERTAKE], "defend": features[:, DEFEND]}


def race_in_traffic(domain: Domain, agent: LoadedPolicy, settings: EvaluationSettings) -> list[dict[str, Any]]:
    """Race three copies of an agent that start close together, with random tyres and fuel, for a minute.

    The last car's weight of overtaking rises, or the first car's weight of defending. There are three kinds of starts,
    each in races in which nobody saves tyres and fuel and in others in which all cars do. The races of all weights
    have equal starts.

    Args:
        domain: Domain racing_resources, as the agent was trained in, with several cars.
        agent: Policy of all cars, which acts deterministically.
        settings: `episodes` times 128 is the number of races per weight, start and group of savers; `steps` is their
            length, 600 at most and by default.

    Returns:
        A row per start, savers and weight with the metres gained on cars ahead and on cars behind (negative if lost),
        the places gained, and the shares of time in contact and off the track, each with a 95 % interval.
    """
    return [
        row
        for start in TRAFFIC_STARTS
        for savers in SAVERS
        for row in _race_from(domain, agent, settings, start, savers)
    ]


def _race_from(
    domain: Domain, agent: LoadedPolicy, settings: EvaluationSettings, start: str, savers: str
) -> list[dict[str, Any]]:
    races, steps = RACES * settings.episodes, min(settings.steps or TRAFFIC_STEPS, TRAFFIC_STEPS)
    cells = [(name, weight) for name in SLOTS for weight in TRAFFIC_WEIGHTS]
    space = agent.space
    asked = dict.fromkeys(SLOTS, OTHERS_WEIGHT)
    if savers == "all":
        asked |= {name: float(space.high[space.slices[name]]) for name in ("tire", "fuel")}
    theta = space.make(strict=True, **asked).repeat(CARS, len(cells) * races, 1)
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
        scenarios=(Scenario(start, 1.0, start, CARS),),
        conditions=Conditions.resources(),
    )
    values = {name: value.double() for name, value in measured.items()}
    found = {name: values[name].sum(0) for name in ("overtake", "defend")}
    found["places_gained"] = torch.arange(1.0, CARS + 1.0)[:, None] - values["place"][-1]
    found |= {name: values[name].mean(0) for name in ("contact", "off")}
    rows = []
    for index, (name, weight) in enumerate(cells):
        row: dict[str, Any] = {"sweep": name, "start": start, "savers": savers, "weight": weight, "races": races}
        for measure, by_slot in found.items():
            own = by_slot[SLOTS[name], index * races : (index + 1) * races].numpy()
            low, high = bootstrap_interval(own)
            row |= {measure: float(own.mean()), f"{measure}_low": low, f"{measure}_high": high}
        rows.append(row)
    return rows


def traffic_response(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return how metres and places gained in `race_in_traffic` follow the weight that asks for them.

    Returns:
        A row per weight that rises, start and group of savers: metres gained on cars ahead (overtake) or behind
        (defend) at the smallest and at the largest weight, whether their 95 % intervals are apart, the rank
        correlations of the weight with these metres and with the places gained, and the time in contact at the largest
        weight over that at the smallest (NaN if that is 0).
    """
    response = []
    for sweep in SLOTS:
        for start, savers in dict.fromkeys((row["start"], row["savers"]) for row in rows):
            own = rows_where(rows, sweep=sweep, start=start, savers=savers)
            first, last = own[0], own[-1]
            weights = np.array([row["weight"] for row in own])
            follows = {
                name: rank_correlation(weights, np.array([row[measure] for row in own]))
                for name, measure in (("metres", sweep), ("places", "places_gained"))
            }
            response.append(
                {"sweep": sweep, "start": start, "savers": savers, "smallest": first[sweep], "largest": last[sweep]}
                | {"apart": "yes" if last[f"{sweep}_low"] > first[f"{sweep}_high"] else "no", **follows}
                | {"contacts": last["contact"] / first["contact"] if first["contact"] else float("nan")}
            )
    return response


def traffic_report(rows: Sequence[dict[str, Any]], response: Sequence[dict[str, Any]]) -> str:
    """Return the section on traffic of the report as Markdown, from `race_in_traffic` and `traffic_response`."""
    text = f"\n## Among others\n\n{CARS} copies, on tyres and fuel of any state, for a minute; "
    text += f"{rows[0]['races']} races per weight, the same starts for each. The weight of overtaking of the last car "
    text += f"rises, or that of defending of the first; all others are {OTHERS_WEIGHT:g}. Starts: close together on a "
    text += (
        "straight with some cars faster (passing), in a line there (slipstream), or rolling up to the line. Savers: "
    )
    text += "cars that save tyres and fuel as much as they can.\n\n![traffic](traffic.png)\n\n"
    formats = {"sweep": "", "start": "", "savers": "", "smallest": "+.1f", "largest": "+.1f", "apart": ""}
    formats |= {"metres": ".2f", "places": ".2f", "contacts": ".2f"}
    text += markdown_table(response, formats, {"smallest": "m", "largest": "m"})
    text += "\nSmallest, largest: metres gained on cars ahead (overtake) or behind (defend) at that weight; "
    text += "apart: whether their 95 % intervals are. Metres, places: rank correlation of "
    text += "the weight with them. Contacts: time in contact at the largest weight over that at the smallest.\n\n"
    formats = {"sweep": "", "start": "", "savers": "", "weight": "g", "overtake": "+.1f", "defend": "+.1f"}
    formats |= {"places_gained": "+.2f", "contact": ".2%", "off": ".2%"}
    return text + markdown_table(rows, formats, {"overtake": "m", "defend": "m"})


def draw_traffic(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw the metres and places gained in `race_in_traffic` over the weight asking for them, with 95 % intervals."""
    titles = {"overtake": "on cars ahead, starting last", "defend": "on cars behind, starting first"}
    kinds = list(dict.fromkeys((row["start"], row["savers"]) for row in rows))
    with drawing(path, 2, len(SLOTS), size=(9.5, 6.4), sharex=True) as panels:
        for column, name in zip(panels.T, SLOTS, strict=True):
            for start, savers in kinds:
                own = rows_where(rows, sweep=name, start=start, savers=savers)
                weights = [row["weight"] for row in own]
                color = shade(TRAFFIC_STARTS.index(start), len(TRAFFIC_STARTS))
                style = {"color": color, "ls": "--" if savers == "all" else "-"}
                for axes, measure in zip(column, (name, "places_gained"), strict=True):
                    low, high = ([row[f"{measure}_{end}"] for row in own] for end in ("low", "high"))
                    label = f"{start}, {savers} saving"
                    axes.plot(weights, [row[measure] for row in own], marker="o", ms=3, label=label, **style)
                    axes.fill_between(weights, low, high, alpha=0.15, color=color)
            for axes, unit in zip(column, ("metres", "places"), strict=True):
                axes.set(ylabel=f"{unit} gained in a minute")
            column[0].set(title=titles[name])
            column[1].set(xlabel=f"weight of {name}")
        panels[0, 0].legend(fontsize=8)
