"""Configurations of the stages of a training: the recipe's own, with the changes of each stage."""

from collections.abc import Iterable
from functools import reduce
from operator import getitem
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from recipe_checks import checked_values, mistake_in, typed_settings

_OF_THE_RUN = ("run_dir", "resume", "init_from", "init_new_observations", "stage", "stages", "hydra")


def composed_stages(cfg: DictConfig, said: Iterable[str], removed: Iterable[str] = ()) -> list[dict[str, Any]]:
    """Return the complete configuration of every stage; each stage keeps the changes of the stages before it.

    Args:
        cfg: The recipe's configuration. `cfg.stages` lists the changes of each stage, its `name` and its
            `total_frames`, which stands for `train.total_frames`.
        said: Keys that the command line sets, which applies to all stages.
        removed: Keys that the command line removes.

    Raises:
        ValueError: If a stage has no name, changes an unknown setting, or a number lies outside its range.
    """
    stages = []
    changes: list[dict[str, Any]] = OmegaConf.to_container(cfg.stages, resolve=False)  # pyright: ignore
    given: dict[str, Any] = OmegaConf.to_container(cfg, resolve=False)  # pyright: ignore
    values: dict[str, Any] = {}
    for key in said:
        if key.split(".")[0] not in _OF_THE_RUN:
            # A group has a type. Other values may refer to settings, such as ${gamma}, and stay as they are written.
            group = OmegaConf.select(cfg, key)
            values[key] = group if isinstance(group, DictConfig) else reduce(getitem, key.split("."), given)
    current = cfg.copy()
    current.stages = []
    OmegaConf.set_struct(current, None)  # a stage may add arguments of a target, but no entries of the schema
    for change in changes:
        name = change.pop("name", None)
        if name is None:
            raise ValueError(f"a stage has no name: expected {{name: NAME, total_frames: N, ...}}, got {change}")
        length = {"train": {"total_frames": change.pop("total_frames")}} if "total_frames" in change else {}
        known = {str(key) for key in cfg}.difference(_OF_THE_RUN) | {"init_new_observations"}
        if unknown := sorted(set(change) - known):
            raise ValueError(
                f"stage {name} changes {', '.join(unknown)}: expected name, total_frames, {', '.join(sorted(known))}"
            )
        try:
            current = OmegaConf.merge(current, change, length)
            for key, value in values.items():
                OmegaConf.update(current, key, value, merge=False, force_add=True)
            for key in removed:
                group, _, name_in_group = key.rpartition(".")
                inner = OmegaConf.select(current, group)
                if group and OmegaConf.get_type(inner) is dict:  # arguments of a target; the schema's are all needed
                    inner.pop(name_in_group, None)
            stage: dict[str, Any] = OmegaConf.to_container(current, resolve=True, throw_on_missing=True)  # pyright: ignore
        except OmegaConfBaseException as error:
            raise ValueError(f"stage {name}: {mistake_in(error)}") from None
        stage = {key: value for key, value in stage.items() if key not in ("hydra", "stages")}
        stage = checked_values({**stage, "stage": name})
        typed_settings(stage)
        stages.append(stage)
        OmegaConf.update(current, "init_new_observations", 0)  # the next stage starts with these observations
    return stages
