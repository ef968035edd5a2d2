"""Gait tracking: the foot that must strike next, and measurements of the step that has just ended."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from coachable.envs.humanoid.model import CONTROL_STEP
from coachable.envs.humanoid.observation import rotate_to_course
from coachable.envs.humanoid.simulation import Kinematics

# A foot counts as touching the floor when its lowest point is below this height [m].
CONTACT_HEIGHT = 0.001
# A foot that was off the floor for fewer control steps has bounced: it still stands on the same footprint.
MIN_AIRBORNE = 2


@dataclass
class StepReport:
    """What happened in one control step, per env. Quantities of a step are 0 without a strike.

    Attributes:
        completed: (N,) bool, the expected foot struck.
        length: (N,) distance along the course from the other foot's last footprint to the new one [m].
        duration: (N,) time since the previous strike [s].
        stride_fraction: (N,) share of this step in the stride, i.e. in the sum of this step and the previous one.
            0 where either did not go forward; 1/2 for the first step of an episode, which has no stride yet.
        knee_min: (N,) smallest knee angle of both legs during the step [rad].
        knee_max: (N,) largest one [rad].
        timed_out: (N,) bool, no strike for longer than `step_max`.
        clearance: (N,) how high the lowest point of the striking foot was lifted [m].
        pitch: (N,) pitch of the foot as it strikes, positive with the toes first [rad].
        drift: (N,) distance to the left of the course from the striking foot's last footprint to the new one [m].
        force: (N,) largest force under the foot that struck last, since then [body weights].
        swing_knee: (N,) smallest angle of the knee of the leg that strikes, during the step [rad].
        foot: (N,) index of the foot that struck.
    """

    completed: np.ndarray
    length: np.ndarray
    duration: np.ndarray
    stride_fraction: np.ndarray
    knee_min: np.ndarray
    knee_max: np.ndarray
    timed_out: np.ndarray
    clearance: np.ndarray
    pitch: np.ndarray
    drift: np.ndarray
    force: np.ndarray
    swing_knee: np.ndarray
    foot: np.ndarray


@dataclass
class GaitTracker:
    """State of the gait of N walkers. Index 0 is the right foot, 1 the left one.

    Attributes:
        expected: (N,) index of the foot that must strike next.
        clock: (N,) control steps since the last strike.
        airborne: (N, 2) control steps since each foot left the floor; 0 in contact.
        highest: (N, 2) largest clearance of each foot since it left the floor [m].
        prints: (N, 2, 2) x and y of each foot's last footprint, see `Kinematics.soles` [m].
        force: (N,) largest force since the last strike under the foot that struck [body weights].
        first_step: (N,) bool, no strike yet in this episode.
        knee_min: (N, 2) smallest angle of each knee since the step began [rad].
        knee_max: (N, 2) largest one [rad].
        step_vector: (N, 2) x and y of the foot to strike relative to the other one when the step began [m].
        stride_vector: (N, 2) the same when the stride began, one step earlier [m].
        step_max: time without a strike after which a step counts as timed out [s].
    """

    expected: np.ndarray
    clock: np.ndarray
    airborne: np.ndarray
    highest: np.ndarray
    prints: np.ndarray
    force: np.ndarray
    first_step: np.ndarray
    knee_min: np.ndarray
    knee_max: np.ndarray
    step_vector: np.ndarray
    stride_vector: np.ndarray
    step_max: float

    @classmethod
    def create(cls, num_envs: int, step_max: float) -> GaitTracker:
        """Return a tracker of `num_envs` walkers that have not started.

        Args:
            num_envs: Number of walkers N.
            step_max: Time after which a step times out [s].
        """
        return cls(
            expected=np.zeros(num_envs, dtype=np.int64),
            clock=np.zeros(num_envs, dtype=np.int64),
            airborne=np.zeros((num_envs, 2), dtype=np.int64),
            highest=np.zeros((num_envs, 2)),
            prints=np.zeros((num_envs, 2, 2)),
            force=np.zeros(num_envs),
            first_step=np.ones(num_envs, dtype=bool),
            knee_min=np.zeros((num_envs, 2)),
            knee_max=np.zeros((num_envs, 2)),
            step_vector=np.zeros((num_envs, 2)),
            stride_vector=np.zeros((num_envs, 2)),
            step_max=step_max,
        )

    def reset(
        self, rows: np.ndarray, expected: np.ndarray, feet: np.ndarray, knees: np.ndarray, soles: np.ndarray
    ) -> None:
        """Start an episode in `rows`.

        Args:
            rows: (M,) indices of the envs.
            expected: (M,) foot that must strike first.
            feet: (M, 2, 2) x and y of the feet [m].
            knees: (M, 2) knee angles [rad].
            soles: (M, 2, 2) x and y of the soles [m].
        """
        index = np.arange(len(rows))
        self.expected[rows] = expected
        self.clock[rows] = 0
        self.airborne[rows] = 0
        self.highest[rows] = 0.0
        self.prints[rows] = soles
        self.force[rows] = 0.0
        self.first_step[rows] = True
        self.knee_min[rows] = knees
        self.knee_max[rows] = knees
        self.step_vector[rows] = feet[index, expected] - feet[index, 1 - expected]
        self.stride_vector[rows] = self.step_vector[rows]

    def update(self, kinematics: Kinematics, knees: np.ndarray, forces: np.ndarray, course: np.ndarray) -> StepReport:
        """Update the gait by one control step.

        Args:
            kinematics: geometry of the walkers.
            knees: (N, 2) knee angles [rad].
            forces: (N, 2) largest force under each foot in this control step [body weights].
            course: (N,) direction that counts as forward, counter-clockwise from +x [rad].
        """
        index, expected = np.arange(len(self.expected)), self.expected
        clearance, soles = kinematics.foot_clearance, kinematics.soles
        self.clock += 1
        np.minimum(self.knee_min, knees, out=self.knee_min)
        np.maximum(self.knee_max, knees, out=self.knee_max)
        touching = clearance < CONTACT_HEIGHT
        landed = touching & (self.airborne >= MIN_AIRBORNE)
        completed = landed[index, expected]

        # The other foot struck last; the step before went from this foot's footprint to the other's.
        own, other = self.prints[index, expected], self.prints[index, 1 - expected]
        feet = kinematics.feet[..., :2]
        apart = feet[index, expected] - feet[index, 1 - expected]
        vectors = rotate_to_course(np.stack([soles[index, expected] - other, other - own], axis=1), course)
        step, before = vectors[:, 0], vectors[:, 1]
        length, previous = step[:, 0], before[:, 0]
        forward = (length > 0) & (previous > 0)
        fraction = np.where(forward, length / np.where(forward, length + previous, 1.0), 0.0)
        fraction = np.where(self.first_step, np.where(length > 0, 0.5, 0.0), fraction)

        def at_strike(values: np.ndarray) -> np.ndarray:
            return np.where(completed, values, 0.0)

        report = StepReport(
            completed=completed,
            length=at_strike(length),
            duration=at_strike(self.clock * CONTROL_STEP),
            stride_fraction=at_strike(fraction),
            knee_min=self.knee_min.min(axis=1),
            knee_max=self.knee_max.max(axis=1),
            timed_out=~completed & (self.clock * CONTROL_STEP > self.step_max),
            clearance=at_strike(self.highest[index, expected]),
            pitch=at_strike(kinematics.foot_pitch[index, expected]),
            drift=at_strike(step[:, 1] + before[:, 1]),
            force=at_strike(self.force),
            swing_knee=at_strike(self.knee_min[index, expected]),
            foot=expected.copy(),
        )
        self.prints = np.where(landed[..., None], soles, self.prints)
        self.airborne = np.where(touching, 0, self.airborne + 1)
        self.highest = np.where(touching, 0.0, np.maximum(self.highest, clearance))
        self._begin_step(completed, apart, knees)
        stance = forces[index, 1 - self.expected]
        self.force = np.where(completed, stance, np.maximum(self.force, stance))
        return report

    def _begin_step(self, struck: np.ndarray, vector: np.ndarray, knees: np.ndarray) -> None:
        column = struck[:, None]
        self.stride_vector = np.where(column, self.step_vector, self.stride_vector)
        self.step_vector = np.where(column, -vector, self.step_vector)
        self.expected = np.where(struck, 1 - self.expected, self.expected)
        self.clock = np.where(struck, 0, self.clock)
        self.first_step = self.first_step & ~struck
        self.knee_min = np.where(column, knees, self.knee_min)
        self.knee_max = np.where(column, knees, self.knee_max)

    def observe(self, course: np.ndarray) -> np.ndarray:
        """Return what the policy observes of the current step.

        Args:
            course: (N,) direction that counts as forward, counter-clockwise from +x [rad].

        Returns:
            (N, 11): one-hot of the expected foot 2, smallest and largest angle of each knee since the step began 4
            [rad], start vectors of the step and of the stride along and across the course 4 [m], time since the last
            strike / step_max 1, up to 2.
        """
        vectors = rotate_to_course(np.stack([self.step_vector, self.stride_vector], axis=1), course)
        onehot = np.stack([self.expected == 0, self.expected == 1], axis=1)
        timer = np.minimum(self.clock * CONTROL_STEP / self.step_max, 2.0)
        starts = vectors.reshape(-1, 4)
        return np.concatenate([onehot, self.knee_min, self.knee_max, starts, timer[:, None]], axis=1)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return every per-env array by name, for checkpoints."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
