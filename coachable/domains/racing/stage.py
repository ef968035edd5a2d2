"""Scene of a race: the circuit, the cars, and skid marks where their wheels slide."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, cast

import numpy as np
from torchrl.envs import EnvBase

from coachable.domains.racing.car_scene import (
    body,
    kind_of,
    turned_wheel,
    wheel,
    wheel_places,
    wheel_slip,
)
from coachable.domains.racing.circuit_scene import KERB, RUN_OFF, circuit, outline
from coachable.envs.racing.circuit.track import Track
from coachable.envs.racing.env import RacingEnv
from coachable.envs.racing.physics.simulation import CONTROL_STEP
from coachable.envs.racing.physics.state import ROW, SPINS, WEARS
from coachable.scene import palette
from coachable.scene.frame import Backdrop, Frame, Gauge, Map, Viewpoint
from coachable.scene.palette import Colour
from coachable.scene.parts import Parts, about_z, multiplied, rotated

CARS: tuple[Colour, ...] = (palette.ORANGE, palette.SKY, palette.PURPLE, palette.GREEN, palette.YELLOW)
SKID: Colour = (52, 54, 58)
SLIDING = 1.3  # slip from which a wheel leaves a mark; 1 is that of the largest force
_MARKS = 400
_FARTHEST = 12.0  # [m], between two states of a wheel that a mark joins
_SKID_WIDTH = 0.26  # [m]
_LAG = 0.35  # share by which the camera turns towards the car's direction in a control step
_FULL = {"speed": 300.0, "slip": 20.0, "fuel": 100.0}  # [km/h], [deg], [l]: values of full bars
_WORN = 0.75  # wear beyond which the grip falls faster


class RacingStage:
    """Scene of a car of a `RacingEnv` or of an environment around it, and of the cars that it meets; see `Stage`."""

    viewpoint = Viewpoint(distance=13.0, elevation=17.0, azimuth=180.0, turns=True, far=900.0, height=1.0)
    legend = (
        (CARS[0], "the coached car"),
        (CARS[1], "other cars, each in its own colour"),
        (KERB[0], "kerbs"),
        (RUN_OFF, "run-off"),
        (SKID, "skid marks, where a wheel slides"),
    )

    def __init__(self) -> None:
        self._begin()
        self._episode = 0
        self._outline = np.zeros((0, 2))

    def backdrop(self, env: EnvBase, row: int = 0) -> Backdrop:
        """Return what does not move; see `Stage.backdrop`."""
        return circuit(_track(_racing(env), row))

    def frame(self, env: EnvBase, row: int = 0, asked: Mapping[str, float | str] | None = None) -> Frame:
        """Return what is visible now; see `Stage.frame`."""
        env = _racing(env)
        state = env.state.cpu().numpy()
        columns, track = mates(env, row), _track(env, row)
        key = (int(env.episode[row % env.races]), tuple(columns))
        if key != self._key:
            self._begin()
            self._key, self._episode = key, self._episode + 1
            self._outline = outline(track)
        parts = Parts()
        slips = [self._car(parts, env, state[:, column], column, index) for index, column in enumerate(columns)]
        own = state[:, row]
        self._turn(math.remainder(float(own[ROW["yaw"]]) + _drift(own) / 2, 2 * math.pi))
        marks = Parts()
        for middle, length, direction in self._marks:
            marks.box((*middle, 0.03), (length, _SKID_WIDTH, 0.01), SKID, about_z(direction))
        places = [(float(state[ROW["x"], c]), float(state[ROW["y"], c])) for c in columns]
        return Frame(
            parts=parts,
            focus=(*places[0], self.viewpoint.height),
            heading=self._heading or 0.0,
            place=id(track),
            marks=marks,
            gauges=_gauges(own, slips[0]),
            map=Map(self._outline, places, CARS),
            episode=self._episode,
        )

    def _begin(self) -> None:
        self._key: Hashable = None
        self._heading: float | None = None
        self._marks: deque[tuple[np.ndarray, float, float]] = deque(maxlen=_MARKS)  # middle, length, direction
        self._last: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # places and slips of a car's wheels
        self._rolled: dict[int, np.ndarray] = {}  # angles of a car's wheels [rad]

    def _turn(self, direction: float) -> None:
        """Turn the camera towards a direction [rad], with a lag, so that a spinning car does not whirl the world."""
        before = direction if self._heading is None else self._heading
        self._heading = before + _LAG * math.remainder(direction - before, 2 * math.pi)

    def _car(self, parts: Parts, env: RacingEnv, state: np.ndarray, column: int, index: int) -> np.ndarray:
        """Add a car and notice its skid marks; return the slip of its wheels (4,)."""
        car = {name: _number(getattr(env.garage.car, name), column) for name in _NUMBERS}
        turn = np.array(about_z(float(state[ROW["yaw"]])))
        centre = np.array([state[ROW["x"]], state[ROW["y"]], 0.0])
        middle = np.array([(car["front_axle"] - car["rear_axle"]) / 2, 0.0, 0.0])
        shape = body(kind_of(car["lift_area"]), car["length"], car["width"], CARS[index % len(CARS)])
        parts.figure(shape, centre + rotated(turn, middle[None])[0], turn)
        offsets = wheel_places(car["front_axle"], car["rear_axle"], car["track_front"], car["track_rear"])
        radius = car["wheel_radius"]
        places = centre + rotated(turn, np.insert(offsets, 2, radius, axis=1))
        rolled = self._rolled.get(column, np.zeros(4)) + state[SPINS] * CONTROL_STEP
        for place, angle, front in zip(places, rolled, (True, True, False, False), strict=True):
            steer = float(state[ROW["steer"]]) if front else 0.0
            parts.figure(wheel(radius), place, multiplied(turn, turned_wheel(steer, float(angle))[None])[0])
        slip = wheel_slip(state, offsets, radius, car["peak_slip_ratio"], car["peak_slip_angle"])
        self._skid(column, places[:, :2], slip)
        self._rolled[column] = rolled
        return slip

    def _skid(self, column: int, places: np.ndarray, slip: np.ndarray) -> None:
        """Join the places of wheels that slid in the last state and still do."""
        if column in self._last:
            before, slipped = self._last[column]
            for one, other, slides in zip(before, places, (slip > SLIDING) & (slipped > SLIDING), strict=True):
                length = float(np.hypot(*(other - one)))
                if slides and 0.05 < length < _FARTHEST:
                    self._marks.append(((one + other) / 2, length, math.atan2(*(other - one)[::-1])))
        self._last[column] = places, slip


_NUMBERS = (
    *("front_axle", "rear_axle", "track_front", "track_rear", "length", "width", "wheel_radius"),
    *("lift_area", "peak_slip_ratio", "peak_slip_angle"),
)


def mates(env: RacingEnv, row: int) -> list[int]:
    """Return the columns of the cars that meet the car of a row, itself first.

    Args:
        env: The base environment.
        row: Row of the car.
    """
    car, race = divmod(row, env.races)
    group = env.group[:, race].cpu()
    others = [k for k in range(env.cars) if k != car and group[k] == group[car]]
    return [k * env.races + race for k in (car, *others)]


def _track(env: RacingEnv, row: int) -> Track:
    """Return the circuit that the car of a row is on."""
    return env.tracks[int(env.circuit[row % env.races])]


def _racing(env: EnvBase) -> RacingEnv:
    while not isinstance(env, RacingEnv):
        env = cast(EnvBase, env.base_env)
    return env


def _number(value: Any, column: int) -> float:
    return round(float(value[column]) if hasattr(value, "shape") else float(value), 4)


def _drift(state: np.ndarray) -> float:
    """Return the angle from the car's direction to that of its velocity [rad]."""
    vx, vy = float(state[ROW["vx"]]), float(state[ROW["vy"]])
    return math.atan2(vy, vx) if math.hypot(vx, vy) > 3.0 else 0.0


def _gauges(state: np.ndarray, slip: np.ndarray) -> Sequence[Gauge]:
    speed = 3.6 * float(np.hypot(state[ROW["vx"]], state[ROW["vy"]]))
    gear, fuel = float(state[ROW["gear"]]), float(state[ROW["fuel"]])
    angle, wear = abs(math.degrees(_drift(state))), 100 * state[WEARS]
    sliding = bool((slip > SLIDING).any())
    worn = float(state[WEARS].max())
    return (
        Gauge("speed", f"{speed:.0f} km/h, gear {gear:.0f}", speed / _FULL["speed"], palette.BLUE),
        Gauge("throttle", f"{100 * state[ROW['throttle']]:.0f} %", float(state[ROW["throttle"]]), palette.GREEN),
        Gauge("brake", f"{100 * state[ROW['brake']]:.0f} %", float(state[ROW["brake"]]), palette.PURPLE),
        Gauge(
            "slip angle",
            f"{angle:.0f}°{', sliding' if sliding else ''}",
            angle / _FULL["slip"],
            palette.VERMILION if sliding else palette.BLUE,
        ),
        Gauge("fuel", f"{fuel:.1f} l", fuel / _FULL["fuel"], palette.ORANGE),
        Gauge(
            "tyres worn",
            " ".join(f"{value:.0f}" for value in wear) + " %",
            worn,
            palette.VERMILION if worn > _WORN else palette.SKY,
        ),
    )
