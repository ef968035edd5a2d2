"""Checks of a configuration; the error messages name the key, the given value and the valid ones."""

import difflib
from collections.abc import Iterable
from dataclasses import Field, fields, is_dataclass
from typing import Any

from configs.schema import FamilySettings, Settings, composed_type
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException, ValidationError

from coachable.ranges import AMOUNT, COUNT, FINITE, NOT_NEGATIVE, POSITIVE, SHARE, Range

# Ranges of numbers in the groups with a `_target_`, by the end of the number's path; `*` is any entry of a list or
# group. The schema declares the other ranges; `replay.gamma` and `loss.alpha` have those of `gamma` and `alpha`.
RANGES: dict[str, Range] = {entry.name: entry.metadata["range"] for entry in fields(Settings) if entry.metadata} | {
    # losses
    "alpha_init": POSITIVE,
    "num_quantiles": COUNT,
    "kappa": NOT_NEGATIVE,
    "num_atoms": Range("[2, inf)", whole=True),
    "sigma_ratio": POSITIVE,
    # replay
    "capacity": COUNT,
    "table_capacities.*": COUNT,
    "table_proportions.*": SHARE,
    "priority_alpha": NOT_NEGATIVE,
    "priority_beta": NOT_NEGATIVE,
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
    "num_outputs": COUNT,
    "head_gain": NOT_NEGATIVE,
    "dropout": Range("[0, 1)"),
    # learner, beyond what the configuration lists
    "alpha_lr": NOT_NEGATIVE,
    "check_every": AMOUNT,
    # collector, env and style_reward
    "num_collectors": COUNT,
    "steps_per_batch": COUNT,
    "cpus_per_worker": POSITIVE,
    "weights_every": COUNT,
    "queue_size": COUNT,
    "worker_throttle": Range("(0, inf)", optional=True),
    "patience": POSITIVE,
    "num_envs": COUNT,
    "episode_steps": COUNT,
    "seconds": POSITIVE,
    "num_enemies": COUNT,
    "traps": AMOUNT,
    "cars": COUNT,
    "costs.*": NOT_NEGATIVE,
    "start_speed": NOT_NEGATIVE,
    "push_force": NOT_NEGATIVE,
    "push_interval": POSITIVE,
    "shares.*": SHARE,
    "weights.*": NOT_NEGATIVE,
    "style_reward.margin": POSITIVE,
    "style_reward.*": NOT_NEGATIVE,
}

_KINDS = {bool: "true or false", str: "a name or path", str | None: "a name or path, or null"}


def choices(given: str, valid: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the closest valid name, and all valid ones."""
    valid = list(valid)
    close = difflib.get_close_matches(given, valid, n=1)
    guess = f" Did you mean {close[0]}?" if close else ""
    return f"{guess} Valid: {', '.join(valid) or 'none'}"


def mistake_in(error: OmegaConfBaseException) -> str:
    """Return a sentence for an error of OmegaConf: an unknown key, or a value of another type."""
    key = str(error.full_key)
    where, _, part = key.rpartition(".")
    parent = error.parent_node
    if isinstance(error, ConfigAttributeError | ConfigKeyError) and isinstance(parent, DictConfig):
        names = [str(name) for name in parent if name != "hydra" and not str(name).startswith("_")]
        return f"{key} does not exist: {where or 'the configuration'} has no {part!r}.{choices(part, names)}"
    entry = _declared(tuple(key.split(".")))
    if isinstance(error, ValidationError) and entry is not None:
        return f"{key}={error.value}: expected {_in_words(entry)}".replace("None", "null")
    return f"{key}: {str(error).splitlines()[0]}"


def typed_settings(config: dict[str, Any]) -> Settings:
    """Return a plain configuration as typed settings; entries that the command line added with `+` are left out.

    Args:
        config: Plain containers, resolved.

    Raises:
        ValueError: If a key is missing or unknown, or a value has another type.
    """
    config = {"stages": [], "stage": None, **config}
    known = {entry.name: config[entry.name] for entry in fields(Settings) if entry.name in config}
    try:
        merged = OmegaConf.merge(OmegaConf.structured(composed_type(Settings)), known)
        return _typed(Settings, OmegaConf.to_container(merged, throw_on_missing=True))
    except OmegaConfBaseException as error:
        raise ValueError(mistake_in(error)) from None


def range_of(path: tuple[str, ...]) -> Range | None:
    """Return the range of the number at a path, or None if any finite number is valid."""
    if entry := _declared(path):
        return entry.metadata.get("range")
    ends = [".".join(path[i:]) for i in range(len(path))] + [".".join((*path[-2:-1], "*"))]
    return next((RANGES[end] for end in ends if end in RANGES), None)


def checked_values(config: dict[str, Any]) -> dict[str, Any]:
    """Check every number and every switch of a configuration.

    Args:
        config: Plain containers.

    Returns:
        The same configuration, in which whole numbers that are written as `1e6` are integers.

    Raises:
        ValueError: If a value is not valid; the message names the key, the value and the valid range.
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
    entry = _declared(path)
    number = isinstance(value, int | float) and not isinstance(value, bool)
    expected = None if path[-1] == "_target_" else range_of(path) or (FINITE if number else None)
    if expected is not None and not expected.holds(value):
        wanted = str(expected)
    elif entry is not None and entry.type is bool and not isinstance(value, bool):
        wanted = _KINDS[bool]
    elif value is not None and (each := range_of((*path, "*"))):
        wanted = f"a list, each entry {each}"
    else:
        return int(value) if expected is not None and expected.whole and number else value
    raise ValueError(f"{'.'.join(path).replace('.*', '')}={value}: expected {wanted}".replace("None", "null"))


def _declared(path: tuple[str, ...]) -> Field[Any] | None:
    """Return the field of the schema at a path, or None in a group with a `_target_`."""
    kind, entry = FamilySettings, None
    for part in path:
        entry = {field.name: field for field in fields(kind)}.get(part) if is_dataclass(kind) else None
        kind = entry and entry.type
    return entry


def _in_words(entry: Field[Any]) -> str:
    if "range" in entry.metadata:
        return str(entry.metadata["range"])
    return _KINDS.get(entry.type, "a list" if "list" in str(entry.type) else "a group of settings")  # pyright: ignore


def _typed(kind: Any, value: Any) -> Any:
    if not is_dataclass(kind):
        return value
    return kind(**{entry.name: _typed(entry.type, value[entry.name]) for entry in fields(kind)})  # pyright: ignore


def _at(config: dict[str, Any], path: str) -> dict[str, Any]:
    """Return the group of settings at a path, or an empty dictionary if there is none."""
    for part in path.split("."):
        config = config.get(part) or {}
    return config
