"""Mirror maps of racing's observations and actions, for its left-right symmetry.

The mirror is a vertical plane: it turns left into right, and a circuit into another one. Wheels and edges of the track
swap sides, and quantities that point to the left change their sign. Task reward, style features and events have no
side, so that they stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

from tensordict import NestedKey

from coachable.envs.racing.env import RacingEnv
from coachable.envs.racing.race.observation import ACTION_GROUPS
from coachable.signals import Signal
from coachable.transforms.mirror import MirrorMap

# Patterns of the entries whose sign changes, by block. Blocks without such entries are listed, too, because others are
# refused.
_TURNED: dict[str, tuple[str, ...]] = {
    "motion": ("left_speed", "yaw_rate", "left_acceleration"),
    "tyre_load": (),
    "slip_ratio": (),
    "slip_angle": ("*",),
    "place": ("left_of_middle", "heading_sine"),
    "flags": (),
    "controls": ("wheel_angle", "steering", "steering_before"),
    "powertrain": (),
    "tyre_heat": (),
    "tyre_wear": (),
    "tyre_grip": (),
    "fuel": (),
    "compound": (),
    "car": (),
    "course": ("*_edge_left_*",),
    "curvature": ("*",),
    "opponents": ("left_*", "heading_sine_*"),
    "slipstream": (),
}
_SIDES = (("front_left", "front_right"), ("rear_left", "rear_right"), ("left_edge", "right_edge"))


def racing_mirror_maps(env: RacingEnv) -> dict[NestedKey, MirrorMap]:
    """Return the mirror maps of a stored transition by key, for `MirrorSymmetry`.

    Args:
        env: Environment whose options decide what the observation has.

    Raises:
        ValueError: If the observation has the place on the lap, or a block that `mirror_map` does not know.
    """
    if not any(group.name == "curvature" for group in env.observation_groups):
        raise ValueError(
            "mirror images need env.curvature=true: without it the observation has the place on the lap (lap_sine, "
            "lap_cosine), which the mirrored circuit does not have. Set env.curvature=true or mirror=0"
        )
    observation = mirror_map(env.observation_groups)
    return {"observation": observation, ("next", "observation"): observation, "action": mirror_map(ACTION_GROUPS)}


def mirror_map(groups: Sequence[Signal]) -> MirrorMap:
    """Return the mirror map of adjacent blocks of an observation or an action, from the names of their entries.

    Raises:
        ValueError: If it is not known how a block looks in the mirror.

    Example:
        >>> wheels = Signal("slip_angle", 2, "", ("front_left", "front_right"))
        >>> mirror_map([Signal("fuel", 1), wheels])
        MirrorMap(source=(0, 2, 1), sign=(1.0, -1.0, -1.0))
    """
    source: list[int] = []
    sign: list[float] = []
    for group in groups:
        if group.name not in _TURNED:
            raise ValueError(
                f"block {group.name!r} of the observation has no mirror image: expected one of "
                f"{', '.join(_TURNED)}. Add it to mirror_maps.py or set mirror=0"
            )
        first, entries = len(source), group.entries or (group.name,)
        for entry in entries:
            source.append(first + entries.index(_other_side(entry)))
            sign.append(-1.0 if any(fnmatchcase(entry, pattern) for pattern in _TURNED[group.name]) else 1.0)
    return MirrorMap(tuple(source), tuple(sign))


def _other_side(entry: str) -> str:
    """Return the name of the entry that an entry swaps with, or the entry itself."""
    for left, right in _SIDES:
        if left in entry or right in entry:
            return entry.replace(left, right) if left in entry else entry.replace(right, left)
    return entry
