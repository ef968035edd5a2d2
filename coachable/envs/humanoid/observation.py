"""The humanoid's observation: the suite's 67 numbers, the pelvis orientation and the gait, relative to the course."""

from __future__ import annotations

import numpy as np

from coachable.envs.humanoid.simulation import Kinematics

# Name, width and scale of each group, in order. Scales bring joint velocities (tens of rad/s) to the size of the rest.
OBSERVATION_GROUPS: tuple[tuple[str, int, float], ...] = (
    ("joint_angles", 21, 1.0),
    ("head_height", 1, 1.0),
    ("extremities", 12, 1.0),
    ("torso_vertical", 3, 1.0),
    ("com_velocity", 3, 1.0),
    ("velocity", 27, 0.1),
    ("pelvis_orientation", 4, 1.0),
    ("expected_foot", 2, 1.0),
    ("knee_range", 4, 1.0),
    ("step_start", 2, 1.0),
    ("stride_start", 2, 1.0),
    ("step_timer", 1, 1.0),
)
OBSERVATION_SIZE = sum(width for _, width, _ in OBSERVATION_GROUPS)
OBSERVATION_SCALE = np.concatenate([np.full(width, scale) for _, width, scale in OBSERVATION_GROUPS])


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


def orientation_to_course(quaternion: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (N, 4) of an orientation relative to the course, with w >= 0 to make it unique."""
    half = 0.5 * course
    cosine, sine = np.cos(half), np.sin(half)
    w, x, y, z = quaternion.T
    relative = np.stack(
        [cosine * w + sine * z, cosine * x + sine * y, cosine * y - sine * x, cosine * z - sine * w], axis=1
    )
    return np.where(relative[:, :1] < 0, -relative, relative)


def cosine_to_course(quaternion: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Return the cosine (N,) between the forward axis of bodies of the given orientations (N, 4) and the course."""
    _, _, y, z = orientation_to_course(quaternion, course).T
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
    pelvis = orientation_to_course(kinematics.pelvis_quaternion, course)
    values = np.concatenate([suite, pelvis, gait], axis=1) * OBSERVATION_SCALE
    return values.astype(np.float32)
