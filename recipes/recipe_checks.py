"""Checks of a configuration; the error messages name the key, the given value and the valid ones."""

from collections.abc import Iterable, Mapping
from dataclasses import Field, fields, is_dataclass
from functools import reduce
from typing import Any

from configs.schema import FamilySettings, Settings, composed_type
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException, ValidationError
from recipe_target import Target, choices

from coachable.domain import domain_names
from coachable.ranges import FINITE, Range

_NUMBERS = {entry.name: entry for entry in fields(Settings) if "range" in entry.metadata}
_KINDS = {bool: "true or false", str: "a name or path", str | None: "a name or path, or null"}


def mistake_in(error: OmegaConfBaseException) -> str:
    """Return a sentence for an error of OmegaConf: an unknown key, or a value of another type."""
    key = str(error.full_key)
    where, _, part = key.rpartition(".")
    parent = error.parent_node
    if isinstance(error, ConfigAttributeError | ConfigKeyError) and isinstance(parent, DictConfig):
        names = [str(name) for name in parent if name != "hydra" and not str(name).startswith("_")]
        message = f"{key} does not exist: {where or 'the configuration'} has no {part!r}.{choices(part, names)}"
        group = declared(where.split(".")[0])
        takes_more = isinstance(group, Field) and (group.type is Target or group.name == "style_reward")
        return f"{message}; +{key}=VALUE adds an argument that is not among them" if takes_more else message
    entry = declared(*key.split("."))
    if isinstance(error, ValidationError) and isinstance(entry, Field):
        return f"{key}={error.value}: expected {_in_words(entry)}".replace("None", "null")
    return f"{key}: {str(error).splitlines()[0]}"


def typed_settings(config: dict[str, Any]) -> Settings:
    """Return a plain configuration as typed settings; entries that the command line added with `+` are left out.

    Args:
        config: Plain containers, resolved.

    Returns:
        Settings, or `FamilySettings` if the configuration names a family.

    Raises:
        ValueError: If a key is missing or unknown, or a value has another type.
    """
    kind = FamilySettings if "family" in config else Settings
    config = {"stages": [], "stage": None, **config}
    known = {entry.name: config[entry.name] for entry in fields(kind) if entry.name in config}
    try:
        merged = OmegaConf.merge(OmegaConf.structured(composed_type(kind)), known)
        return _typed(kind, OmegaConf.to_container(merged, throw_on_missing=True))
    except OmegaConfBaseException as error:
        raise ValueError(mistake_in(error)) from None


def declared(*path: str) -> Any:
    """Return what the schema declares at a path: a field, a range, a list of the range of each entry, or None."""
    return reduce(_inside, path, FamilySettings)


def check_added(config: DictConfig, said: Iterable[str]) -> None:
    """Refuse an added key, which nothing reads, if it has the name of a setting elsewhere; other ones are notes.

    Args:
        config: The composed configuration.
        said: Keys that the command line sets.

    Raises:
        ValueError: If there is such a key.
    """
    groups: dict[str, Any] = OmegaConf.to_container(config, resolve=False)  # pyright: ignore[reportAssignmentType]
    for key in said:
        places = [f"{group}.{key}" for group, inner in groups.items() if isinstance(inner, dict) and key in inner]
        if places and declared(key) is None:
            raise ValueError(f"+{key} has no effect: expected {' or '.join(places)}")


def check_domain(config: DictConfig, said: Iterable[str]) -> None:
    """Refuse a domain of the command line that no package registers; a recipe's own need not be registered.

    Raises:
        ValueError: If it is not registered.
    """
    if "domain" in said and isinstance(config.domain, str) and config.domain not in (names := domain_names()):
        raise ValueError(f"domain={config.domain}: expected a registered one.{choices(config.domain, names)}")


def range_of(entry: Any) -> Range | None:
    """Return the range that the result of `declared` sets for a number, or None if any finite number is valid."""
    entry = entry.metadata.get("range") if isinstance(entry, Field) else entry
    return entry if isinstance(entry, Range) else None


def _inside(outer: Any, part: str) -> Any:
    """Return what is declared for a part of a group, see `declared`."""
    if isinstance(outer, Field):
        outer = FamilySettings if outer.name == "stages" else outer.metadata.get("ranges", outer.type)
    if isinstance(outer, Mapping):  # arguments, which may be nested
        return outer.get(part) or _NUMBERS.get(part) or outer.get("*", outer)
    if isinstance(outer, list):
        return outer[0]
    return {entry.name: entry for entry in fields(outer)}.get(part) if is_dataclass(outer) else None


def checked_values(config: dict[str, Any]) -> dict[str, Any]:
    """Check every number and every switch of a configuration.

    Args:
        config: Plain containers.

    Returns:
        The same configuration, in which whole numbers that are written as `1e6` are integers.

    Raises:
        ValueError: If a value is not valid; the message names the key, the value and the valid range.
    """
    checked = _checked(config, FamilySettings, ())
    for group in ("critic_support", "loss", "network.critic"):
        support: dict[str, Any] = reduce(lambda outer, part: outer.get(part) or {}, group.split("."), checked)
        if "v_min" in support and not support["v_min"] < support["v_max"]:
            raise ValueError(f"{group}.v_min={support['v_min']}: expected less than v_max, which is {support['v_max']}")
    return checked


def _checked(value: Any, entry: Any, path: tuple[str, ...]) -> Any:
    if isinstance(value, dict):
        return {key: _checked(inner, _inside(entry, str(key)), (*path, str(key))) for key, inner in value.items()}
    if isinstance(value, list) and (value or not isinstance(entry, list)):
        return [_checked(inner, _inside(entry, "*"), path) for inner in value]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    expected = None if path[-1] == "_target_" else range_of(entry) or (FINITE if number else None)
    if expected is not None and not expected.holds(value):
        wanted = str(expected)
    elif isinstance(entry, Field) and entry.type is bool and not isinstance(value, bool):
        wanted = _KINDS[bool]
    elif isinstance(entry, list) and value is not None:
        wanted = f"a list of at least one entry, each {entry[0]}"
    else:
        return int(value) if expected is not None and expected.whole and number else value
    raise ValueError(f"{'.'.join(path)}={value}: expected {wanted}".replace("None", "null"))


def _in_words(entry: Field[Any]) -> str:
    if "range" in entry.metadata:
        return str(entry.metadata["range"])
    return _KINDS.get(entry.type, "a list" if "list" in str(entry.type) else "a group of settings")  # pyright: ignore


def _typed(kind: Any, value: Any, *path: str) -> Any:
    if kind is Target:
        if "_target_" not in value:
            raise ValueError(f"{'.'.join(path)} has no _target_: expected the name of a function or class")
        return Target(value)
    if not is_dataclass(kind):
        return value
    entries = fields(kind)
    return kind(**{entry.name: _typed(entry.type, value[entry.name], *path, entry.name) for entry in entries})  # pyright: ignore
