"""Checks of configurations from checkpoints, which are not trusted: they may only name what local YAML files name."""

from collections.abc import Collection, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from coachable.files import CheckpointError

CONFIGS = Path(__file__).resolve().parent / "configs"


def check_saved_config(
    saved: Any, checkpoint: Path, config_name: str, said: Collection[str] = (), composed: Any = None
) -> None:
    """Refuse a configuration from a checkpoint that could run other code than this recipe.

    Hydra calls every `_target_` of a configuration, and OmegaConf replaces `${...}` by values from the environment and
    other places. Checkpoints are not trusted: each `_target_` has to be one that the YAML files of the recipe have at
    the same place, and `${...}` is not allowed.

    Args:
        saved: Configuration in the checkpoint.
        checkpoint: Path of the checkpoint, for the message.
        config_name: File in recipes/configs, without its suffix.
        said: Keys that the command line replaces.
        composed: Configuration as composed here, with the overrides of the command line.

    Raises:
        CheckpointError: If the configuration is refused; the message names the place.
    """
    if not isinstance(saved, dict) or not str(saved.get("domain")).isidentifier():
        raise CheckpointError(f"{checkpoint} holds no configuration of a training: it cannot be resumed")
    known = known_targets(config_name) | _targets(_leaves(composed))
    replaced = [tuple(key.split(".")) for key in said]
    for place, value in _leaves(saved):
        if any(place[: len(key)] == key for key in replaced):
            continue
        where, name = ".".join(place), place[-1] if place else "stages"
        if name == "_target_" and (place, value) not in known:
            here = sorted(target for known_place, target in known if known_place == place)
            raise CheckpointError(
                f"{checkpoint} names {value!r} as its {where}: expected {' or '.join(here) or 'none'}, as the "
                f"configuration of {config_name} has it; say {where}={value} yourself if you trust it"
            )
        plain = value is None or isinstance(value, bool | int | float | str)
        if not plain or "${" in str(value) or (name.startswith("_") and name != "_target_"):
            raise CheckpointError(f"{checkpoint} has {value!r} as its {where}: expected a plain value")


@cache
def known_targets(config_name: str) -> set[tuple[tuple[str, ...], str]]:
    """Return every `_target_` in the YAML files of a recipe, its groups and its presets, as (place, target)."""
    presets = CONFIGS / "preset" / config_name
    groups = (folder for folder in CONFIGS.iterdir() if folder.is_dir() and folder.name != "preset")
    files = [CONFIGS / f"{config_name}.yaml", CONFIGS / "training.yaml", *presets.glob("*.yaml")]
    files += [file for group in groups for file in group.glob("*.yaml")]
    leaves = []
    for file in files:
        content = OmegaConf.to_container(OmegaConf.load(file))
        shared = file.parent in (CONFIGS, presets) or "# @package _global_" in file.read_text(encoding="utf-8")
        leaves += _leaves(content if shared else {file.parent.name: content})
    known = _targets(leaves)
    for place, value in leaves:  # values that refer to other places, such as replay.events
        source = tuple(str(value)[2:-1].split(".")) if str(value).startswith("${") else ()
        known |= {(place + where[len(source) :], t) for where, t in known if source and where[: len(source)] == source}
    return known


def same_targets(saved: Any, composed: Any, group: str) -> bool:
    """Return whether two configurations name the same functions and classes in a group."""
    one, other = (
        _targets(_leaves(config.get(group))) if isinstance(config, dict) else None for config in (saved, composed)
    )
    return one == other


def _targets(leaves: Iterable[tuple[tuple[str, ...], Any]]) -> set[tuple[tuple[str, ...], str]]:
    return {(place, value) for place, value in leaves if place and place[-1] == "_target_"}


def _leaves(value: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(value, dict | list | tuple):
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            # A stage may name the same targets as the recipe.
            yield from _leaves(entry, () if place == ("stages",) else (*place, str(key)))
    else:
        yield place, value
