"""Measured style of racing: what the car did, beside what was asked."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.envs.racing.families import check_family
from coachable.envs.racing.observation import own_columns
from coachable.envs.racing.referee import TELEMETRY
from coachable.envs.racing.simulation import CONTROL_STEP
from coachable.envs.racing.styles import FUEL, TIRE, gap_columns
from coachable.keys import STYLE, STYLE_FEATURES

DRIFT_ANGLE_DEG = 20.0  # that counts as a drift
GRIP_ANGLE_DEG = 8.0  # that counts as none
_COLUMN = {name: index for index, name in enumerate(TELEMETRY)}


class RacingMeasures:
    """Pace, road manners and the quantities that the styles ask for.

    Args:
        family: "drift", "resources" or "aggressiveness"; decides what compliance means.

    Raises:
        ValueError: if there is no such family.
    """

    def __init__(self, family: str) -> None:
        check_family(family)
        self.family = family

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """See `StyleMeasures.step`. Angles in degrees, wear and fuel per kilometre, gaps in metres.

        "steering_change" is that of the steering command in a control step, at most 2: agents that steer from lock to
        lock in every step may drive well otherwise.
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
            asked = theta[:, 1] > 1.0
            angle = found["slip_angle_rear"]
            found["complied"] = torch.where(asked, angle >= DRIFT_ANGLE_DEG, angle <= GRIP_ANGLE_DEG).float()
        elif self.family == "resources":
            found["complied"] = 1.0 - found["off"]
        else:
            found["complied"] = _margins_kept(features, theta).float()
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

        Drifting above 20 degrees where asked for and below 8 where not; on the track; margins kept.
        """
        return record["complied"] > 0


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
