"""What the overrides of a command line say, before Hydra composes a configuration with them."""

from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

PATHS = ("run_dir", "resume", "init_from")


def quoted_paths(arguments: list[str]) -> list[str]:
    """Quote paths, so that Hydra does not parse them: a folder may be called `a=b` or `a, b`."""
    quoted = []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if equals and key in PATHS and value not in ("", "null") and value[0] not in "'\"":
            escaped = value.replace("'", "\\'")
            argument = f"{key}='{escaped}'"
        quoted.append(argument)
    return quoted


def said_keys(overrides: list[str]) -> list[str]:
    """Return the keys that a command line sets: of `train={batch_size: 8}` the key `train.batch_size`."""
    parsed = [o for o in OverridesParser.create().parse_overrides(overrides) if not o.is_delete()]
    keys = [key for o in parsed for key in _entries(o.key_or_group, o.value())]
    return [key for key in keys if key != "preset" and not key.startswith("hydra")]


def _entries(key: str, value: Any) -> list[str]:
    if not isinstance(value, dict) or not value:
        return [key]
    return [entry for name, inner in value.items() for entry in _entries(f"{key}.{name}", inner)]


def removed_keys(overrides: list[str]) -> list[str]:
    """Return the keys that a command line removes, with ~KEY."""
    return [o.key_or_group for o in OverridesParser.create().parse_overrides(overrides) if o.is_delete()]
