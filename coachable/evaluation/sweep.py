"""Sweeps of one style weight from neutral to its maximum, for Pareto curves of style and task success."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Unpack

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domain import Domain, StyleMeasures
from coachable.evaluation.episode_records import RolloutOptions, record_styles
from coachable.keys import STYLE_FEATURES
from coachable.styles import StyleReward, Weight
from coachable.training.weights import LoadedPolicy

UNIT_REWARD = "unit_style_reward"
"""Reward per step of a weight's terms at weight 1, independent of the requested weight."""


@dataclass(frozen=True)
class WeightSweep:
    """Episodes at several values of one weight, with the other parameters at their defaults.

    Attributes:
        weight: Name of the weight.
        values: Requested values (P,).
        episodes: The domain's measures and `UNIT_REWARD` of each episode (P, episodes), by name.
    """

    weight: str
    values: np.ndarray
    episodes: dict[str, np.ndarray]

    @property
    def score(self) -> str:
        """Name of the metric for the amount of style: the measure named like the weight, or else `UNIT_REWARD`."""
        return self.weight if self.weight in self.episodes else UNIT_REWARD


def sweep_weights(
    domain: Domain, agent: LoadedPolicy, *, points: int = 5, episodes: int = 4, **options: Unpack[RolloutOptions]
) -> list[WeightSweep]:
    """Run `episodes` episodes at `points` values of every `Weight` of the space, all of them in one batch.

    Args:
        domain: Domain in which the agent acts.
        agent: The policy and its styles.
        points: Number of values from 0 to the upper end of the weight's evaluation range, or the lower end if the
            upper one is 0.
        episodes: Number of episodes per value.
        **options: See `RolloutOptions`.

    Returns:
        One sweep per weight; an empty list if there are no weights or fewer than 2 points.
    """
    space = agent.space
    weights = [p for p in space.parameters if isinstance(p, Weight)]
    if not weights or points < 2:
        return []
    ends = [weight.evaluation_range for weight in weights]
    requests = [np.linspace(0.0, high if high > 0 else low, points) for low, high in ends]
    rows = [(weight.name, value) for weight, values in zip(weights, requests, strict=True) for value in values]
    theta = space.make_all({name: value} for name, value in rows)
    theta = theta.repeat_interleave(episodes, 0)
    reward = domain.make_reward(space)
    unit = space.default.repeat(len(rows), 1)
    for row, (name, _) in enumerate(rows):
        unit[row, space.slices[name]] = 1.0
    measures = _WithUnitReward(domain.measures, reward, unit.repeat_interleave(episodes, 0))
    label = f"{len(weights)} weights x {points} values"
    record = record_styles(domain, agent.actor, space, theta, label, measures=measures, reward=reward, **options)
    values = {"survived": record.survived.float(), "task_return": record.task_return}
    values |= measures.summarise(record.measures, record.alive)
    shape = (len(weights), points, episodes)
    shaped = {name: value.reshape(shape).double().numpy() for name, value in values.items()}
    return [
        WeightSweep(weight.name, requests[i], {name: value[i] for name, value in shaped.items()})
        for i, weight in enumerate(weights)
    ]


class _WithUnitReward:
    """Measures of a domain, and `UNIT_REWARD`."""

    def __init__(self, measures: StyleMeasures, reward: StyleReward, unit: Tensor) -> None:
        self._measures = measures
        self._reward = reward
        self._unit = unit  # (N, d) the default style with the row's weight at 1
        self._neutral = reward.space.default.expand_as(unit)

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        features = transition.get(("next", STYLE_FEATURES))
        paid = self._reward(features, self._unit) - self._reward(features, self._neutral)
        return {**self._measures.step(transition), UNIT_REWARD: paid.squeeze(-1)}

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        own = {name: values for name, values in record.items() if name != UNIT_REWARD}
        paid = torch.where(alive, record[UNIT_REWARD], torch.nan).nanmean(0)
        return {**self._measures.summarise(own, alive), UNIT_REWARD: paid}
