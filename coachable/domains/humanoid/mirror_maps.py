"""Mirror maps of the humanoid's observations, actions and style features, for its left-right symmetry.

The mirror is the vertical plane through the course. It reverses y and rotations about x and z. Joints swap sides. Their
signs stay the same if the axis on one side is the mirror image of that on the other (hips, knees, elbows), and change
otherwise (shoulders, ankle_x).
"""

from __future__ import annotations

from coachable.envs.humanoid.features import NUM_ARM_JOINTS, STYLE_FEATURES_SIZE, STYLED_SPEED_SIZE
from coachable.envs.humanoid.observation import OBSERVATION_GROUPS
from coachable.transforms.mirror import MirrorMap

_POLAR, _AXIAL = (1, -1, 1), (-1, 1, -1)  # x, y, z of vectors, and of rotations
# Signs of abdomen z, y, x; of a leg's hip x, z, y, knee, ankle y, x; of an arm's shoulder 1, 2, elbow.
_ABDOMEN, _LEG, _ARM = (-1, 1, -1), (1, 1, 1, 1, 1, -1), (-1, -1, 1)


def _keep(signs: tuple[int, ...]) -> tuple[list[int], list[int]]:
    return list(range(len(signs))), list(signs)


def _swap(signs: tuple[int, ...]) -> tuple[list[int], list[int]]:
    """Return the map of two halves, one per side, that swap."""
    n = len(signs)
    return [*range(n, 2 * n), *range(n)], [*signs, *signs]


def _join(*parts: tuple[list[int], list[int]]) -> tuple[list[int], list[int]]:
    sources: list[int] = []
    signs: list[int] = []
    for source, sign in parts:
        sources += [len(signs) + i for i in source]
        signs += sign
    return sources, signs


_JOINTS = _join(_keep(_ABDOMEN), _swap(_LEG), _swap(_ARM))
_GROUPS = {
    "joint_angles": _JOINTS,
    "head_height": _keep((1,)),
    "extremities": _swap((*_POLAR, *_POLAR)),
    "torso_vertical": _keep(_POLAR),
    "com_velocity": _keep(_POLAR),
    "velocity": _join(_keep(_POLAR), _keep(_AXIAL), _JOINTS),
    "pelvis_orientation": _keep((1, *_AXIAL)),
    "expected_foot": _swap((1,)),
    "knee_range": _join(_swap((1,)), _swap((1,))),
    "step_start": _keep((1, -1)),
    "stride_start": _keep((1, -1)),
    "step_timer": _keep((1,)),
}


def _map(parts: tuple[list[int], list[int]]) -> MirrorMap:
    return MirrorMap(tuple(parts[0]), tuple(float(sign) for sign in parts[1]))


OBSERVATION = _map(_join(*(_GROUPS[group.name] for group in OBSERVATION_GROUPS)))
# The motors' order: abdomen y, z, x; per leg hip x, z, y, knee, ankle x, y; per arm shoulder 1, 2, elbow.
ACTION = _map(_join(_keep((1, -1, -1)), _swap((1, 1, 1, 1, -1, 1)), _swap(_ARM)))
STYLE_FEATURES, STYLED_SPEED_FEATURES = (
    _map(_join(_swap(_ARM), _keep((1,) * (size - NUM_ARM_JOINTS)))) for size in (STYLE_FEATURES_SIZE, STYLED_SPEED_SIZE)
)


def humanoid_mirror_maps(styled_speed: bool = False) -> dict[str | tuple[str, ...], MirrorMap]:
    """Return the mirror maps of a stored transition by key, for `MirrorSymmetry`.

    Args:
        styled_speed: Option of the `HumanoidEnv`.
    """
    return {
        "observation": OBSERVATION,
        "action": ACTION,
        ("next", "observation"): OBSERVATION,
        ("next", "style_features"): STYLED_SPEED_FEATURES if styled_speed else STYLE_FEATURES,
    }
