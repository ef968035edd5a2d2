"""Configurations of the stages of a training: the recipe's own, with what each stage changes."""

from collections.abc import Mapping
from typing import Any

from configs.schema import typed_settings
from omegaconf import DictConfig, OmegaConf
from recipe_ranges import checked_numbers

_OF_THE_RUN = ("run_dir", "resume", "init_from", "init_new_observations", "stage", "stages", "hydra")


def composed_stages(cfg: DictConfig, said: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the complete configuration of every stage; each stage keeps what the stages before it changed.

    Args:
        cfg: The recipe's configuration. `cfg.stages` lists what each stage changes, its `name` and its `total_frames`,
            which stands for `train.total_frames`.
        said: What the command line says, by key; it holds in all stages.

    Raises:
        ValueError: If a stage has no name, changes what there is not, or a number lies outside its range.
    """
    stages = []
    current = OmegaConf.create(OmegaConf.to_container(cfg, resolve=False))
    changes: list[dict[str, Any]] = OmegaConf.to_container(current.pop("stages"), resolve=False)  # pyright: ignore
    for change in changes:
        name = change.pop("name", None)
        if name is None:
            raise ValueError(f"a stage has no name: expected {{name: NAME, total_frames: N, ...}}, got {change}")
        if "total_frames" in change:
            change.setdefault("train", {})["total_frames"] = change.pop("total_frames")
        known = {str(key) for key in cfg}.difference(_OF_THE_RUN) | {"init_new_observations"}
        if unknown := sorted(set(change) - known):
            raise ValueError(
                f"stage {name} changes {', '.join(unknown)}: expected name, total_frames, {', '.join(sorted(known))}"
            )
        current = OmegaConf.merge(current, change)
        for key, value in said.items():
            if key.split(".")[0] not in _OF_THE_RUN:
                OmegaConf.update(current, key, value, merge=False)
        stage = OmegaConf.to_container(current, resolve=True, throw_on_missing=True)
        assert isinstance(stage, dict)
        stage.pop("hydra", None)
        stage = checked_numbers({**{str(key): value for key, value in stage.items()}, "stage": name})
        typed_settings({**stage, "run_dir": ""})
        stages.append(stage)
        OmegaConf.update(current, "init_new_observations", 0)  # those of one stage are known to the next
    return stages
