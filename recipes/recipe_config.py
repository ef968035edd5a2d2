"""Composition of a checked, plain configuration from a command line, shared by the recipes."""

import logging
import os
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import hydra
from configs.schema import register_schema
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from recipe_checks import check_added, check_domain, checked_values, mistake_in, typed_settings
from recipe_overrides import PATHS, quoted_paths, removed_keys, said_keys
from recipe_saved import CONFIGS, check_saved_config, same_targets
from recipe_stages import composed_stages
from recipe_target import choices

from coachable.files import CheckpointError, check_contained, refusing
from coachable.finite import NonFiniteError
from coachable.training.checkpoint import find_checkpoint, read_state
from coachable.training.curriculum import Curriculum
from coachable.training.hardware import choose_preset, detect, estimate_update_seconds, pick_device
from coachable.training.train_settings import TrainSettings
from coachable.training.trainer import Trainer
from coachable.training.worker_errors import WorkerError

# Settings that a resumed run must not change, because the checkpoint's weights, replay buffer and generators depend on
# them.
_FIXED = (
    "domain",
    "seed",
    "network",
    "loss",
    "gamma",
    "style_reward",
    "replay",
    "replay_capacity",
    "mirror",
    "impersonation",
    # The saved settings of loss and replay contain the values of these.
    "alpha",
    "entropy_samples",
    "n_steps",
    "events",
    "event_capacity",
    "event_share",
    "event_horizon",
    "critic_support",
    "init_from",
    "init_new_observations",
    "stage",
    "stages",
    "family",
)


register_schema()


def config_groups(config_name: str) -> dict[str, list[str]]:
    """Return the choices of each group of a recipe; presets are the recipe's own, the other groups are shared."""
    folders = {folder.name: folder for folder in sorted(CONFIGS.iterdir()) if folder.is_dir()}
    folders.pop("__pycache__", None)  # of schema.py
    folders["preset"] /= config_name
    return {group: sorted(file.stem for file in folder.glob("*.yaml")) for group, folder in folders.items()}


OmegaConf.register_new_resolver(  # for --help
    "groups", lambda name: "\n".join(f"{group}: {', '.join(choices)}" for group, choices in config_groups(name).items())
)
OmegaConf.register_new_resolver(  # the default family has the domain of the recipe, others one of their own
    "domain_of_family", lambda domain, default, family: domain if family == default else f"{domain}_{family}"
)


def run_recipe(config_name: str, build: Callable[[dict[str, Any]], Trainer]) -> None:
    """Run a recipe from the command line.

    Args:
        config_name: File in recipes/configs, without its suffix.
        build: Function that makes the training from the plain, resolved configuration.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # TorchRL logs every buffer that it allocates
    sys.argv[1:] = checked_arguments(config_name, sys.argv[1:])

    @hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name=config_name)
    def main(cfg: DictConfig) -> None:
        overrides = list(HydraConfig.get().overrides.task)
        try:
            config = plain_config(cfg, overrides, config_name)
            train = start_training(build, config)
        except (CheckpointError, WorkerError, ValueError, ImportError, OSError) as error:
            if "HYDRA_FULL_ERROR" in os.environ:
                raise
            # You can fix these errors without a traceback, including the one that TorchRL appends from a worker.
            message = f"error: {error}".split("\n\nWorker traceback:\n")[0]
            changed = [key for key in said_keys(overrides) if key != "resume"]
            if cfg.resume and changed:  # checkpoint and command line make one configuration
                message += f"\nGiven beside resume=, which may be the reason: {', '.join(changed)}"
            raise SystemExit(message) from None
        try:
            train.run()
        except (NonFiniteError, CheckpointError, WorkerError) as error:
            raise SystemExit(f"error: {error}") from None
        last = train.train if isinstance(train, Curriculum) else train
        if not last.saved:
            raise SystemExit(
                f"error: the training ended at env-step {last.frames:,}, which could not be saved, see above"
            )

    try:
        main()
    except KeyboardInterrupt:  # while a stage starts, or for the second time; the loop itself saves a checkpoint
        print("interrupted: complete checkpoints are kept", file=sys.stderr)
        raise SystemExit(130) from None


def compose_config(config_name: str, arguments: list[str]) -> dict[str, Any]:
    """Compose a recipe's configuration in this process, with the checks of the command line.

    Args:
        config_name: File in recipes/configs, without its suffix.
        arguments: Overrides, such as `["preset=smoke", "seed=1"]`.

    Returns:
        The configuration as plain containers.
    """
    _, given = _hydra_arguments(config_name, arguments)
    return plain_config(_composed(config_name, given), given, config_name)


def checked_arguments(config_name: str, arguments: list[str]) -> list[str]:
    """Check a command line by composing its configuration, and replace `preset=auto` by a preset.

    Args:
        config_name: File in recipes/configs, without its suffix.
        arguments: Command line without the program; options such as `--help` are passed on.

    Returns:
        Arguments for Hydra.

    Raises:
        SystemExit: If a key, a choice or a type is wrong; the message lists the valid choices.
    """
    if any(argument.startswith("seeds=") for argument in arguments):
        raise SystemExit(f"error: several seeds are trained with coachable train {config_name} seeds=0,1,2")
    options, given = _hydra_arguments(config_name, arguments)
    if options.hydra_help or options.shell_completion:
        return arguments
    folder = [f"hydra.searchpath=[file://{Path(options.config_dir).absolute()}]"] if options.config_dir else []
    if not options.config_path:
        _composed(options.config_name or config_name, [*given, *folder])
    flags = [argument for argument in quoted_paths(arguments) if argument not in options.overrides]
    return [*given, *flags]  # Hydra's parser does not accept overrides both before and after its options


def _hydra_arguments(config_name: str, arguments: list[str]) -> tuple[Namespace, list[str]]:
    """Return Hydra's options, and the overrides with the preset that was given or that fits this machine."""
    options = get_args_parser().parse_intermixed_args(quoted_paths(arguments))
    try:
        overrides = OverridesParser.create().parse_overrides(options.overrides)
    except HydraException as error:
        raise SystemExit(f"error: {error}\nexpected KEY=VALUE, for example loss=sac or train.batch_size=256") from None
    sweeps = ["--multirun"] * options.multirun + [o.input_line or "" for o in overrides if o.is_sweep_override()]
    if sweeps:
        raise SystemExit(
            f"error: {sweeps[0]} asks for several trainings: expected coachable train {config_name} seeds=0,1,2 for "
            "several seeds, one command for each other training, and KEY=[VALUE,VALUE] for a list"
        )
    empty = [o.key_or_group for o in overrides if o.key_or_group in PATHS and o.value() == ""]
    if empty:  # for instance of a variable of the shell that is not set
        raise SystemExit(f"error: {empty[0]}= is empty: expected {empty[0]}=PATH, or none at all")
    chosen = [o for o in overrides if o.key_or_group == "preset"]
    preset = chosen[-1].value() if chosen else "auto"
    if preset == "auto":
        automatic = OmegaConf.load(CONFIGS / "preset" / config_name / "auto.yaml")
        preset = automatic.preset_for[choose_preset(detect())]
    elif any(o.key_or_group == "resume" and o.value() for o in overrides):
        raise SystemExit("error: a resumed run keeps its preset: leave preset= out, or start anew with init_from=PATH")
    return options, [*(o.input_line or "" for o in overrides if o not in chosen), f"preset={config_name}/{preset}"]


def _composed(config_name: str, overrides: list[str]) -> DictConfig:
    """Compose a configuration, and exit with a sentence if it is wrong."""
    try:
        with _configs():
            return hydra.compose(config_name, overrides)
    except MissingConfigException as error:
        if "HYDRA_FULL_ERROR" in os.environ or error.missing_cfg_file is None:
            raise
        group, _, choice = error.missing_cfg_file.removeprefix(f"preset/{config_name}/").rpartition("/")
        valid = error.options if group else config_groups(config_name)["preset"]
        message = f"{group or 'preset'}={choice} does not exist.{choices(choice, valid or [])}"
    except (HydraException, ValueError) as error:
        if "HYDRA_FULL_ERROR" in os.environ:
            raise
        cause = error.__cause__ or error.__context__
        named = isinstance(cause, OmegaConfBaseException) and cause.full_key
        message = mistake_in(cause) if named else " ".join(str(error).splitlines()[:2])
        if isinstance(cause, OmegaConfBaseException) and not named:
            message += f": {str(cause).splitlines()[0]}"
    raise SystemExit(f"error: {message}")


def start_training(build: Callable[[dict[str, Any]], Trainer], config: dict[str, Any]) -> Trainer | Curriculum:
    """Make a training, or a curriculum if the configuration has stages, and announce it."""
    if config.get("stages"):
        return Curriculum(config, lambda stage: build_checked(build, stage), announce)
    train = build_checked(build, config)
    announce(config, train)
    return train


def build_checked(build: Callable[[dict[str, Any]], Trainer], config: dict[str, Any]) -> Trainer:
    """Make a training from a configuration, which may come from a checkpoint.

    Raises:
        CheckpointError: If a resumed run's configuration cannot be used.
    """
    if not config["resume"]:
        return build(config)
    with refusing(config["resume"], "a configuration"):
        return build(config)


def plain_config(cfg: DictConfig, overrides: list[str], config_name: str) -> dict[str, Any]:
    """Resolve a composed configuration; that of a resumed run is based on the one in its checkpoint.

    Args:
        cfg: Configuration composed by Hydra.
        overrides: Overrides of the command line.
        config_name: File in recipes/configs, without its suffix; a configuration in a checkpoint may only name the
            functions of this file and its groups.

    Returns:
        The configuration as plain containers, with `run_dir` filled in.

    Raises:
        CheckpointError: If the configuration in a checkpoint names other functions, or is not plain.
        ValueError: If a number lies outside its range.
    """
    keys = said_keys(overrides)
    check_added(cfg, keys)
    check_domain(cfg, keys)
    if cfg.resume:
        if removed := removed_keys(overrides):
            raise ValueError(f"~{removed[0]} cannot be removed from a resumed run: start a new one with init_from=PATH")
        checkpoint = find_checkpoint(cfg.resume)
        saved = read_state(checkpoint).get("config")
        composed: Any = OmegaConf.to_container(cfg, resolve=True)
        # A group's choice that is the run's own keeps the run's numbers, which are checked like all others.
        own = {key for key in config_groups(config_name) if key in _FIXED and same_targets(saved, composed, key)}
        said = {key: OmegaConf.select(cfg, key) for key in keys if key not in own}
        check_saved_config(saved, checkpoint, config_name, said, composed)
        with refusing(checkpoint, "a configuration"):
            before = OmegaConf.create(saved)
            fixed = [key for key in said if key.split(".")[0] in _FIXED and said[key] != OmegaConf.select(before, key)]
        if fixed:
            raise SystemExit(
                f"error: {', '.join(fixed)} cannot change in a resumed run: start a new one with init_from={cfg.resume}"
            )
        run = _run_of(checkpoint, staged=bool(saved.get("stages")))
        replaced = {"init_from": None, "run_dir": run, **said, "resume": str(checkpoint)}
        if run is not None and replaced["run_dir"] == run:
            # The training writes into this folder. W&B makes a folder for itself, with a link to its log elsewhere.
            check_contained(Path(run), passed_over="wandb")
        with refusing(checkpoint, "a configuration"):
            for key, value in replaced.items():
                OmegaConf.update(before, key, value, merge=False)
            for stage in before.get("stages") or []:
                for key, value in said.items():
                    if key.split(".")[0] not in _FIXED:  # each stage keeps its own
                        OmegaConf.update(stage, key, value, merge=False)
            cfg = OmegaConf.create(OmegaConf.to_container(before, resolve=True, throw_on_missing=True))
    elif cfg.get("stages") or cfg.stage is not None:
        stages = composed_stages(cfg, keys, removed_keys(overrides))
        cfg = _chosen_stage(cfg, stages, keys)
    try:
        config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)  # pyright: ignore
    except OmegaConfBaseException as error:
        raise ValueError(mistake_in(error)) from None
    config.pop("hydra", None)
    config["run_dir"] = str(Path(config["run_dir"] or _new_run_dir(config["domain"])).expanduser().absolute())
    try:
        return checked_values(config)
    except (AttributeError, KeyError, TypeError) as error:  # only a saved configuration can have wrong types
        raise CheckpointError(f"{config['resume']} holds a configuration of another kind: {error}") from error


def _chosen_stage(cfg: DictConfig, stages: list[dict[str, Any]], said: list[str]) -> DictConfig:
    """Return the stage of `stage=NAME` as a training of its own, or else the first one with the list of all."""
    names = [stage["stage"] for stage in stages]
    if cfg.stage is not None and cfg.stage not in names:
        raise ValueError(f"stage={cfg.stage} does not exist.{choices(cfg.stage, names)}")
    chosen = stages[0 if cfg.stage is None else names.index(cfg.stage)]
    own = {"init_new_observations": cfg.init_new_observations} if "init_new_observations" in said else {}
    return OmegaConf.create({**chosen, **own, "stages": stages if cfg.stage is None else []})


def announce(config: dict[str, Any], trainer: Trainer) -> None:
    """Print the chosen settings and about how long the training will take, with the stages that follow."""
    settings, learner = typed_settings(config), trainer.learner
    parameters = sum(p.numel() for p in learner.loss_module.actor_network_params.parameters())
    device, bf16 = pick_device(settings.device), learner.precision == "bf16"

    @cache  # it is measured
    def seconds_for(samples: int) -> float:
        return estimate_update_seconds(parameters, samples, bf16, device)

    def update_seconds(settings: Any) -> float:
        return seconds_for(settings.train.batch_size * (settings.impersonation.n + 1))

    def hours(settings: Any, frames: int) -> float:
        train: TrainSettings = settings.train
        slowest = frames / (train.throttle or float("inf"))
        return max(frames * (train.utd_ratio or 0) * update_seconds(settings), slowest) / 3600

    seconds = update_seconds(settings)
    remaining = max(0, settings.train.total_frames - trainer.frames)
    time_left = hours(settings, remaining)
    stages = [typed_settings(stage) for stage in settings.stages]
    number = next((i for i, stage in enumerate(stages, 1) if stage.stage == settings.stage), 0)
    later = sum(hours(stage, stage.train.total_frames) for stage in stages[number:])
    if settings.resume:
        print(f"Resumed {settings.resume} at {trainer.frames:,} env-steps")
    hardware = detect()
    print(f"Found {hardware.describe()}: preset {settings.preset}, {learner.precision} updates")
    estimate = f"{remaining:,} env-steps to go, about {time_left:.1f} h ({seconds * 1e3:.0f} ms per update)"
    if stages:
        estimate = f"Stage {number} of {len(stages)}, {settings.stage}: {estimate}"
    if later:
        estimate += f"; with the stages that follow about {time_left + later:.1f} h"
    print(estimate)
    if bf16 and not hardware.bf16:
        print("warning: this machine has no bf16 in hardware, so that updates take much longer than with fp32 or auto")
    for name in ("warmup_frames", "batch_size"):
        if remaining and (needed := getattr(settings.train, name)) >= settings.train.total_frames:
            total = f"train.total_frames={settings.train.total_frames:,}"
            print(f"warning: no update will be made, because train.{name}={needed:,} is not below {total}")
    print(f"Writing to {settings.run_dir}; Ctrl-C saves a checkpoint and stops")


def _run_of(checkpoint: Path, *, staged: bool) -> str | None:
    if checkpoint.parent.name != "checkpoints":
        return None
    return str(checkpoint.parents[3 if staged else 1])


def _new_run_dir(domain: str) -> Path:
    base = Path("runs") / domain / time.strftime("%Y-%m-%d_%H-%M-%S")
    folder, copy = base, 1
    while folder.exists():
        copy += 1
        folder = base.with_name(f"{base.name}_{copy}")
    return folder


@contextmanager
def _configs() -> Iterator[None]:
    """Initialise Hydra with the recipes' configurations, unless a running recipe has done so."""
    if GlobalHydra.instance().is_initialized():
        yield
        return
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        yield
