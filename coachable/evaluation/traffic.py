"""Overtaking and defending among others, under rising weights: what the tyre and fuel family does in a race."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.envs.racing.measures import TelemetryMeasures
from coachable.envs.racing.scenarios import Conditions, Scenario
from coachable.envs.racing.styles import DEFEND, OVERTAKE
from coachable.evaluation.races import starting_slots
from coachable.evaluation.rollouts import record_episodes
from coachable.evaluation.settings import EvaluationSettings
from coachable.evaluation.statistics import bootstrap_interval, rank_correlation
from coachable.evaluation.style_grid import markdown_table
from coachable.keys import STYLE_FEATURES
from coachable.transforms import coachable_env

matplotlib.use("Agg")
from matplotlib import pyplot as plt

if TYPE_CHECKING:
    from coachable.domain import Domain
    from coachable.training.weights import LoadedPolicy

CARS = 3
SLOTS = {"overtake": CARS - 1, "defend": 0}  # where the car whose weight rises starts: last, or first
TRAFFIC_WEIGHTS = (0.0, 0.5, 1.0, 1.5, 2.0)
OTHERS_WEIGHT = 1.0  # of overtaking and of defending, of the other cars; and of the weight that does not rise
TRAFFIC_STEPS = 600  # 60 s
RACES = 32  # per weight, for each of `EvaluationSettings.episodes`
_START = (Scenario("passing", 1.0, "passing", CARS),)
_MEASURED = ("overtake", "defend", "places_gained", "contact", "off")


class _TrafficMeasures(TelemetryMeasures):
    """Also the metres gained on cars ahead, and gained or lost to cars behind."""

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        features = transition.get(("next", STYLE_FEATURES))
        return super().step(transition) | {"overtake": features[:, OVERTAKE], "defend": features[:, DEFEND]}


def race_in_traffic(domain: Domain, agent: LoadedPolicy, settings: EvaluationSettings) -> list[dict[str, Any]]:
    """Three copies of an agent, close together on a straight, on tyres and fuel of any state, for a minute.

    The weight of overtaking of the last car rises, or that of defending of the first; the races of all weights start
    alike.

    Args:
        domain: racing_resources, as the agent was trained in, among others.
        agent: the policy of all cars; acts deterministically.
        settings: `episodes` times 32 races per weight, of `steps`, by default 600.

    Returns:
        A row per weight: metres gained on cars ahead, and on cars behind (negative: lost), places gained, share of the
        time in contact and off the track, each with a 95 % interval.
    """
    races, steps = RACES * settings.episodes, min(settings.steps or TRAFFIC_STEPS, TRAFFIC_STEPS)
    cells = [(name, weight) for name in SLOTS for weight in TRAFFIC_WEIGHTS]
    count, space = len(cells) * races, agent.space
    simulation: Any = domain.make_env(
        num_envs=CARS * count,
        cars=CARS,
        opponents=True,
        scenarios=_START,
        conditions=Conditions.resources(),
        episode_steps=steps + 1,
        put_back=True,
        copies=len(cells),
    )
    env = coachable_env(simulation, space, domain.make_reward(space), seed=settings.seed)
    slots = starting_slots(env, simulation, settings.seed)
    theta = space.make(strict=True, overtake=OTHERS_WEIGHT, defend=OTHERS_WEIGHT).repeat(CARS, count, 1)
    chosen = torch.zeros(CARS, count, dtype=torch.bool)
    for index, (name, weight) in enumerate(cells):
        own = slice(index * races, (index + 1) * races)
        chosen[:, own] = slots[:, own] == SLOTS[name]
        column = theta[:, own, space.slices[name]]
        theta[:, own, space.slices[name]] = torch.where(chosen[:, own, None], weight, column)
    record = record_episodes(
        env,
        agent.actor,
        theta.reshape(CARS * count, -1),
        _TrafficMeasures("contact", "off", "place"),
        steps=steps,
        seed=settings.seed,
        progress=f"traffic: {count} races of {CARS} cars" if settings.progress else None,
    )
    env.close()
    shaped = {name: value.reshape(len(value), CARS, count).double() for name, value in record.measures.items()}
    found = {name: shaped[name].sum(0) for name in ("overtake", "defend")}
    found |= {name: shaped[name].mean(0) for name in ("contact", "off")}
    found["places_gained"] = slots + 1.0 - shaped["place"][-1]
    rows = []
    for index, (name, weight) in enumerate(cells):
        own = chosen[:, index * races : (index + 1) * races]
        row: dict[str, Any] = {"sweep": name, "weight": weight, "races": races}
        for measure in _MEASURED:
            values = found[measure][:, index * races : (index + 1) * races][own].numpy()
            low, high = bootstrap_interval(values)
            row |= {measure: float(values.mean()), f"{measure}_low": low, f"{measure}_high": high}
        rows.append(row)
    return rows


def traffic_response(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Rank correlation of each weight with the metres that it asks for, from the rows of `race_in_traffic`."""
    columns = {name: [(row["weight"], row[name]) for row in rows if row["sweep"] == name] for name in SLOTS}
    return {name: rank_correlation(*np.array(pairs).T) for name, pairs in columns.items()}


def traffic_report(rows: Sequence[dict[str, Any]], response: dict[str, float]) -> str:
    """The rows as Markdown."""
    text = f"\n## Among others\n\n{CARS} copies close together on a straight, on tyres and fuel of any state, for a "
    text += (
        f"minute; {rows[0]['races']} races per weight, the same starts for each. The weight of overtaking of the last "
    )
    text += f"car rises, or that of defending of the first; all others are {OTHERS_WEIGHT:g}, and nobody saves.\n\n"
    text += "![traffic](traffic.png)\n\n"
    formats = {"sweep": "", "weight": "g", "overtake": "+.1f", "defend": "+.1f", "places_gained": "+.2f"}
    text += markdown_table(rows, formats | {"contact": ".2%", "off": ".2%"})
    text += "\nOvertake, defend: metres gained on cars ahead and on cars behind. Rank correlation with the weight: "
    return text + ", ".join(f"{name} {value:.2f}" for name, value in response.items()) + ".\n"


def draw_traffic(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Metres gained over the weight that asks for them, with 95 % intervals."""
    figure, panels = plt.subplots(1, len(SLOTS), figsize=(9.5, 3.6), layout="constrained")
    titles = {"overtake": "on cars ahead, starting last", "defend": "on cars behind, starting first"}
    for axes, name in zip(panels, SLOTS, strict=True):
        own = [row for row in rows if row["sweep"] == name]
        weights = [row["weight"] for row in own]
        axes.plot(weights, [row[name] for row in own], marker="o")
        axes.fill_between(weights, [row[f"{name}_low"] for row in own], [row[f"{name}_high"] for row in own], alpha=0.2)
        axes.set(xlabel=f"weight of {name}", ylabel="metres gained in a minute", title=titles[name])
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    plt.close(figure)
