"""Mirror maps of racing's observations and actions, for its left-right symmetry.

The mirror is a vertical plane: it turns left into right, and a circuit into another one. Wheels and edges of the track
swap sides, and quantities that point to the left change their sign. Task reward, style features and events have no
side, so that they stay as they are.
"""

from tensordict import NestedKey

from coachable.envs.racing.env import RacingEnv
from coachable.envs.racing.race.observation import ACTION_GROUPS
from coachable.transforms.mirror import MirrorMap, mirror_map

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
    observation, action = mirror_map(env.observation_groups, _TURNED), mirror_map(ACTION_GROUPS, _TURNED)
    return {"observation": observation, ("next", "observation"): observation, "action": action}
