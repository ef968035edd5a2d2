"""The numbers of a configuration and the ranges in which they make sense."""

from typing import Any

from coachable.ranges import AMOUNT, COUNT, FINITE, NOT_NEGATIVE, POSITIVE, SHARE, Range

# By the end of a number's path in the configuration, so that `gamma` is that of the losses and that of replay; `*` is
# any entry of a list or group. Numbers that are not listed have to be finite.
RANGES: dict[str, Range] = {
    "seed": Range("[0, 4e9]", whole=True),
    "init_new_observations": AMOUNT,
    "init_random_frames": AMOUNT,
    # losses
    "gamma": SHARE,
    "alpha": POSITIVE,
    "alpha_init": POSITIVE,
    "entropy_samples": COUNT,
    "num_quantiles": COUNT,
    "kappa": NOT_NEGATIVE,
    "num_atoms": Range("[2, inf)", whole=True),
    "sigma_ratio": POSITIVE,
    # replay
    "n_steps": COUNT,
    "replay_capacity": COUNT,
    "capacity": COUNT,
    "table_capacities.*": COUNT,
    "event_capacity": COUNT,
    "event_horizon": COUNT,
    "event_share": Range("(0, 1)"),
    "table_proportions.*": SHARE,
    "priority_alpha": NOT_NEGATIVE,
    "priority_beta": NOT_NEGATIVE,
    "mirror": SHARE,
    "impersonation.n": AMOUNT,
    # sampler
    "share": SHARE,
    "neutral": SHARE,
    "independent": SHARE,
    "positive": SHARE,
    "full": SHARE,
    # network
    "widths.*": COUNT,
    "categorical.*": COUNT,
    "axes": AMOUNT,
    "num_critics": COUNT,
    "num_outputs": COUNT,
    "head_gain": NOT_NEGATIVE,
    "dropout": Range("[0, 1)"),
    # learner
    "actor_lr": NOT_NEGATIVE,
    "critic_lr": NOT_NEGATIVE,
    "alpha_lr": NOT_NEGATIVE,
    "adam_eps": POSITIVE,
    "tau": Range("(0, 1]"),
    "max_grad_norm": Range("(0, inf)", optional=True),
    "check_every": AMOUNT,
    # train
    "total_frames": COUNT,
    "batch_size": COUNT,
    "warmup_frames": AMOUNT,
    "utd_ratio": Range("[0, inf)", optional=True),
    "throttle": Range("(0, inf)", optional=True),
    "anneal": SHARE,
    "anneal_entropy": Range("(0, 1]"),
    "eval_interval": AMOUNT,
    "log_interval": NOT_NEGATIVE,
    "checkpoint_interval": NOT_NEGATIVE,
    "max_steps": COUNT,
    "keep": COUNT,
    "threads.*": Range("[1, inf)", whole=True, optional=True),
    "num_collectors": COUNT,
    # env and style_reward
    "num_envs": COUNT,
    "episode_steps": COUNT,
    "seconds": POSITIVE,
    "num_enemies": COUNT,
    "traps": AMOUNT,
    "cars": COUNT,
    "shares.*": SHARE,
    "weights.*": NOT_NEGATIVE,
    "style_reward.margin": POSITIVE,
    "style_reward.*": NOT_NEGATIVE,
}


def range_of(path: tuple[str, ...]) -> Range | None:
    """Range of the number at a path, or None if any finite one makes sense."""
    ends = [".".join(path[i:]) for i in range(len(path))] + [".".join((*path[-2:-1], "*"))]
    return next((RANGES[end] for end in ends if end in RANGES), None)


def checked_numbers(config: dict[str, Any]) -> dict[str, Any]:
    """Check every number of a configuration.

    Args:
        config: Plain containers.

    Returns:
        The same, with whole numbers that were written as `1e6` as integers.

    Raises:
        ValueError: Naming the key, what was given, and the valid range.
    """
    checked = _checked(config, ())
    for group in ("critic_support", "loss", "network.critic"):
        support = _at(checked, group)
        if "v_min" in support and not support["v_min"] < support["v_max"]:
            raise ValueError(f"{group}.v_min={support['v_min']}: expected less than v_max, which is {support['v_max']}")
    for group in ("network.actor", "network.critic"):
        if _at(checked, group).get("widths") == []:
            raise ValueError(f"{group}.widths=[]: expected the width of one layer at least")
    return checked


def _checked(value: Any, path: tuple[str, ...]) -> Any:
    if isinstance(value, dict):
        return {key: _checked(entry, (*path, str(key))) for key, entry in value.items()}
    if isinstance(value, list):
        return [_checked(entry, (*path, "*")) for entry in value]
    expected = None if path[-1] == "_target_" else range_of(path)
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number and expected is None:
        return value
    expected = expected or FINITE
    if not expected.holds(value):
        key = ".".join(path).replace(".*", "")
        raise ValueError(f"{key}={value}: expected {expected}".replace("None", "null"))
    return int(value) if expected.whole and number else value


def _at(config: dict[str, Any], path: str) -> dict[str, Any]:
    """Group of settings at a path, empty if there is none."""
    for part in path.split("."):
        config = config.get(part) or {}
    return config
