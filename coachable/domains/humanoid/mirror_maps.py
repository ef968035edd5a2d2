"""Mirror maps of the humanoid's observations, actions and style features, for its left-right symmetry.

The mirror is the vertical plane through the course. It reverses y and rotations about x and z. Joints swap sides. Their
signs stay the same if the axis on one side is the mirror image of that on the other (hips, knees, elbows), and change
otherwise (shoulders, ankle_x).
"""

from coachable.envs.humanoid.features import NUM_ARM_JOINTS, STYLE_FEATURES_SIZE, STYLED_SPEED_SIZE
from coachable.envs.humanoid.model import ARM_JOINTS
from coachable.envs.humanoid.observation import ACTION_GROUPS, OBSERVATION_GROUPS
from coachable.signals import Signal
from coachable.transforms.mirror import MirrorMap, mirror_map

# Patterns of the entries whose sign changes, by block.
_JOINTS = ("abdomen_z", "abdomen_x", "*_ankle_x", "*_shoulder?")
_TURNED = {
    "joint_angles": _JOINTS,
    "head_height": (),
    "extremities": ("*_left",),
    "torso_vertical": ("of_left_axis",),
    "com_velocity": ("left",),
    "velocity": ("root_left", "root_turn_x", "root_turn_z", *_JOINTS),
    "pelvis_orientation": ("x", "z"),
    "expected_foot": (),
    "knee_range": (),
    "step_start": ("left",),
    "stride_start": ("left",),
    "step_timer": (),
    "motors": _JOINTS,
    "arms": _JOINTS,
    "gait": (),
}
OBSERVATION, ACTION = mirror_map(OBSERVATION_GROUPS, _TURNED), mirror_map(ACTION_GROUPS, _TURNED)


def humanoid_mirror_maps(styled_speed: bool = False) -> dict[str | tuple[str, ...], MirrorMap]:
    """Return the mirror maps of a stored transition of `HumanoidEnv` by key, for `MirrorSymmetry`."""
    size = STYLED_SPEED_SIZE if styled_speed else STYLE_FEATURES_SIZE
    features = (Signal("arms", NUM_ARM_JOINTS, "", ARM_JOINTS), Signal("gait", size - NUM_ARM_JOINTS))
    return {
        "observation": OBSERVATION,
        "action": ACTION,
        ("next", "observation"): OBSERVATION,
        ("next", "style_features"): mirror_map(features, _TURNED),
    }
