"""Batched physics of the humanoid: N states stepped in one call by `mujoco.rollout`."""

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout

from coachable.envs.humanoid.model import (
    EXTREMITIES,
    FEET,
    FOOT_RADIUS,
    HEEL,
    NUM_ACTIONS,
    NUM_POSITIONS,
    NUM_VELOCITIES,
    PHYSICS_STEPS_PER_CONTROL,
    TOE,
    HumanoidModel,
    build_model,
    state_size,
)

# Beyond this speed of any degree of freedom [m/s, rad/s] the integration has left the physical regime.
_EXPLODED = 1e3


_CONTROL_SPEC = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)


@dataclass
class Kinematics:
    """Geometry of N states in the world frame, float64.

    Attributes:
        torso_axes: (N, 3, 3) columns are the torso's axes in the world, i.e. MuJoCo's `xmat`.
        torso_position: (N, 3) [m].
        head_height: (N,) [m].
        extremities: (N, 4, 3) positions of left hand, left foot, right hand, right foot [m].
        feet: (N, 2, 3) positions of the right and left foot [m].
        foot_clearance: (N, 2) height of the lowest point of each foot above the floor [m]; negative in contact.
        foot_pitch: (N, 2) pitch of each foot, positive with the toes down [rad].
        soles: (N, 2, 2) x and y of the middle of each sole once the foot lies flat around its lowest end [m].
        com_velocity: (N, 3) [m/s].
        pelvis_quaternion: (N, 4) w, x, y, z.
    """

    torso_axes: np.ndarray
    torso_position: np.ndarray
    head_height: np.ndarray
    extremities: np.ndarray
    feet: np.ndarray
    foot_clearance: np.ndarray
    foot_pitch: np.ndarray
    soles: np.ndarray
    com_velocity: np.ndarray
    pelvis_quaternion: np.ndarray


def read_kinematics(readings: np.ndarray, model: HumanoidModel) -> Kinematics:
    """Return the geometry of M states from the sensors (M, S) of the kinematics model.

    Args:
        readings: (M, S) sensors of the kinematics model.
        model: The model, which knows where each sensor is.

    Returns:
        Geometry of the M states.
    """

    def read(name: str) -> np.ndarray:
        return readings[:, model.sensors[name]]

    feet = np.stack([read(f"{foot}_position") for foot in FEET], axis=1)
    # Height of the capsule end points: position + x * (x axis)_z + y * (y axis)_z.
    axis_x = np.stack([read(f"{foot}_x_axis") for foot in FEET], axis=1)
    axis_y = np.stack([read(f"{foot}_y_axis")[:, 2] for foot in FEET], axis=1)
    points = model.foot_points  # (2, 4, 2)
    heights = axis_x[..., 2:] * points[..., 0] + axis_y[..., None] * points[..., 1]
    # What touches the ground first stays where it is while the rest of the foot comes down around it.
    end = np.where(axis_x[..., 2] < 0, TOE, HEEL)[..., None]
    ahead = axis_x[..., :2]
    level = ahead / np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), 1e-6)
    soles = feet[..., :2] + end * ahead + ((HEEL + TOE) / 2 - end) * level
    return Kinematics(
        torso_axes=np.stack([read(f"torso_{axis}_axis") for axis in "xyz"], axis=-1),
        torso_position=read("torso_position"),
        head_height=read("head_position")[:, 2],
        extremities=np.stack([read(f"{limb}_position") for limb in EXTREMITIES], axis=1),
        feet=feet,
        foot_clearance=feet[..., 2] + heights.min(axis=-1) - FOOT_RADIUS,
        foot_pitch=-np.arcsin(np.clip(axis_x[..., 2], -1.0, 1.0)),
        soles=soles,
        com_velocity=read("com_velocity"),
        pelvis_quaternion=read("pelvis_quaternion"),
    )


class HumanoidSimulation:
    """N humanoids as one array of MuJoCo states.

    `mujoco.rollout` reports the sensors of the state *before* its last integration, while dm_control leaves derived
    quantities up to date. `kinematics` therefore evaluates the current state with one step of the force-free model,
    which costs about a twentieth of a control step.

    Args:
        num_envs: N.
        num_threads: threads of the physics; 0 steps on the calling thread.
    """

    def __init__(self, num_envs: int, num_threads: int = 0) -> None:
        self.num_envs = num_envs
        self.num_threads = num_threads
        self.model: HumanoidModel = build_model()
        workers = max(1, num_threads)
        self._dynamics_data = [mujoco.MjData(self.model.dynamics) for _ in range(workers)]
        self._kinematics_data = [mujoco.MjData(self.model.kinematics) for _ in range(workers)]
        self._rollout = rollout.Rollout(nthread=num_threads)
        self.state = np.zeros((num_envs, state_size(self.model.dynamics)))
        self.state[:, 1 : 1 + NUM_POSITIONS] = self.model.dynamics.qpos0
        self._states_out = np.zeros((num_envs, PHYSICS_STEPS_PER_CONTROL, self.state.shape[1]))
        self._controls = np.zeros((num_envs, PHYSICS_STEPS_PER_CONTROL, NUM_ACTIONS + NUM_VELOCITIES))
        self._forces = np.zeros((num_envs, PHYSICS_STEPS_PER_CONTROL, len(FEET)))

    @property
    def positions(self) -> np.ndarray:
        """Generalised positions (N, 28), a view of the state."""
        return self.state[:, 1 : 1 + NUM_POSITIONS]

    @property
    def velocities(self) -> np.ndarray:
        """Generalised velocities (N, 27), a view of the state."""
        return self.state[:, 1 + NUM_POSITIONS : 1 + NUM_POSITIONS + NUM_VELOCITIES]

    def step(self, actions: np.ndarray, push: np.ndarray | float = 0.0) -> np.ndarray:
        """Advance every state by one control step.

        Args:
            actions: (N, 21) motor commands; MuJoCo clips them to [-1, 1].
            push: (N, 3) force on the torso in the world frame [N].

        Returns:
            (N,) True where the integration diverged. Those states are left as they were before the step.
        """
        self._controls[..., :NUM_ACTIONS] = actions[:, None, :]
        self._controls[..., NUM_ACTIONS : NUM_ACTIONS + 3] = np.asarray(push)[..., None, :] if np.ndim(push) else push
        self._rollout.rollout(
            self.model.dynamics,
            self._dynamics_data,
            self.state,
            self._controls,
            state=self._states_out,
            sensordata=self._forces,
            control_spec=_CONTROL_SPEC,
            skip_checks=False,
        )
        after = self._states_out[:, -1]
        finite = np.isfinite(after).all(axis=1)
        speeds = after[:, 1 + NUM_POSITIONS : 1 + NUM_POSITIONS + NUM_VELOCITIES]
        diverged = ~(finite & (np.abs(speeds).max(axis=1) < _EXPLODED))
        if diverged.any():
            self.state[~diverged] = after[~diverged]
        else:
            self.state[:] = after
        return diverged

    def forces(self) -> np.ndarray:
        """Return the largest normal force under each foot in the last control step (N, 2), in body weights."""
        return np.nan_to_num(self._forces.max(axis=1)) / self.model.weight

    def power(self) -> np.ndarray:
        """Return the mechanical power of the motors (N,), the mean of `sum |torque * speed|` over a step [W]."""
        first = 1 + NUM_POSITIONS
        speeds = self._states_out[..., first + self.model.motor_velocities]
        torques = np.clip(self._controls[..., :NUM_ACTIONS], -1.0, 1.0) * self.model.torques
        return np.nan_to_num(np.abs(torques * speeds).sum(axis=-1).mean(axis=1))

    def kinematics(self, rows: np.ndarray | None = None) -> Kinematics:
        """Return the geometry of the current states, or of some rows of them.

        Args:
            rows: Numbers of M rows (M,) int; None for all N.

        Returns:
            Geometry of M or N states.
        """
        states = self.state if rows is None else np.ascontiguousarray(self.state[rows])
        return self.kinematics_of(states)

    def kinematics_of(self, states: np.ndarray) -> Kinematics:
        """Return the geometry of any (M, nstate) states."""
        _, readings = self._rollout.rollout(self.model.kinematics, self._kinematics_data, states, nstep=1)
        return read_kinematics(readings[:, 0], self.model)

    def count_contacts(self, state: np.ndarray) -> int:
        """Return the number of contacts of one state (S,), for the search for collision-free postures."""
        data = self._dynamics_data[0]
        mujoco.mj_setState(self.model.dynamics, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_fwdPosition(self.model.dynamics, data)
        return data.ncon

    def close(self) -> None:
        """Stop the physics threads."""
        self._rollout.close()
