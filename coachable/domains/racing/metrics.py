"""Measures of the style in which a car was driven, for comparison with the requested one."""

import math
from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domains.racing.families import racing_family
from coachable.envs.racing.physics.simulation import CONTROL_STEP
from coachable.envs.racing.race.features import (
    CORNER_RADIUS,
    DEFEND,
    DRIFT,
    FUEL,
    NEAR_DISTANCE,
    OVERTAKE,
    TIRE,
    anyone_near,
    gap_columns,
)
from coachable.envs.racing.race.observation import own_columns
from coachable.envs.racing.race.referee import TELEMETRY
from coachable.keys import STYLE, STYLE_FEATURES

DRIFT_DEG = (15.0, 60.0)  # sideslip of a drift
DRIFT_SPEED = 8.0  # [m/s], smallest speed of a drift
GRIP_DEG = 8.0  # largest sideslip without a drift
_NEEDS = {
    "drift": "a step in a corner, or one without a request",
    "resources": "whole stints with and without saving, as `coachable evaluate` drives them",
    "aggressiveness": f"another car within {NEAR_DISTANCE:g} m",
}
"""Condition under which compliance can be judged, by family."""
_COLUMN = {name: index for index, name in enumerate(TELEMETRY)}


class RacingMeasures:
    """Measures of pace, driving and the quantities that the styles ask for.

    Args:
        family: Name of the family, which determines what compliance means: "drift", "resources" or "aggressiveness".

    Raises:
        ValueError: If there is no such family.
    """

    def __init__(self, family: str) -> None:
        racing_family(family)  # raises an error if there is none
        self.family = family
        self.needs = _NEEDS[family]

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """Return the measures of a step, with angles in degrees and gaps in metres; see `StyleMeasures.step`.

        "steering_change" is the change of the steering command in a control step, at most 2. It reveals agents that
        steer from lock to lock but drive well otherwise. For aggressiveness, "longitudinal" is the distance to the
        nearest car straight ahead or behind and "lateral" that to the nearest car beside; NaN if none is within 10 m.
        For resources, "overtake" and "defend" are the metres gained per second on cars ahead and on cars behind; NaN
        while no other car is near.
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
            found |= _drifting(told("sideslip") * degrees, told("speed"), told("curvature"), theta[:, 1] > 1.0)
        elif self.family == "resources":
            found["complied"] = torch.full_like(found["off"], torch.nan)
            near = anyone_near(features)
            for name, column in (("overtake", OVERTAKE), ("defend", DEFEND)):
                found[name] = torch.where(near, features[:, column] / CONTROL_STEP, torch.nan)
        else:
            found["longitudinal"], found["lateral"] = nearest_gaps(features)
            found["complied"] = torch.where(anyone_near(features), _margins_kept(features, theta).float(), torch.nan)
        return found

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        """Return means over the steps that count, with wear and fuel per kilometre; see `StyleMeasures.summarise`.

        For drift, "turns" is the largest rotation against the track in one direction, in whole turns, "turned_per_km"
        how often per kilometre the car turned to face backwards, and "backwards" the share of time that it faced so.
        For aggressiveness, "longitudinal_least" and "lateral_least" are the smallest gaps, which the margins are about.

        Args:
            record: Outputs of `step` (T, N), by name.
            alive: Steps that count (T, N) bool.

        Returns:
            Values (N,) by name; NaN where an episode has no value.
        """
        record = dict(record)
        heading = record.pop("heading", None)
        least = {
            f"{name}_least": _nearest(record[name].T, alive.T & ~record[name].T.isnan())
            for name in ("longitudinal", "lateral")
            if name in record
        }
        means = least | {name: torch.where(alive, values, torch.nan).nanmean(0) for name, values in record.items()}
        kilometres = (means["pace"] * CONTROL_STEP / 1000.0).clamp(min=1e-6)
        for name in ("wear", "fuel"):
            means[f"{name}_per_km"] = means.pop(name) / kilometres
        if heading is not None:
            means["turns"] = whole_turns(heading, alive)
            back = (heading.abs() > 0.5 * math.pi) & alive
            driven = means["pace"].abs() * alive.sum(0) * CONTROL_STEP / 1000.0
            means["turned_per_km"] = (back[1:] & ~back[:-1]).sum(0) / driven.clamp(min=0.1)
            means["backwards"] = back.sum(0) / alive.sum(0)
        return means

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return whether the car complies in each step, (T, N) bool; see `StyleMeasures.complies`.

        For drift, it drifts with 15 to 60 degrees of sideslip in corners if asked to and has 8 degrees or less if not.
        For aggressiveness, it keeps the margins to the cars nearby. For resources, no single step shows compliance.
        """
        return record["complied"] > 0

    def judged(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return whether compliance can be judged in each step, (T, N) bool.

        Requested drifts can be judged only in corners, margins only while another car is near, and savings only by
        comparison with a stint without them.
        """
        return ~torch.isnan(record["complied"])


class TelemetryMeasures:
    """Columns of the telemetry in each step, for evaluations that summarise whole races and stints themselves.

    Args:
        columns: Names in `TELEMETRY`.
    """

    def __init__(self, *columns: str) -> None:
        self._columns = {name: _COLUMN[name] for name in columns}

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """Return the columns (N,) of a step by name; see `StyleMeasures.step`."""
        told = transition.get(("next", "telemetry"))
        return {name: told[:, column] for name, column in self._columns.items()}


def whole_turns(heading: Tensor, alive: Tensor) -> Tensor:
    """Return the largest rotation in one direction in whole turns, (N,), from the headings in the steps that count.

    Args:
        heading: Headings (T, N) [rad].
        alive: Whether each step counts (T, N) bool.
    """
    steps = torch.diff(heading, dim=0)
    steps = torch.remainder(steps + math.pi, 2.0 * math.pi) - math.pi
    angle = torch.cat([torch.zeros_like(heading[:1]), torch.where(alive[1:], steps, 0.0).cumsum(0)])
    up = (angle - angle.cummin(0).values).amax(0)
    down = (angle.cummax(0).values - angle).amax(0)
    return torch.floor(torch.maximum(up, down) / (2.0 * math.pi))


def _drifting(sideslip: Tensor, speed: Tensor, curvature: Tensor, asked: Tensor) -> dict[str, Tensor]:
    """Return the measures of drifting in a step, (N,) each, with angles in degrees.

    "sideslip" and "drift" (share of drifts) come with a measure for corners and one for straights each, which is NaN
    elsewhere.

    Args:
        sideslip: Sideslip (N,) [deg].
        speed: Speed (N,) [m/s].
        curvature: Curvature of the track (N,) [1/m].
        asked: Whether a drift is requested (N,) bool.
    """
    angle, corner = sideslip.abs(), curvature.abs() * CORNER_RADIUS >= 1.0
    drifts = (angle >= DRIFT_DEG[0]) & (angle <= DRIFT_DEG[1]) & (speed > DRIFT_SPEED)
    kept = torch.where(asked, torch.where(corner, drifts.float(), torch.nan), (angle <= GRIP_DEG).float())
    found = {"complied": kept, "sideslip": angle, "drift": drifts.float()}
    for name in ("sideslip", "drift"):
        found[f"{name}_corners"] = torch.where(corner, found[name], torch.nan)
        found[f"{name}_straights"] = torch.where(corner, torch.nan, found[name])
    return found


def _margins_kept(features: Tensor, theta: Tensor) -> Tensor:
    """Return whether no opponent is within the longitudinal and the lateral margin at once, (N,) bool."""
    long, lat, near = gap_columns(features)
    ahead, aside = long < theta[:, :1], lat < theta[:, 1:2]
    # Cars that overlap in one direction are closer than any margin in it, also than one of 0.
    close = (ahead & (aside | (lat == 0.0))) | (aside & (long == 0.0))
    return ~((near > 0.0) & close).any(-1)


def nearest_gaps(features: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distances to the nearest car straight ahead or behind and to the nearest one beside, (N,) each [m]."""
    long, lat, near = gap_columns(features)
    return _nearest(long, (near > 0.0) & (lat == 0.0)), _nearest(lat, (near > 0.0) & (long == 0.0))


def _nearest(distances: Tensor, counts: Tensor) -> Tensor:
    """Return the smallest of the distances (N, A) that count, (N,), or NaN if none does."""
    found = torch.nn.functional.pad(torch.where(counts, distances, torch.inf), (0, 1), value=torch.inf).amin(-1)
    return torch.where(torch.isinf(found), torch.nan, found)
