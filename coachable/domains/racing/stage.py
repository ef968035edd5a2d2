"""Scene of a race: the circuit, the cars, and skid marks where their wheels slide."""

from collections import deque
from collections.abc import Hashable, Mapping
from typing import cast

import numpy as np
from torchrl.envs import EnvBase

from coachable.domains.racing.car_scene import body, wheel
from coachable.domains.racing.car_view import (
    GAUGES,
    VALUES,
    CarSize,
    aimed,
    car_poses,
    gauge_values,
    rolled_further,
    skid_marks,
    turned_camera,
)
from coachable.domains.racing.circuit_scene import KERB, RUN_OFF, circuit, outline
from coachable.envs.racing.circuit.track import Track
from coachable.envs.racing.env import RacingEnv
from coachable.envs.racing.physics.state import ROW
from coachable.scene import palette
from coachable.scene.frame import Backdrop, Frame, Map, Viewpoint
from coachable.scene.palette import Colour
from coachable.scene.parts import Parts, about_z
from coachable.training.collection import simulation_env

CARS: tuple[Colour, ...] = (palette.ORANGE, palette.SKY, palette.PURPLE, palette.GREEN, palette.YELLOW)
SKID: Colour = (52, 54, 58)
MARKS = 400  # of which the latest are kept
SKID_SIZE = (0.26, 0.01)  # [m], width and thickness of a mark
SKID_HEIGHT = 0.03  # [m]


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
        return circuit(_track(cast(RacingEnv, simulation_env(env)), row))

    def frame(self, env: EnvBase, row: int = 0, asked: Mapping[str, float | str] | None = None) -> Frame:
        """Return what is visible now; see `Stage.frame`."""
        env = cast(RacingEnv, simulation_env(env))
        state = env.state.cpu().numpy()
        columns, track = _mates(env, row), _track(env, row)
        key = (int(env.episode[row % env.races]), tuple(columns))
        if key != self._key:
            self._begin()
            self._key, self._episode = key, self._episode + 1
            self._outline = outline(track)
        parts = Parts()
        slips = [self._car(parts, env, state[:, column], column, index) for index, column in enumerate(columns)]
        own = state[:, row]
        aim = aimed(own)
        before = aim if self._heading is None else np.asarray(self._heading, np.float32)
        self._heading = float(turned_camera(before, aim))
        marks = Parts()
        for x, y, length, direction in self._marks:
            marks.box((x, y, SKID_HEIGHT), (length, *SKID_SIZE), SKID, about_z(direction))
        places = [(float(state[ROW["x"], c]), float(state[ROW["y"], c])) for c in columns]
        return Frame(
            parts=parts,
            focus=(*places[0], self.viewpoint.height),
            heading=self._heading,
            place=id(track),
            marks=marks,
            gauges=[
                form.gauge(dict(zip(VALUES, gauge_values(own, slips[0]).tolist(), strict=True))) for form in GAUGES
            ],
            map=Map(self._outline, places, CARS),
            episode=self._episode,
        )

    def _begin(self) -> None:
        self._key: Hashable = None
        self._heading: float | None = None
        self._marks: deque[list[float]] = deque(maxlen=MARKS)  # x, y, length, direction
        self._last: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # places and slips of a car's wheels
        self._rolled: dict[int, np.ndarray] = {}  # angles of a car's wheels [rad]

    def _car(self, parts: Parts, env: RacingEnv, state: np.ndarray, column: int, index: int) -> np.ndarray:
        """Add a car and notice its skid marks; return the slip of its wheels (4,)."""
        size = CarSize.of(env.garage.car, column)
        self._rolled[column] = rolled_further(state, self._rolled.get(column, np.zeros(4, np.float32)))
        poses = car_poses(state, self._rolled[column], size)
        shape = body(size.kind, size.length, size.width, CARS[index % len(CARS)])
        for figure, pose in zip([shape] + [wheel(size.radius)] * 4, poses, strict=True):
            parts.figure(figure, pose[:3], pose[3:])
        slip, places = size.slip(state), poses[1:, :2]
        if column in self._last:
            marks = skid_marks(*self._last[column], places, slip)
            self._marks.extend(marks[~np.isnan(marks[:, 0])].tolist())
        self._last[column] = places, slip
        return slip


def _mates(env: RacingEnv, row: int) -> list[int]:
    """Return the columns of the cars that meet the car of a row, itself first."""
    car, race = divmod(row, env.races)
    group = env.group[:, race].cpu()
    others = [k for k in range(env.cars) if k != car and group[k] == group[car]]
    return [k * env.races + race for k in (car, *others)]


def _track(env: RacingEnv, row: int) -> Track:
    """Return the circuit that the car of a row is on."""
    return env.tracks[int(env.circuit[row % env.races])]
