"""Shapes of racing cars, and how much their wheels slip."""

import math
from functools import cache

import numpy as np

from coachable.envs.racing.physics.state import ROW, SPINS
from coachable.envs.racing.physics.tyres import SLIP_SPEED
from coachable.scene import palette
from coachable.scene.palette import Colour
from coachable.scene.parts import Parts, about_x, about_y

OPEN_WHEEL, GRAND_TOURER, STREET = "open-wheel", "grand tourer", "street"
_WINGS = 3.0  # [m²], of downforce area, from which a car is an open-wheel car
_NO_WINGS = 0.6  # [m²], below which it has no wing
_GLASS, _RUBBER, _RIM = (44, 52, 62), (38, 39, 42), (150, 154, 160)


def kind_of(lift_area: float) -> str:
    """Return which shape a car with a downforce area [m²] has."""
    if lift_area >= _WINGS:
        return OPEN_WHEEL
    return GRAND_TOURER if lift_area >= _NO_WINGS else STREET


@cache
def body(kind: str, length: float, width: float, colour: Colour) -> Parts:
    """Return the body of a car without its wheels, with its middle at x = y = 0 and the road at z = 0.

    Args:
        kind: Shape, as from `kind_of`.
        length: Length [m].
        width: Width [m].
        colour: Colour of the paint.
    """
    paint, dark = colour, palette.mixed(colour, (0, 0, 0), 0.35)
    parts = Parts()
    if kind == OPEN_WHEEL:
        parts.box((0.0, 0.0, 0.10), (0.78 * length, 0.62 * width, 0.06), palette.SLATE)  # floor
        parts.box((-0.08 * length, 0.0, 0.38), (0.62 * length, 0.30 * width, 0.42), paint)
        parts.box((0.33 * length, 0.0, 0.34), (0.30 * length, 0.15 * width, 0.20), paint, about_y(0.10))  # nose
        for side in (-1, 1):
            parts.box((-0.08 * length, side * 0.26 * width, 0.32), (0.34 * length, 0.16 * width, 0.34), dark)
        parts.box((0.46 * length, 0.0, 0.16), (0.09 * length, 0.95 * width, 0.04), paint)  # front wing
        parts.box((-0.46 * length, 0.0, 0.86), (0.08 * length, 0.62 * width, 0.05), paint)  # rear wing
        for side in (-1, 1):
            parts.box((0.45 * length, side * 0.47 * width, 0.24), (0.12 * length, 0.03, 0.22), dark)
            parts.box((-0.46 * length, side * 0.31 * width, 0.66), (0.10 * length, 0.03, 0.46), dark)
        parts.box((-0.14 * length, 0.0, 0.70), (0.16 * length, 0.14 * width, 0.28), dark)  # air intake
        parts.ball((0.06 * length, 0.0, 0.68), (0.30, 0.26, 0.30), palette.YELLOW)  # helmet
        return parts
    parts.box((0.0, 0.0, 0.42), (0.94 * length, 0.82 * width, 0.40), paint)
    parts.box((0.44 * length, 0.0, 0.34), (0.12 * length, 0.80 * width, 0.24), paint)
    parts.box((0.30 * length, 0.0, 0.64), (0.30 * length, 0.80 * width, 0.12), paint, about_y(0.10))  # bonnet
    parts.box((-0.06 * length, 0.0, 0.78), (0.46 * length, 0.76 * width, 0.34), _GLASS)
    parts.box((-0.09 * length, 0.0, 0.98), (0.32 * length, 0.70 * width, 0.10), paint)  # roof
    parts.box((0.14 * length, 0.0, 0.83), (0.22 * length, 0.72 * width, 0.05), _GLASS, about_y(0.50))  # windscreen
    parts.box((0.0, 0.0, 0.63), (0.90 * length, 0.10 * width, 0.03), dark)  # stripe
    for side in (-1, 1):
        parts.box((0.495 * length, side * 0.33 * width, 0.50), (0.03, 0.18 * width, 0.10), palette.WHITE)
        parts.box((-0.475 * length, side * 0.33 * width, 0.54), (0.03, 0.20 * width, 0.10), palette.VERMILION)
    if kind == GRAND_TOURER:
        parts.box((0.48 * length, 0.0, 0.16), (0.08 * length, 0.98 * width, 0.04), palette.INK)  # splitter
        parts.box((-0.46 * length, 0.0, 1.16), (0.09 * length, 0.96 * width, 0.05), palette.INK)  # wing
        for side in (-1, 1):
            parts.box((-0.45 * length, side * 0.28 * width, 0.90), (0.05, 0.04, 0.50), palette.INK)
            parts.box((-0.46 * length, side * 0.48 * width, 1.14), (0.11 * length, 0.03, 0.22), paint)
    return parts


@cache
def wheel(radius: float) -> Parts:
    """Return a wheel around the origin, whose axle is the y axis."""
    across = about_x(math.pi / 2)
    parts = Parts().cylinder((0.0, 0.0, 0.0), (2 * radius, 2 * radius, 0.30), _RUBBER, across)
    parts.cylinder((0.0, 0.0, 0.0), (1.25 * radius, 1.25 * radius, 0.32), _RIM, across)
    for turn in (0.0, math.pi / 2):  # spokes, which show that it turns
        parts.box((0.0, 0.0, 0.0), (1.2 * radius, 0.33, 0.09), palette.SLATE, about_y(turn))
    return parts


def wheel_places(front: float, rear: float, track_front: float, track_rear: float) -> np.ndarray:
    """Return the places (4, 2) of the wheels relative to the centre of gravity, in the order of `CarState` [m].

    Args:
        front: Distance of the front axle from the centre of gravity [m].
        rear: Distance of the rear axle from the centre of gravity [m].
        track_front: Track width of the front axle [m].
        track_rear: Track width of the rear axle [m].
    """
    return np.array(
        [(front, track_front / 2), (front, -track_front / 2), (-rear, track_rear / 2), (-rear, -track_rear / 2)]
    )


def wheel_slip(state: np.ndarray, places: np.ndarray, radius: float, peak_ratio: float, peak_angle: float):
    """Return how much each wheel slips (4,): 1 is the slip of the largest force, beyond which the tyre slides.

    Args:
        state: State (29,) of a car.
        places: Places of the wheels (4, 2) [m].
        radius: Radius of the wheels [m].
        peak_ratio: Slip ratio of the largest force.
        peak_angle: Slip angle of the largest force [rad].
    """
    yaw_rate, steer = state[ROW["yaw_rate"]], state[ROW["steer"]] * np.array([1.0, 1.0, 0.0, 0.0], np.float32)
    forward = state[ROW["vx"]] - yaw_rate * places[:, 1]
    sideways = state[ROW["vy"]] + yaw_rate * places[:, 0]
    along = forward * np.cos(steer) + sideways * np.sin(steer)
    across = sideways * np.cos(steer) - forward * np.sin(steer)
    scale = np.sqrt(along**2 + SLIP_SPEED**2)
    ratio = (state[SPINS] * radius - along) / (scale * peak_ratio)
    angle = across / (scale * math.tan(peak_angle))
    return np.sqrt(ratio * ratio + angle * angle)
