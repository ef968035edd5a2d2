"""Configurations from checkpoints, which may come from anybody: they name nothing that the local YAML files do not."""

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
    """Refuses a configuration from a checkpoint that could run something else than this recipe.

    Hydra calls whatever a configuration names as a `_target_`, and OmegaConf fills in `${...}` from the environment and
    other places. A checkpoint may come from anybody: each `_target_` has to be one that the YAML files of the recipe
    name at the same place, and nothing is filled in.

    Args:
        saved: from the checkpoint.
        checkpoint: for the message.
        config_name: file in recipes/configs, without its suffix.
        said: keys that the command line replaces.
        composed: the configuration as composed here, with what the command line says.

    Raises:
        CheckpointError: naming the place.
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
    """Where the YAML files of a recipe, its groups and its presets name which `_target_`: (place, target)."""
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
    for place, value in leaves:  # what is filled in from elsewhere, such as replay.events
        source = tuple(str(value)[2:-1].split(".")) if str(value).startswith("${") else ()
        known |= {(place + where[len(source) :], t) for where, t in known if source and where[: len(source)] == source}
    return known


def _targets(leaves: Iterable[tuple[tuple[str, ...], Any]]) -> set[tuple[tuple[str, ...], str]]:
    return {(place, value) for place, value in leaves if place and place[-1] == "_target_"}


def _leaves(value: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(value, dict | list | tuple):
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            # A stage may name what the recipe may name.
            yield from _leaves(entry, () if place == ("stages",) else (*place, str(key)))
    else:
        yield place, value
