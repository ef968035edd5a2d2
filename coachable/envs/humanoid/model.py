"""MuJoCo models of the DeepMind Control humanoid, and where its quantities lie in the state.

Two compiled models share the suite's body. The *dynamics* model integrates; its only sensors are the forces under the
feet, because the suite's force sensors alone cost a pass of inverse dynamics per physics step. The *kinematics* model
has only the sensors that our features need and every force switched off, so that one cheap step of it reads the
geometry of any state.
"""

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import mujoco
import numpy as np

PHYSICS_STEP = 0.005  # [s], as in the suite
PHYSICS_STEPS_PER_CONTROL = 5
CONTROL_STEP = PHYSICS_STEP * PHYSICS_STEPS_PER_CONTROL  # [s]

NUM_ACTIONS = 21
NUM_POSITIONS = 28  # free joint 7 + 21 hinges
NUM_VELOCITIES = 27

# In the order of the state and of the actions, which differ.
JOINTS = (
    "abdomen_z",
    "abdomen_y",
    "abdomen_x",
    *(f"right_{joint}" for joint in ("hip_x", "hip_z", "hip_y", "knee", "ankle_y", "ankle_x")),
    *(f"left_{joint}" for joint in ("hip_x", "hip_z", "hip_y", "knee", "ankle_y", "ankle_x")),
    *(f"right_{joint}" for joint in ("shoulder1", "shoulder2", "elbow")),
    *(f"left_{joint}" for joint in ("shoulder1", "shoulder2", "elbow")),
)
_LEG_MOTORS = {"hip_x": 40, "hip_z": 40, "hip_y": 120, "knee": 80, "ankle_x": 20, "ankle_y": 20}
_ARM_MOTORS = {"shoulder1": 20, "shoulder2": 20, "elbow": 40}
MOTORS = {
    **{"abdomen_y": 40, "abdomen_z": 40, "abdomen_x": 40},
    **{f"{side}_{joint}": torque for side in ("right", "left") for joint, torque in _LEG_MOTORS.items()},
    **{f"{side}_{joint}": torque for side in ("right", "left") for joint, torque in _ARM_MOTORS.items()},
}
"""Torque of each motor at full command [N m]."""

ARM_JOINTS = (
    "right_shoulder1",
    "right_shoulder2",
    "right_elbow",
    "left_shoulder1",
    "left_shoulder2",
    "left_elbow",
)
KNEE_JOINTS = ("right_knee", "left_knee")
FEET = ("right_foot", "left_foot")
# The suite lists the end effectors in this order.
EXTREMITIES = ("left_hand", "left_foot", "right_hand", "right_foot")

# End points of the two capsules of each foot in the foot's frame [m], and their radius: from the suite's MJCF.
_FOOT_CAPSULES = {
    "right_foot": ((-0.07, -0.02), (0.14, -0.04), (-0.07, 0.0), (0.14, 0.02)),
    "left_foot": ((-0.07, 0.02), (0.14, 0.04), (-0.07, 0.0), (0.14, -0.02)),
}
FOOT_RADIUS = 0.027  # [m]
HEEL, TOE = -0.07, 0.14  # [m], ends of the capsules along the foot

_INCLUDES = ("materials", "skybox", "visual")

_FULL_PHYSICS = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)


@dataclass(frozen=True)
class HumanoidModel:
    """Compiled models and the addresses that the simulation reads.

    Attributes:
        dynamics: model that integrates; its sensors are the normal forces under the right and the left foot [N].
        kinematics: model whose sensors are the geometry of a state, without forces.
        sensors: name to slice of the kinematics model's sensor vector.
        weight: weight of the body [N].
        torques: (21,) torque of each motor at full command [N m].
        motor_velocities: (21,) addresses in qvel of the joints that the motors turn.
        arm_positions: addresses of the six arm joints in qpos, in the order of `ARM_JOINTS`.
        knee_positions: addresses of the right and left knee in qpos.
        arm_ranges: (6, 2) joint limits of the arms [rad].
        foot_points: (2, 4, 2) capsule end points of each foot in its own frame [m].
    """

    dynamics: mujoco.MjModel
    kinematics: mujoco.MjModel
    sensors: dict[str, slice]
    weight: float
    torques: np.ndarray
    motor_velocities: np.ndarray
    arm_positions: np.ndarray
    knee_positions: np.ndarray
    arm_ranges: np.ndarray
    foot_points: np.ndarray


def load_spec() -> mujoco.MjSpec:
    """Return the suite's humanoid as an editable specification."""
    suite = files("dm_control") / "suite"  # read as files: importing the suite loads every task and SciPy
    common = {f"common/{name}.xml": (suite / "common" / f"{name}.xml").read_bytes() for name in _INCLUDES}
    # dm_control prefixes its includes with "./", which MjSpec does not resolve.
    text = (suite / "humanoid.xml").read_text().replace('"./common/', '"common/')
    return mujoco.MjSpec.from_string(text, include=common)


def dynamics_spec() -> mujoco.MjSpec:
    """Return the specification of the model that integrates."""
    spec = _without_sensors()
    for foot in FEET:  # a sphere around the foot: a touch sensor adds up the contacts of its body within its site
        spec.body(foot).add_site(name=foot, pos=((HEEL + TOE) / 2, 0, 0), size=(0.2, 0, 0))
        spec.add_sensor(name=foot, type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=foot)
    return spec


def kinematics_spec() -> mujoco.MjSpec:
    """Return the specification of the model whose sensors are the geometry of a state, without forces."""
    spec = _without_sensors()
    _add_sensors(spec)
    bits = mujoco.mjtDisableBit
    spec.option.disableflags |= int(
        bits.mjDSBL_CONSTRAINT | bits.mjDSBL_CONTACT | bits.mjDSBL_ACTUATION | bits.mjDSBL_GRAVITY
    )
    return spec


def _without_sensors() -> mujoco.MjSpec:
    spec = load_spec()
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    # Without auto-reset a diverging state stays visible instead of turning silently into the initial one.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return spec


@cache
def build_model() -> HumanoidModel:
    """Compile the dynamics and kinematics models, once for all simulations of a process: only states change."""
    dynamics, kinematics = dynamics_spec().compile(), kinematics_spec().compile()
    sensors = {
        kinematics.sensor(i).name: slice(
            int(kinematics.sensor_adr[i]), int(kinematics.sensor_adr[i] + kinematics.sensor_dim[i])
        )
        for i in range(kinematics.nsensor)
    }
    return HumanoidModel(
        dynamics=dynamics,
        kinematics=kinematics,
        sensors=sensors,
        weight=float(dynamics.body_mass.sum() * np.linalg.norm(dynamics.opt.gravity)),
        torques=dynamics.actuator_gear[:, 0].copy(),
        motor_velocities=dynamics.jnt_dofadr[dynamics.actuator_trnid[:, 0]].copy(),
        arm_positions=_positions(dynamics, ARM_JOINTS),
        knee_positions=_positions(dynamics, KNEE_JOINTS),
        arm_ranges=np.stack([dynamics.joint(name).range for name in ARM_JOINTS]),
        foot_points=np.array([_FOOT_CAPSULES[foot] for foot in FEET]),
    )


def state_size(model: mujoco.MjModel) -> int:
    """Length of the full physics state: time, qpos, qvel."""
    return mujoco.mj_stateSize(model, _FULL_PHYSICS)


def _positions(model: mujoco.MjModel, joints: tuple[str, ...]) -> np.ndarray:
    return np.array([int(model.joint(name).qposadr[0]) for name in joints])


def _add_sensors(spec: mujoco.MjSpec) -> None:
    kinds = mujoco.mjtSensor
    requests = [("com_velocity", kinds.mjSENS_SUBTREELINVEL, "torso")]
    requests += [("pelvis_quaternion", kinds.mjSENS_FRAMEQUAT, "pelvis")]
    for body in ("torso", "head", *EXTREMITIES):
        requests.append((f"{body}_position", kinds.mjSENS_FRAMEPOS, body))
    for axis, kind in (
        ("x", kinds.mjSENS_FRAMEXAXIS),
        ("y", kinds.mjSENS_FRAMEYAXIS),
        ("z", kinds.mjSENS_FRAMEZAXIS),
    ):
        requests.append((f"torso_{axis}_axis", kind, "torso"))
        if axis != "z":
            requests += [(f"{foot}_{axis}_axis", kind, foot) for foot in FEET]
    for name, kind, body in requests:
        # Subtree sensors attach to a body, frame sensors to the body's own frame ("xbody", not its inertial frame).
        target = mujoco.mjtObj.mjOBJ_BODY if kind == kinds.mjSENS_SUBTREELINVEL else mujoco.mjtObj.mjOBJ_XBODY
        spec.add_sensor(name=name, type=kind, objtype=target, objname=body)
