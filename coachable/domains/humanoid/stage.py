"""Scene of the humanoid: the walker on marked ground, with its footprints and the lengths of its last steps."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import cast

import mujoco
import numpy as np
from torchrl.envs import EnvBase

from coachable.envs.humanoid.env import HumanoidEnv
from coachable.envs.humanoid.model import CONTROL_STEP, FEET, load_spec
from coachable.envs.humanoid.observation import rotate_to_course
from coachable.export.web.part import WebScene
from coachable.scene import palette
from coachable.scene.frame import Backdrop, Frame, Gauge, Label, Viewpoint
from coachable.scene.palette import Colour, css
from coachable.scene.parts import BALL, CYLINDER, Batch, Parts, about_z, above, plain, towards
from coachable.training.collection import simulation_env

_HALF = 30.0  # [m], of the ground around the walker
_MARK = 0.5  # [m], between lines on the ground
_GROUND, _LINE, _METRE = (150, 158, 166), (170, 177, 184), (206, 211, 216)
_BODY: Colour = (214, 208, 196)
_SPINE = (120, 116, 110)
SIDES: dict[str, Colour] = {"right": palette.ORANGE, "left": palette.SKY}
_PRINTS, _LENGTHS = 24, 4  # footprints, and how many of them have the length of their step beside them
_SHORTEST = 0.05  # [m], of a step whose length is written; the first ones begin on the spot
_SOLE = (0.26, 0.10, 0.006)  # [m]
_FASTEST = 2.0  # [m/s], full bar
_SMOOTH = 0.05  # share of the latest speed in the mean
_SHADOW = ((0.8, (134, 142, 150)), (0.55, (118, 126, 134)), (0.35, (104, 112, 120)))  # diameters [m] and colours
_EYES = tuple((0.08, side, 0.01) for side in (-0.035, 0.035))  # [m], in the frame of the head
_EYE = 0.035  # [m]
_SPINE_RADIUS = 0.055  # [m]
_PUSH_SCALE = 0.006  # [m/N], length of the arrow


class HumanoidStage:
    """Scene of one walker of a `HumanoidEnv` or of an environment around it; see `coachable.scene.frame.Stage`."""

    viewpoint = Viewpoint(distance=3.6, elevation=14.0, azimuth=-55.0, far=_HALF)
    legend = (
        (SIDES["right"], "right leg, arm and footprints"),
        (SIDES["left"], "left leg, arm and footprints"),
        (palette.REQUESTED, "line: where a step of the requested length ends"),
        (palette.BLUE, "arrow: course"),
        (_METRE, "metres; thin lines: half metres"),
    )

    def __init__(self) -> None:
        self._model = load_spec().compile()
        self._data = mujoco.MjData(self._model)
        index = np.flatnonzero(self._model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
        bodies = [self._model.body(body).name for body in self._model.geom_bodyid[index]]
        colours = np.array([_colour(name) for name in bodies], np.uint8)
        self._geoms = index, colours
        self._feet = [self._model.body(foot).id for foot in FEET]
        self._begin()

    def backdrop(self, env: EnvBase, row: int = 0) -> Backdrop:
        """Return what does not move; see `Stage.backdrop`."""
        ground = plain("floor", (-_HALF, -_HALF), (_HALF, _HALF), 0.0, 3.0, _GROUND)
        lines = Parts()
        for index in range(round(-_HALF / _MARK), round(_HALF / _MARK) + 1):
            whole = index * _MARK % 1.0 == 0.0
            colour, width = (_METRE, 0.025) if whole else (_LINE, 0.012)
            lines.box((index * _MARK, 0.0, 0.0), (width, 2 * _HALF, 0.004 + 0.001 * whole), colour)
            lines.box((0.0, index * _MARK, 0.0), (2 * _HALF, width, 0.004 + 0.001 * whole), colour)
        return Backdrop((ground,), lines, travels=True)

    def frame(self, env: EnvBase, row: int = 0, asked: Mapping[str, float | str] | None = None) -> Frame:
        """Return what is visible now; see `Stage.frame`."""
        env = cast(HumanoidEnv, simulation_env(env))
        self._data.qpos[:] = env.simulation.positions[row]
        mujoco.mj_kinematics(self._model, self._data)
        course = float(env.course[row])
        self._notice(env, row, course)
        position, velocity = self._data.qpos[:2], env.simulation.velocities[row, :2]
        speed = float(rotate_to_course(velocity[None], np.array([course]))[0, 0])
        self._speed += _SMOOTH * (speed - self._speed) if env.steps[row] > 1 else speed - self._speed
        marks, labels = self._prints_on_the_ground()
        for width, colour in _SHADOW:
            marks.cylinder((*position, 0.0055 - 0.001 * width), (width, width, 0.002), colour)
        self._course(marks, position, course)
        length = (asked or {}).get("step_length")
        if isinstance(length, float) and self._prints:
            self._target(marks, course, length)
        return Frame(
            parts=self._body(),
            focus=(
                float(position[0]),
                float(position[1]),
                self.viewpoint.height,
            ),  # a fixed height, because the torso moves up and down
            heading=course,
            marks=marks,
            glows=self._push(env.pushing[row]),
            labels=labels,
            gauges=self._gauges(),
            episode=self._episode,
        )

    def _begin(self) -> None:
        self._episode = getattr(self, "_episode", 0) + 1
        self._last: np.ndarray | None = None
        self._steps, self._speed = -1, 0.0
        self._prints: deque[tuple[int, np.ndarray, float]] = deque(maxlen=_PRINTS)  # foot, place, direction
        self._lengths: deque[tuple[float, np.ndarray]] = deque(maxlen=_LENGTHS)

    def _notice(self, env: HumanoidEnv, row: int, course: float) -> None:
        """Remember the footprints that are new since the last frame."""
        prints, steps = env.gait.prints[row].copy(), int(env.steps[row])
        if steps < self._steps:
            self._begin()
        self._steps = steps
        for foot in range(2):
            if self._last is not None and np.allclose(prints[foot], self._last[foot]):
                continue
            ahead = self._data.xmat[self._feet[foot]].reshape(3, 3)[:2, 0]
            self._prints.append((foot, prints[foot], math.atan2(ahead[1], ahead[0])))
            if self._last is not None:
                apart = prints[foot] - self._last[1 - foot]
                length = float(rotate_to_course(apart[None], np.array([course]))[0, 0])
                if length >= _SHORTEST:
                    self._lengths.append((length, prints[foot]))
        self._last = prints

    def _prints_on_the_ground(self) -> tuple[Parts, list[Label]]:
        marks = Parts()
        for foot, place, direction in self._prints:
            marks.box((*place, 0.006), _SOLE, _print_colour("left" if foot else "right"), about_z(direction))
        return marks, [Label(f"{length:.2f} m", (*place, 0.05)) for length, place in self._lengths]

    def _target(self, marks: Parts, course: float, length: float) -> None:
        """Draw a line across the course where a step of the requested length from the last footprint ends."""
        ahead = np.array([math.cos(course), math.sin(course)])
        place = self._prints[-1][1] + length * ahead
        marks.box((*place, 0.007), (0.02, 0.7, 0.006), palette.REQUESTED, about_z(course))

    def _course(self, marks: Parts, position: np.ndarray, course: float) -> None:
        """Draw an arrow along the course beside the walker."""
        ahead, left = np.array([math.cos(course), math.sin(course)]), np.array([-math.sin(course), math.cos(course)])
        start = position + 0.45 * ahead
        tip = start + 0.7 * ahead
        marks.box((*(start + tip) / 2, 0.008), (0.7, 0.03, 0.006), palette.BLUE, about_z(course))
        for side in (-1, 1):
            barb = tip - 0.07 * ahead + 0.055 * side * left
            marks.box((*barb, 0.008), (0.2, 0.03, 0.006), palette.BLUE, about_z(course - side * 0.7))

    def _push(self, force: np.ndarray) -> Parts:
        """Return an arrow that ends at the torso, as long as the force is large."""
        glows, size = Parts(), float(np.linalg.norm(force))
        if size > 0:
            torso = above(self._data.qpos[:3], 0.1)
            tail = torso - (0.15 + _PUSH_SCALE * size) * force / size
            glows.rod(tail, torso - 0.15 * force / size, 0.03, palette.VERMILION)
            glows.ball(torso - 0.15 * force / size, (0.12,) * 3, palette.VERMILION)
        return glows

    def _body(self) -> Parts:
        index, colours = self._geoms
        places, axes = self._data.geom_xpos[index], self._data.geom_xmat[index].reshape(-1, 3, 3)[:, :, 2]
        radius = self._model.geom_size[index, 0]
        half = np.where(
            self._model.geom_type[index] == mujoco.mjtGeom.mjGEOM_CAPSULE, self._model.geom_size[index, 1], 0
        )
        turns = np.stack([towards(axis) for axis in axes])
        parts = Parts().batch(CYLINDER, Batch(places, turns, 2 * np.stack([radius, radius, half], -1), colours))
        for side in (-1, 1):
            ends = places + (side * half)[:, None] * axes
            parts.batch(BALL, Batch(ends, turns, np.repeat(2 * radius[:, None], 3, 1), colours))
        chest, pelvis = (self._data.xpos[self._model.body(name).id] for name in ("torso", "pelvis"))
        parts.capsule(chest, pelvis, _SPINE_RADIUS, _SPINE)
        head = self._model.body("head").id
        axes = self._data.xmat[head].reshape(3, 3)
        for place in _EYES:  # which show where it looks
            parts.ball(self._data.xpos[head] + axes @ place, (_EYE,) * 3, palette.INK)
        return parts

    def _gauges(self) -> Sequence[Gauge]:
        speed = Gauge("speed", f"{self._speed:.2f} m/s", self._speed / _FASTEST, palette.MEASURED)
        lengths = " ".join(f"{length:.2f}" for length, _ in self._lengths)
        time = f"{self._steps * CONTROL_STEP:.1f} s"
        return speed, Gauge("last steps", f"{lengths} m" if lengths else "none yet"), Gauge("time", time)


def web_scene() -> WebScene:
    """Return how the exported page draws the walker: with the colours, marks and legend of this stage."""
    model = load_spec().compile()
    names = [model.body(index).name for index in range(1, model.nbody)]
    eyes = [{"body": "head", "at": place, "diameter": _EYE, "colour": css(palette.INK)} for place in _EYES]
    return WebScene(
        bodies={name: css(_colour(name)) for name in names},
        body=css(_BODY),
        links=[{"bodies": ("torso", "pelvis"), "radius": _SPINE_RADIUS, "colour": css(_SPINE)}],
        balls=eyes,
        ground=css(_GROUND),
        lines=(css(_LINE), css(_METRE)),
        marks=(css(_print_colour("right")), css(_print_colour("left"))),
        lengths=_LENGTHS,
        shortest=_SHORTEST,
        asked=css(palette.REQUESTED),
        course=css(palette.BLUE),
        viewpoint=vars(HumanoidStage.viewpoint),
        legend=[(css(colour), meaning) for colour, meaning in HumanoidStage.legend],
    )


def _print_colour(side: str) -> Colour:
    return palette.mixed(SIDES[side], (0, 0, 0), 0.15)


def _colour(name: str) -> Colour:
    """Return the colour of a part of the body by its name: limbs have that of their side."""
    side = next((side for side in SIDES if side in name), None)
    return _BODY if side is None else palette.mixed(SIDES[side], _BODY, 0.25)
