"""Poses of a car's body and wheels, skid marks, the camera's direction and gauge values.

These functions do not branch on values, so that they are exported for the page in the browser as they are.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from coachable.domains.racing.car_scene import kind_of, wheel_places, wheel_slip
from coachable.envs.racing.physics.simulation import CONTROL_STEP
from coachable.envs.racing.physics.state import ROW, SPINS, WEARS
from coachable.scene import palette
from coachable.scene.gauge_form import GaugeForm

SLIDING = 1.3  # slip from which a wheel leaves a mark; 1 is that of the largest force
_FARTHEST = 12.0  # [m], between two states of a wheel that a mark joins
_NEAREST = 0.05  # [m]
_SLOW = 3.0  # [m/s], below which a car counts as driving straight
_LAG = 0.35  # share by which the camera turns towards the car's direction in a control step
_WORN = 0.75  # wear beyond which the grip falls faster
_TURN = 2 * math.pi
_STEERED = (0.0, 1.0, 1.0, 0.0, 0.0)  # the body, then the wheels in the order of `CarState`

VALUES = (
    *("speed", "gear", "throttle", "brake", "angle", "sliding", "fuel"),
    *("wear_fl", "wear_fr", "wear_rl", "wear_rr", "worn", "worn_out"),
)
"""Numbers that the gauges show: speed [km/h], angle [deg], fuel [l], wear [%]; the others are shares or flags."""

GAUGES = (
    GaugeForm("speed", "{speed:.0f} km/h, gear {gear:.0f}", "speed", 300.0, palette.BLUE),
    GaugeForm("throttle", "{throttle:.0f} %", "throttle", 100.0, palette.GREEN),
    GaugeForm("brake", "{brake:.0f} %", "brake", 100.0, palette.PURPLE),
    GaugeForm("slip angle", "{angle:.0f}°", "angle", 20.0, palette.BLUE, "sliding", ", sliding", palette.VERMILION),
    GaugeForm("fuel", "{fuel:.1f} l", "fuel", 100.0, palette.ORANGE),
    GaugeForm(
        "tyres worn",
        "{wear_fl:.0f} {wear_fr:.0f} {wear_rl:.0f} {wear_rr:.0f} %",
        "worn",
        1.0,
        palette.SKY,
        "worn_out",
        "",
        palette.VERMILION,
    ),
)


class CarSize(NamedTuple):
    """What the picture of a car depends on.

    Attributes:
        places: Places of the body's middle and of the wheels relative to the point of the road below the centre of
            gravity, (5, 3) [m].
        length: Length [m].
        width: Width [m].
        radius: Radius of the wheels [m].
        kind: Shape, as from `kind_of`.
        peak_ratio: Slip ratio of the largest force.
        peak_angle: Slip angle of the largest force [rad].
    """

    places: np.ndarray
    length: float
    width: float
    radius: float
    kind: str
    peak_ratio: float
    peak_angle: float

    @classmethod
    def of(cls, car: Any, column: int = 0) -> CarSize:
        """Return the size of a car.

        Args:
            car: Parameters of one car, or of several (`coachable.envs.racing.physics.cars.Car`).
            column: Which car.
        """

        def number(name: str) -> float:
            value = getattr(car, name)
            return round(float(value[column]) if hasattr(value, "shape") else float(value), 4)

        front, rear = number("front_axle"), number("rear_axle")
        radius = number("wheel_radius")
        wheels = np.insert(wheel_places(front, rear, number("track_front"), number("track_rear")), 2, radius, axis=1)
        places = np.concatenate([[((front - rear) / 2, 0.0, 0.0)], wheels]).astype(np.float32)
        return cls(
            places,
            number("length"),
            number("width"),
            radius,
            kind_of(number("lift_area")),
            number("peak_slip_ratio"),
            number("peak_slip_angle"),
        )

    def slip(self, state: np.ndarray) -> np.ndarray:
        """Return the slip of the wheels (4,) in a state (29,), as `wheel_slip`."""
        return wheel_slip(state, self.places[1:, :2], self.radius, self.peak_ratio, self.peak_angle)


def rolled_further(state: np.ndarray, rolled: np.ndarray) -> np.ndarray:
    """Return the angles of the wheels (4,) after a control step at the present speed, in [0, 2π) [rad].

    Args:
        state: State (29,) of the car.
        rolled: Angles of the wheels before (4,) [rad].
    """
    angle = rolled + state[SPINS] * CONTROL_STEP
    return angle - _TURN * np.floor(angle / _TURN)


def car_poses(state: np.ndarray, rolled: np.ndarray, size: CarSize) -> np.ndarray:
    """Return place [m] and rotation as a unit quaternion of the body and of the wheels, (5, 7).

    Args:
        state: State (29,) of the car.
        rolled: Angles by which the wheels have rolled forward (4,) [rad].
        size: Size of the car.
    """
    ahead, aside, height = size.places[:, 0], size.places[:, 1], size.places[:, 2]
    yaw = state[ROW["yaw"]]
    cos, sin = np.cos(yaw), np.sin(yaw)
    x = state[ROW["x"]] + cos * ahead - sin * aside
    y = state[ROW["y"]] + sin * ahead + cos * aside
    half = 0.5 * (yaw + state[ROW["steer"]] * np.array(_STEERED, np.float32))
    spin = 0.5 * np.concatenate([np.zeros(1, np.float32), rolled])
    upright, across = np.cos(half), np.sin(half)
    turn = (upright * np.cos(spin), -across * np.sin(spin), upright * np.sin(spin), across * np.cos(spin))
    return np.stack([x, y, height, *turn], axis=1)


def skid_marks(before: np.ndarray, slipped: np.ndarray, places: np.ndarray, slip: np.ndarray) -> np.ndarray:
    """Return the marks of wheels that slid in the last state and still do.

    Args:
        before: Places of the wheels in the last state (4, 2) [m].
        slipped: Slip of the wheels in the last state (4,).
        places: Places of the wheels (4, 2) [m].
        slip: Slip of the wheels (4,).

    Returns:
        x and y of the middle [m], length [m] and direction [rad], (4, 4); NaN for wheels without a mark.
    """
    way = places - before
    length = np.sqrt(way[:, 0] * way[:, 0] + way[:, 1] * way[:, 1])
    slides = (slip > SLIDING) & (slipped > SLIDING) & (length > _NEAREST) & (length < _FARTHEST)
    middle = 0.5 * (before + places)
    mark = np.stack([middle[:, 0], middle[:, 1], length, np.arctan2(way[:, 1], way[:, 0])], axis=1)
    return np.where(slides[:, None], mark, np.full_like(mark, np.nan))


def travel_angle(state: np.ndarray) -> np.ndarray:
    """Return the angle () from a car's direction to that of its velocity, 0 at a walking pace [rad]."""
    vx, vy = state[ROW["vx"]], state[ROW["vy"]]
    return np.where(vx * vx + vy * vy > _SLOW * _SLOW, np.arctan2(vy, vx), np.zeros_like(vx))


def aimed(state: np.ndarray) -> np.ndarray:
    """Return the direction () in which the camera looks after a car, counter-clockwise from +x [rad]."""
    return state[ROW["yaw"]] + 0.5 * travel_angle(state)


def turned_camera(before: np.ndarray, aim: np.ndarray) -> np.ndarray:
    """Turn the camera towards a direction with a lag, so that a spinning car does not whirl the world.

    Args:
        before: Direction of the camera () [rad].
        aim: Direction to turn to () [rad].

    Returns:
        The new direction () [rad].
    """
    apart = aim - before
    return before + _LAG * (apart - _TURN * np.round(apart / _TURN))


def gauge_values(state: np.ndarray, slip: np.ndarray) -> np.ndarray:
    """Return the numbers that the gauges show, in the order of `VALUES`.

    Args:
        state: State (29,) of the car.
        slip: Slip of its wheels (4,).
    """
    vx, vy, wear = state[ROW["vx"]], state[ROW["vy"]], state[WEARS]
    worn = np.max(wear, axis=0)
    return np.stack(
        [
            3.6 * np.sqrt(vx * vx + vy * vy),
            state[ROW["gear"]],
            100.0 * state[ROW["throttle"]],
            100.0 * state[ROW["brake"]],
            np.abs(travel_angle(state)) * (180.0 / math.pi),
            (np.max(slip, axis=0) > SLIDING).astype(np.float32),
            state[ROW["fuel"]],
            *(100.0 * wear[wheel] for wheel in range(4)),
            worn,
            (worn > _WORN).astype(np.float32),
        ]
    )
