"""Measured style of racing: what the car did, beside what was asked."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domains.racing.families import racing_family
from coachable.envs.racing.physics.simulation import CONTROL_STEP
from coachable.envs.racing.race.features import DRIFT, FUEL, NEAR_DISTANCE, TIRE, anyone_near, gap_columns
from coachable.envs.racing.race.observation import own_columns
from coachable.envs.racing.race.referee import TELEMETRY
from coachable.keys import STYLE, STYLE_FEATURES

DRIFT_ANGLE_DEG = 20.0  # that counts as a drift
GRIP_ANGLE_DEG = 8.0  # that counts as none
_NEEDS = {
    "drift": "a step",
    "resources": "whole stints with and without saving, as `coachable evaluate` drives them",
    "aggressiveness": f"another car within {NEAR_DISTANCE:g} m",
}
"""What it takes to tell whether a car complies, by family."""
_COLUMN = {name: index for index, name in enumerate(TELEMETRY)}


class RacingMeasures:
    """Pace, road manners and the quantities that the styles ask for.

    Args:
        family: "drift", "resources" or "aggressiveness"; decides what compliance means.

    Raises:
        ValueError: if there is no such family.
    """

    def __init__(self, family: str) -> None:
        racing_family(family)  # raises if there is none
        self.family = family
        self.needs = _NEEDS[family]

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """See `StyleMeasures.step`. Angles in degrees, wear and fuel per kilometre, gaps in metres.

        "steering_change" is that of the steering command in a control step, at most 2: agents that steer from lock to
        lock in every step may drive well otherwise. For aggressiveness "longitudinal" is the distance to the nearest
        car straight ahead or behind, "lateral" that to the nearest one beside; NaN where there is none within 10 m.
        """
        theta, features = transition.get(STYLE), transition.get(("next", STYLE_FEATURES))
        telemetry = transition.get(("next", "telemetry"))

        def told(name: str) -> Tensor:
            return telemetry[:, _COLUMN[name]]

        degrees = 180.0 / math.pi
        *_, steer, _, steer_before, _ = transition.get(("next", "observation"))[:, own_columns("controls")].unbind(-1)
        found = {
            "pace": told("progress") / CONTROL_STEP,
            "speed": told("speed"),
            "steering_change": (steer - steer_before).abs(),
            "off": told("off"),
            "contact": told("contact"),
            "wall": told("wall"),
            "slip_angle_front": features[:, 0] * degrees,
            "slip_angle_rear": features[:, 1] * degrees,
            "wear": -features[:, TIRE],
            "fuel": -features[:, FUEL],
            "place": told("place"),
        }
        if self.family == "drift":
            found["heading"] = told("heading")
            found["slip_ratio_front"], found["slip_ratio_rear"] = features[:, DRIFT].unbind(-1)[2:]
            asked = theta[:, 1] > 1.0
            angle = found["slip_angle_rear"]
            found["complied"] = torch.where(asked, angle >= DRIFT_ANGLE_DEG, angle <= GRIP_ANGLE_DEG).float()
        elif self.family == "resources":
            found["complied"] = 1.0 - found["off"]
        else:
            found["longitudinal"], found["lateral"] = _distances(features)
            found["complied"] = torch.where(anyone_near(features), _margins_kept(features, theta).float(), torch.nan)
        return found

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        """See `StyleMeasures.summarise`: means over the steps that count; wear and fuel per kilometre of progress.

        For drift also "turns", the largest rotation against the track in one direction, in whole turns.
        """
        record = dict(record)
        heading = record.pop("heading", None)
        means = {name: torch.where(alive, values, torch.nan).nanmean(0) for name, values in record.items()}
        kilometres = (means["pace"] * CONTROL_STEP / 1000.0).clamp(min=1e-6)
        for name in ("wear", "fuel"):
            means[f"{name}_per_km"] = means.pop(name) / kilometres
        if heading is not None:
            means["turns"] = whole_turns(heading, alive)
        return means

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """See `StyleMeasures.complies`.

        Drifting above 20 degrees where asked for and below 8 where not; on the track; margins to a car nearby kept.
        """
        return record["complied"] > 0

    def judged(self, record: Mapping[str, Tensor]) -> Tensor:
        """(T, N) bool: in this step one can tell whether the car complies.

        Margins are kept or not only while another car is near. Savings show only beside a stint that does not save.
        """
        return ~torch.isnan(record["complied"]) & (self.family != "resources")


class TelemetryMeasures:
    """Columns of the telemetry, step by step, for evaluations that judge whole races and stints themselves.

    Args:
        columns: names of `TELEMETRY`.
    """

    def __init__(self, *columns: str) -> None:
        self._columns = {name: _COLUMN[name] for name in columns}

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """See `StyleMeasures.step`."""
        told = transition.get(("next", "telemetry"))
        return {name: told[:, column] for name, column in self._columns.items()}

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        """Nothing: that is the evaluation's business."""
        return {}

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """See `StyleMeasures.complies`: on the track."""
        return record["off"] == 0.0


def whole_turns(heading: Tensor, alive: Tensor) -> Tensor:
    """Largest rotation in one direction, in whole turns, (N,), of a heading (T, N) [rad] in the steps that count."""
    steps = torch.diff(heading, dim=0)
    steps = torch.remainder(steps + math.pi, 2.0 * math.pi) - math.pi
    angle = torch.cat([torch.zeros_like(heading[:1]), torch.where(alive[1:], steps, 0.0).cumsum(0)])
    up = (angle - angle.cummin(0).values).amax(0)
    down = (angle.cummax(0).values - angle).amax(0)
    return torch.floor(torch.maximum(up, down) / (2.0 * math.pi))


def _margins_kept(features: Tensor, theta: Tensor) -> Tensor:
    """(N,) bool: no near opponent within the longitudinal and the lateral margin at once."""
    long, lat, near = gap_columns(features)
    return ~((near > 0.0) & (long < theta[:, :1]) & (lat < theta[:, 1:2])).any(-1)


def _distances(features: Tensor) -> tuple[Tensor, Tensor]:
    """Distances to the nearest car straight ahead or behind and to the nearest one beside, (N,) each [m]."""
    long, lat, near = gap_columns(features)
    return _nearest(long, (near > 0.0) & (lat == 0.0)), _nearest(lat, (near > 0.0) & (long == 0.0))


def _nearest(distances: Tensor, counts: Tensor) -> Tensor:
    """Smallest of the distances (N, A) that count, (N,); NaN where none does."""
    found = torch.nn.functional.pad(torch.where(counts, distances, torch.inf), (0, 1), value=torch.inf).amin(-1)
    return torch.where(torch.isinf(found), torch.nan, found)
