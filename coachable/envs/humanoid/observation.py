"""The humanoid's observation: the suite's 67 numbers, the pelvis orientation and the gait, relative to the course."""

import numpy as np

from coachable.envs.humanoid.model import EXTREMITIES, JOINTS, MOTORS
from coachable.envs.humanoid.simulation import Kinematics
from coachable.signals import Signal

VELOCITY_SCALE = 0.1  # brings joint velocities (tens of rad/s) to the size of the rest
_METRES, _TURNS = f"{1 / VELOCITY_SCALE:g} m/s", f"{1 / VELOCITY_SCALE:g} rad/s"
_AXES = ("forward", "left", "up")  # of the course, or of the torso's own frame
OBSERVATION_GROUPS = (
    Signal("joint_angles", 21, "rad", JOINTS),
    Signal("head_height", 1, "m"),
    Signal("extremities", 12, "m", tuple(f"{body}_{axis}" for body in EXTREMITIES for axis in _AXES)),
    Signal("torso_vertical", 3, "", ("of_forward_axis", "of_left_axis", "of_up_axis")),
    Signal("com_velocity", 3, "m/s", _AXES),
    Signal(
        "velocity",
        27,
        (*[_METRES] * 3, *[_TURNS] * 24),
        (*(f"root_{axis}" for axis in _AXES), *(f"root_turn_{axis}" for axis in "xyz"), *JOINTS),
    ),
    Signal("pelvis_orientation", 4, "", ("w", "x", "y", "z")),
    Signal("expected_foot", 2, "", ("right", "left")),
    Signal("knee_range", 4, "rad", ("smallest_right", "smallest_left", "largest_right", "largest_left")),
    Signal("step_start", 2, "m", ("forward", "left")),
    Signal("stride_start", 2, "m", ("forward", "left")),
    Signal("step_timer", 1, "longest step"),
)
"""Blocks of the observation, in order; vectors are relative to the course."""

ACTION_GROUPS = (Signal("motors", len(MOTORS), tuple(f"{torque} N m" for torque in MOTORS.values()), tuple(MOTORS)),)

OBSERVATION_SIZE = sum(group.width for group in OBSERVATION_GROUPS)
OBSERVATION_SCALE = np.concatenate(
    [np.full(group.width, VELOCITY_SCALE if group.name == "velocity" else 1.0) for group in OBSERVATION_GROUPS]
)


def rotate_to_course(vectors: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Return the components of horizontal vectors along and across the course.

    Args:
        vectors: (N, ..., 2 or 3) world x, y (and z, which is left out).
        course: (N,) direction that counts as forward, counter-clockwise from +x [rad].

    Returns:
        (N, ..., 2) along the course and to its left.
    """
    shape = (-1,) + (1,) * (vectors.ndim - 2)
    cosine, sine = np.cos(course).reshape(shape), np.sin(course).reshape(shape)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x], axis=-1)


def _orientation_to_course(quaternion: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Return unit quaternions (N, 4) relative to the course (N,) [rad], with w >= 0, which makes them unique."""
    half = 0.5 * course
    cosine, sine = np.cos(half), np.sin(half)
    w, x, y, z = quaternion.T
    relative = np.stack(
        [cosine * w + sine * z, cosine * x + sine * y, cosine * y - sine * x, cosine * z - sine * w], axis=1
    )
    return np.where(relative[:, :1] < 0, -relative, relative)


def cosine_to_course(quaternion: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Return the cosine between the forward axis of bodies and the course.

    Args:
        quaternion: (N, 4) unit quaternions in the world's frame.
        course: (N,) direction of the course [rad].

    Returns:
        (N,) in [-1, 1].
    """
    _, _, y, z = _orientation_to_course(quaternion, course).T
    return 1.0 - 2.0 * (y * y + z * z)


def suite_observation(
    positions: np.ndarray, velocities: np.ndarray, kinematics: Kinematics, course: np.ndarray
) -> np.ndarray:
    """Return the 67 numbers of dm_control's humanoid, with horizontal velocities along and across the course.

    With the course along +x they equal the suite's own.

    Args:
        positions: (N, 28) generalised positions.
        velocities: (N, 27) generalised velocities.
        kinematics: geometry of the same N states.
        course: (N,) [rad].

    Returns:
        (N, 67) unscaled, float64.
    """
    relative = kinematics.extremities - kinematics.torso_position[:, None]
    extremities = np.einsum("nki,nij->nkj", relative, kinematics.torso_axes)
    com_velocity = kinematics.com_velocity.copy()
    com_velocity[:, :2] = rotate_to_course(com_velocity, course)
    velocity = velocities.copy()
    velocity[:, :2] = rotate_to_course(velocity[:, :2], course)
    return np.concatenate(
        [
            positions[:, 7:],
            kinematics.head_height[:, None],
            extremities.reshape(len(positions), 12),
            kinematics.torso_axes[:, 2],
            com_velocity,
            velocity,
        ],
        axis=1,
    )


def observe(
    positions: np.ndarray, velocities: np.ndarray, kinematics: Kinematics, course: np.ndarray, gait: np.ndarray
) -> np.ndarray:
    """Return the scaled observation (N, 82) float32.

    Args:
        positions: (N, 28) generalised positions.
        velocities: (N, 27) generalised velocities.
        kinematics: geometry of the same N states.
        course: (N,) [rad].
        gait: (N, 11) from `GaitTracker.observe`.
    """
    suite = suite_observation(positions, velocities, kinematics, course)
    pelvis = _orientation_to_course(kinematics.pelvis_quaternion, course)
    values = np.concatenate([suite, pelvis, gait], axis=1) * OBSERVATION_SCALE
    return values.astype(np.float32)
