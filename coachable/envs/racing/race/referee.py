"""`Referee`, pure functions for the inputs, rewards and observations of a control step, which can be compiled."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from coachable.envs.racing.circuit.track import Course
from coachable.envs.racing.physics.cars import Car
from coachable.envs.racing.physics.dynamics import WheelSet
from coachable.envs.racing.physics.simulation import CONTROL_STEP, bodies_of
from coachable.envs.racing.physics.state import HEATS, ROW, WEARS, CarInputs, CarState
from coachable.envs.racing.physics.surface import beyond
from coachable.envs.racing.physics.tyres import heat_loss
from coachable.envs.racing.race.features import sideslip
from coachable.envs.racing.race.observation import (
    COURSE_POINTS,
    OPPONENT_COLUMNS,
    car_columns,
    course_ahead,
    opponents_seen,
    own_car,
)
from coachable.envs.racing.race.run import (
    FRAME,
    SLIPSTREAM_DRAG,
    SLIPSTREAM_LIFT,
    Others,
    Run,
    look_around,
    slipstream,
    tyre_view,
    wrap,
)
from coachable.envs.racing.race.task import Outcome, TaskWeights, contacts, metres_gained, style_features, task_reward

WRONG_WAY_TIME = 3.0  # [s]
STOPPED_TIME = 3.0  # [s]
STOPPED_SPEED = 1.0  # [m/s]
_BEHIND_WALL = 3.0  # [m], further out than a car can be pushed back from
TELEMETRY = (
    "distance",  # [m] from where the first car of the group started
    "speed",  # [m/s]
    "offset",  # from the centre line [m]
    "progress",  # in this step [m]
    "wear",  # mean of the tyres
    "fuel",  # [l]
    "off",  # flags
    "wall",
    "contact",
    "place",  # 1 is first of the group
    "sideslip",  # angle from the heading to the velocity, in (-π, π] [rad]
    "heading",  # relative to the track [rad]
    "curvature",  # of the track [1/m]
    "stranded",  # flag: the car gives up, or waits to be put back
    "off_time",  # with three wheels off the track in this step [s]; "off" tells whether it is more than half of it
)


class Verdict(NamedTuple):
    """Result of one control step."""

    state: Tensor  # (29, N)
    run: Tensor  # (25, N)
    observation: Tensor  # (N, D)
    reward: Tensor  # (N,) of the task
    features: Tensor  # (N, F)
    telemetry: Tensor  # (N, 15)
    terminated: Tensor  # (N,) bool


@dataclass(frozen=True)
class Referee:
    """The task of B races of A cars on a course.

    Attributes:
        course: Track.
        weights: Weights of the task reward.
        cars: Number A of cars in a race.
        substeps: Number of substeps of a control step.
        course_points: Number of points of each edge of the track in the observation.
        pool: Whether cars differ, in which case the observation describes the car.
        opponents: Whether the observation has columns for opponents.
        curvature: Whether the observation has the curvature of the track ahead instead of the place on the lap.
        wrong_way_time: Time of driving backwards that ends an episode [s].
    """

    course: Course
    weights: TaskWeights
    cars: int
    substeps: int
    course_points: int = COURSE_POINTS
    pool: bool = False
    opponents: bool = False
    curvature: bool = False
    wrong_way_time: float = WRONG_WAY_TIME

    def command(self, packed: Tensor, packed_run: Tensor, action: Tensor, compound: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state and the inputs of the next control step.

        Args:
            packed: State (29, N).
            packed_run: Task state (25, N).
            action: Steering in [-1, 1] and throttle (positive) or brake (negative), (N, 2).
            compound: Factors of grip and wear, then the compound as one-hot, (11, N).

        Returns:
            The state (29, N) with its timers at 0, and the inputs (15, N).
        """
        run = Run(*packed_run.unbind(0))
        steer, pedal = action[:, 0], action[:, 1]
        inputs = CarInputs(
            (steer - packed[ROW["steer_command"]]) / self.substeps,
            torch.clamp(pedal, min=0.0),
            torch.clamp(-pedal, min=0.0),
            1.0 - SLIPSTREAM_DRAG * run.slipstream,
            1.0 - SLIPSTREAM_LIFT * run.slipstream,
            compound[0],
            compound[1],
            *packed_run[FRAME].unbind(0),
        )
        timers = torch.zeros_like(packed[:2])
        return torch.cat([packed[: ROW["off_time"]], timers]), torch.stack(list(inputs))

    def judge(
        self,
        old: Tensor,
        new: Tensor,
        packed_run: Tensor,
        action: Tensor,
        compound: Tensor,
        car: Car,
        wheels: WheelSet,
        group: Tensor | None = None,
        impact: Tensor | None = None,
    ) -> Verdict:
        """Compute the result of a control step.

        Args:
            old: State (29, N) before the step.
            new: State (29, N) after the step.
            packed_run: Task state (25, N) before the step.
            action: Actions (N, 2).
            compound: Factors of grip and wear, then the compound as one-hot, (11, N).
            car: Parameters.
            wheels: Wheels of that car.
            group: Groups (A, B), if there are several cars in a race.
            impact: Largest squared relative speed of each pair's contacts (A // 2, A, B) [m²/s²], if there are several.
        """
        broken = ~torch.isfinite(new.sum(0))
        new = torch.where(broken, old, new)
        s, before = CarState(*new.unbind(0)), Run(*packed_run.unbind(0))
        place, arc, frame = self.course.project(s.x, s.y, before.s)
        progress = wrap(place - before.s, self.course.length)
        turned = torch.cos(s.yaw), torch.sin(s.yaw)
        along = arc.ny * turned[0] - arc.nx * turned[1]  # the tangent is the normal turned to the right
        across = arc.nx * turned[0] + arc.ny * turned[1]
        speed = torch.sqrt(s.vx * s.vx + s.vy * s.vy)
        outcome = Outcome(progress, *(torch.zeros_like(s.x) for _ in range(4)))
        others, bodies, tow = None, None, torch.zeros_like(s.x)
        if group is not None and impact is not None:
            bodies = bodies_of(new, car, self.cars)
            others = self._around(place, arc.offset, group)
            earlier = self._around(before.s, before.offset, group)
            ahead, behind = metres_gained(earlier, others)
            touched, rear_end = contacts(impact, earlier, self.cars)
            outcome = Outcome(progress, *(value.reshape(-1) for value in (ahead, behind, touched, rear_end)))
            tow = self._tow(others, car)
        facing_back = (along < 0.0) & (before.along >= 0.0)
        run = Run(
            place,
            arc.offset,
            along,
            across,
            before.distance + progress,
            before.steps + 1.0,
            torch.where(progress < -CONTROL_STEP * STOPPED_SPEED, before.wrong_time + CONTROL_STEP, 0.0),
            torch.where(speed < STOPPED_SPEED, before.stopped_time + CONTROL_STEP, 0.0),
            action[:, 0],
            action[:, 1],
            before.steer,
            before.pedal,
            (s.off_time > 0.5 * CONTROL_STEP).to(new.dtype),
            (s.wall_time > 0.0).to(new.dtype),
            outcome.contact,
            tow,
            before.spins + facing_back.to(new.dtype),
            *frame.unbind(0),
        )
        tyres = tyre_view(car, wheels, new, compound[0])
        reward = task_reward(self.weights, s, run, tyres, outcome)
        features = style_features(old, new, tyres, outcome, run.curvature, bodies, group)
        reward = reward - self.weights.tyre_heat * (heat_loss(new[HEATS]) - heat_loss(old[HEATS])).mean(0)
        lost = beyond(arc.offset, run.left, run.right) > run.margin + _BEHIND_WALL
        stranded = (run.wrong_time > self.wrong_way_time) | (run.stopped_time > STOPPED_TIME) | lost
        reward = reward - self.weights.stranded * stranded.to(reward.dtype)
        terminated = stranded | broken
        packed_run = torch.stack(list(run))
        observation = self.observe(new, packed_run, compound, car, wheels, group)
        return Verdict(
            new,
            packed_run,
            observation,
            reward,
            features,
            self._telemetry(new, run, progress, stranded, group),
            terminated,
        )

    def observe(
        self,
        packed: Tensor,
        packed_run: Tensor,
        compound: Tensor,
        car: Car,
        wheels: WheelSet,
        group: Tensor | None = None,
    ) -> Tensor:
        """Return the observations (N, D); the arguments are those of `judge`.

        Args:
            packed: State (29, N).
            packed_run: Task state (25, N).
            compound: Factors of grip and wear, then the compound as one-hot, (11, N).
            car: Parameters.
            wheels: Wheels of that car.
            group: Groups (A, B), if there are several cars in a race.

        Returns:
            Observations (N, D).
        """
        run = Run(*packed_run.unbind(0))
        tyres = tyre_view(car, wheels, packed, compound[0])
        length = None if self.curvature else self.course.length
        parts = [torch.stack(own_car(car, wheels, packed, run, tyres, length), dim=-1), compound[2:].T]
        if self.pool:
            parts.append(car_columns(car))
        parts.append(course_ahead(self.course, packed, run, self.course_points, self.curvature))
        if group is not None:
            bodies = bodies_of(packed, car, self.cars)
            others = self._around(run.s, run.offset, group)
            parts += [opponents_seen(bodies, others), run.slipstream[:, None]]
        elif self.opponents:
            parts.append(run.slipstream.new_zeros(len(run.slipstream), OPPONENT_COLUMNS))
        return torch.cat(parts, dim=1)

    def begin(self, packed: Tensor, s: Tensor, distance: Tensor, car: Car, group: Tensor | None) -> Tensor:
        """Return the task state (25, N) of cars that have just been placed on the track.

        Args:
            packed: State (29, N).
            s: Estimates (N,) of the distance along the track, within a few dozen metres [m].
            distance: Distance (N,) that counts as covered at the start [m].
            car: Parameters.
            group: Groups (A, B), if there are several cars in a race.
        """
        state = CarState(*packed.unbind(0))
        place, arc, frame = self.course.project(state.x, state.y, s)
        cos, sin = torch.cos(state.yaw), torch.sin(state.yaw)
        nothing = torch.zeros_like(place)
        tow = nothing
        if group is not None:
            tow = self._tow(self._around(place, arc.offset, group), car)
        return torch.stack(
            [
                place,
                arc.offset,
                arc.ny * cos - arc.nx * sin,
                arc.nx * cos + arc.ny * sin,
                distance,
                *[nothing] * 10,
                tow,
                nothing,
                *frame.unbind(0),
            ]
        )

    def _split(self, values: Tensor) -> Tensor:
        return values.reshape(self.cars, -1)

    def _around(self, s: Tensor, offset: Tensor, group: Tensor) -> Others:
        length = self.course.race_length(self.cars)
        return look_around(self._split(s), self._split(offset), group, length)

    def _tow(self, others: Others, car: Car) -> Tensor:
        length = self._split(car.length) if isinstance(car.length, Tensor) else car.length
        return slipstream(others, length).reshape(-1)

    def _telemetry(self, packed: Tensor, run: Run, progress: Tensor, stranded: Tensor, group: Tensor | None) -> Tensor:
        s = CarState(*packed.unbind(0))
        rank = torch.ones_like(s.x)
        if group is not None:
            distance = self._split(run.distance)
            for k in range(1, self.cars):
                in_front = (distance.roll(-k, 0) > distance) & (group.roll(-k, 0) == group)
                rank = rank + in_front.to(rank.dtype).reshape(-1)
        return torch.stack(
            [
                run.distance,
                torch.sqrt(s.vx * s.vx + s.vy * s.vy),
                run.offset,
                progress,
                packed[WEARS].mean(0),
                s.fuel,
                run.off,
                run.wall,
                run.contact,
                rank,
                sideslip(s.vx, s.vy),
                torch.atan2(run.across, run.along),
                run.curvature,
                stranded.to(progress.dtype),
                s.off_time,
            ],
            dim=-1,
        )
