"""Gait bookkeeping: which foot must strike next, and what the step that ended was like."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from coachable.envs.humanoid.model import CONTROL_STEP

# A foot counts as touching the floor when its lowest point is below this height [m].
CONTACT_HEIGHT = 0.001


@dataclass
class StepReport:
    """What happened in one control step, per env.

    Attributes:
        completed: (N,) bool, the expected foot struck.
        length: (N,) distance along the course between the striking foot and the other one [m]; 0 without a strike.
        duration: (N,) time since the previous strike [s]; 0 without a strike.
        stride_fraction: (N,) share of this step in the stride, i.e. in the sum of this step and the previous one.
            0 where either did not go forward; 1/2 for the first step of an episode, which has no stride yet.
        knee_min: (N,) smallest knee angle of both legs during the step [rad].
        knee_max: (N,) largest one [rad].
        timed_out: (N,) bool, no strike for longer than `step_max`.
    """

    completed: np.ndarray
    length: np.ndarray
    duration: np.ndarray
    stride_fraction: np.ndarray
    knee_min: np.ndarray
    knee_max: np.ndarray
    timed_out: np.ndarray


@dataclass
class GaitTracker:
    """State of the gait of N walkers. Index 0 is the right foot, 1 the left one.

    Attributes:
        expected: (N,) index of the foot that must strike next.
        clock: (N,) control steps since the last strike.
        lifted: (N,) bool, the expected foot has left the floor since the last strike.
        first_step: (N,) bool, no strike yet in this episode.
        knee_min: (N, 2) smallest angle of each knee since the step began [rad].
        knee_max: (N, 2) largest one [rad].
        step_vector: (N, 2) (x, y) of the foot to strike relative to the other one when the step began, along and across
            the course [m].
        stride_vector: (N, 2) the same when the stride began, one step earlier [m].
        step_max: time without a strike after which a step counts as timed out [s].
    """

    expected: np.ndarray
    clock: np.ndarray
    lifted: np.ndarray
    first_step: np.ndarray
    knee_min: np.ndarray
    knee_max: np.ndarray
    step_vector: np.ndarray
    stride_vector: np.ndarray
    step_max: float

    @classmethod
    def create(cls, num_envs: int, step_max: float) -> GaitTracker:
        """Return a tracker of `num_envs` walkers that have not started."""
        return cls(
            expected=np.zeros(num_envs, dtype=np.int64),
            clock=np.zeros(num_envs, dtype=np.int64),
            lifted=np.zeros(num_envs, dtype=bool),
            first_step=np.ones(num_envs, dtype=bool),
            knee_min=np.zeros((num_envs, 2)),
            knee_max=np.zeros((num_envs, 2)),
            step_vector=np.zeros((num_envs, 2)),
            stride_vector=np.zeros((num_envs, 2)),
            step_max=step_max,
        )

    def reset(self, rows: np.ndarray, expected: np.ndarray, feet: np.ndarray, knees: np.ndarray) -> None:
        """Start an episode in `rows`.

        Args:
            rows: (M,) indices of the envs.
            expected: (M,) foot that must strike first.
            feet: (M, 2, 2) foot positions along and across the course [m].
            knees: (M, 2) knee angles [rad].
        """
        index = np.arange(len(rows))
        self.expected[rows] = expected
        self.clock[rows] = 0
        self.lifted[rows] = False
        self.first_step[rows] = True
        self.knee_min[rows] = knees
        self.knee_max[rows] = knees
        self.step_vector[rows] = feet[index, expected] - feet[index, 1 - expected]
        self.stride_vector[rows] = self.step_vector[rows]

    def update(self, feet: np.ndarray, clearance: np.ndarray, knees: np.ndarray) -> StepReport:
        """Update the gait by one control step.

        Args:
            feet: (N, 2, 2) foot positions along and across the course [m].
            clearance: (N, 2) height of the lowest point of each foot [m].
            knees: (N, 2) knee angles [rad].
        """
        index = np.arange(len(self.expected))
        self.clock += 1
        np.minimum(self.knee_min, knees, out=self.knee_min)
        np.maximum(self.knee_max, knees, out=self.knee_max)
        touching = clearance < CONTACT_HEIGHT
        expected_touches = touching[index, self.expected]
        completed = self.lifted & expected_touches
        self.lifted |= ~expected_touches

        vector = feet[index, self.expected] - feet[index, 1 - self.expected]
        length = vector[:, 0]
        # The other foot struck last: the length of its step, which began the stride, is minus our start vector.
        previous = -self.step_vector[:, 0]
        stride = length + previous
        forward = (length > 0) & (previous > 0)
        fraction = np.where(forward, length / np.where(forward, stride, 1.0), 0.0)
        fraction = np.where(self.first_step, np.where(length > 0, 0.5, 0.0), fraction)
        report = StepReport(
            completed=completed,
            length=np.where(completed, length, 0.0),
            duration=np.where(completed, self.clock * CONTROL_STEP, 0.0),
            stride_fraction=np.where(completed, fraction, 0.0),
            knee_min=self.knee_min.min(axis=1),
            knee_max=self.knee_max.max(axis=1),
            timed_out=~completed & (self.clock * CONTROL_STEP > self.step_max),
        )
        self._begin_step(completed, vector, touching, knees, index)
        return report

    def _begin_step(
        self, struck: np.ndarray, vector: np.ndarray, touching: np.ndarray, knees: np.ndarray, index: np.ndarray
    ) -> None:
        column = struck[:, None]
        self.stride_vector = np.where(column, self.step_vector, self.stride_vector)
        self.step_vector = np.where(column, -vector, self.step_vector)
        self.expected = np.where(struck, 1 - self.expected, self.expected)
        self.lifted = np.where(struck, ~touching[index, self.expected], self.lifted)
        self.clock = np.where(struck, 0, self.clock)
        self.first_step = self.first_step & ~struck
        self.knee_min = np.where(column, knees, self.knee_min)
        self.knee_max = np.where(column, knees, self.knee_max)

    def observe(self) -> np.ndarray:
        """Return what the policy observes of the step under way.

        Returns:
            (N, 11): one-hot of the expected foot 2, smallest and largest angle of each knee since the step began 4
            [rad], start vectors of the step and of the stride 4 [m], time since the last strike / step_max 1, up to 2.
        """
        onehot = np.eye(2)[self.expected]
        timer = np.minimum(self.clock * CONTROL_STEP / self.step_max, 2.0)
        return np.concatenate(
            [onehot, self.knee_min, self.knee_max, self.step_vector, self.stride_vector, timer[:, None]], axis=1
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Return every per-env array by name, for checkpoints."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
