"""Checkpoints: written atomically, read without pickle, and refused with a reason where they do not fit.

A checkpoint is a folder with `state.pt` (tensors, numbers, strings, containers: `torch.load(weights_only=True)`), a
readable `metadata.json` and, in the newest one, the replay buffer under `replay/`.
"""

import contextlib
import json
import os
import shutil
import time
import warnings
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from coachable.files import (
    CheckpointError,
    check_contained,
    check_finite,
    load_state,
    save_state,
    space_named,
    sync_folder,
    tensor_bytes,
    write_text,
)
from coachable.replay.records import record_bytes
from coachable.replay.replay_files import write_replay

__all__ = [
    "CheckpointError",
    "CheckpointStore",
    "check_fits",
    "check_unused",
    "check_writable",
    "find_checkpoint",
    "read_state",
]

SCHEMA_VERSION = 1
_LATEST = "LATEST"
_STATE = "state.pt"
_WEIGHTS = ("actor", "critics", "learner")  # parts of a state that must be finite
_FORMER_OPTIONS = {  # what configurations of earlier versions name, and the only behaviour that is left
    "entropy_in_target": "inside",
    "event_admission": "nonzero",
    "hl_gauss_support": "edges",
    "mean_bound": "post_tanh",
    "narrowing": "padded_side",
    "quantile_reduction": "mean",
    "regret_gradient": "dpi",
    "target_min": "vector",
}


class CheckpointStore:
    """The checkpoints of one run.

    Args:
        directory: folder of the checkpoints, created when first written to.
        keep: how many to keep; older ones are removed after a new one is complete.
        replay: whether the newest checkpoint holds the replay buffer (needed to resume exactly).

    Raises:
        ValueError: if `keep` is below 1.
    """

    def __init__(self, directory: Path | str, keep: int = 3, replay: bool = True) -> None:
        if keep < 1:
            raise ValueError(f"checkpoint.keep must be at least 1, got {keep}")
        self.directory = Path(directory)
        self.keep = keep
        self.replay = replay

    def save(self, state: Mapping[str, Any], metadata: Mapping[str, Any], replay: Any | None = None) -> Path:
        """Writes one checkpoint: complete, or not at all.

        Everything goes to a hidden folder that is synced to disk and renamed, so that a process killed at any moment
        leaves the previous checkpoint as it was.

        Args:
            state: what `state.pt` holds.
            metadata: JSON-ready; must contain `frames`.
            replay: replay buffer to save with it, if this store keeps replays.

        Returns:
            The folder.

        Raises:
            CheckpointError: if a weight is NaN or infinite; nothing is written.
            OSError: if writing fails (disk full, no permission), with the space that is needed; the partial is removed.
        """
        self._check_finite(state, int(metadata["frames"]))
        self.directory.mkdir(parents=True, exist_ok=True)
        replay = replay if self.replay else None
        required_bytes = tensor_bytes(state) + (0 if replay is None else record_bytes(replay.storage))
        self._remove_partials()  # of a process that was killed: there may be no room for another one beside them
        name = self._free_name(int(metadata["frames"]))
        partial = self.directory / f".{name}.partial"
        try:
            with space_named(self.directory / name, required_bytes):
                partial.mkdir()
                save_state({"schema": SCHEMA_VERSION, **state}, partial / _STATE)
                write_text(partial / "metadata.json", json.dumps({**metadata, **_provenance()}, indent=1))
                if replay is not None:
                    write_replay(replay, partial / "replay")
                sync_folder(partial)
                os.rename(partial, self.directory / name)
                pointer = self.directory / f".{_LATEST}.partial"
                write_text(pointer, name + "\n")
                os.replace(pointer, self.directory / _LATEST)
                sync_folder(self.directory)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        self._prune(name)
        return self.directory / name

    def try_save(self, state: Mapping[str, Any], metadata: Mapping[str, Any], replay: Any | None = None) -> Path | None:
        """Like `save`, but a failed write only warns: a long training should outlive a disk that is full.

        Raises:
            CheckpointError: if a weight is NaN or infinite: going on would only lose time.
        """
        try:
            return self.save(state, metadata, replay)
        except OSError as error:
            warnings.warn(
                f"checkpoint at {metadata['frames']} frames was not written: {error}. Training goes on; the previous "
                "checkpoint is intact.",
                stacklevel=2,
            )
            return None

    def _check_finite(self, state: Mapping[str, Any], frames: int) -> None:
        try:
            check_finite({name: state[name] for name in _WEIGHTS if name in state}, f"the agent at {frames} frames")
        except CheckpointError as error:
            complete = _complete(self.directory) if self.directory.is_dir() else []
            kept = f"{complete[-1]} is kept" if complete else "there is no earlier one"
            raise CheckpointError(
                f"no checkpoint was written, {kept}: {error}. Look for rewards that are too large, lower the learning "
                "rates, or set learner.max_grad_norm"
            ) from None

    def _free_name(self, frames: int) -> str:
        base = f"frames_{frames:012d}"
        name, copy = base, 1
        while (self.directory / name).exists():
            copy += 1
            name = f"{base}-{copy}"
        return name

    def _prune(self, newest: str) -> None:
        others = [folder for folder in _complete(self.directory) if folder.name != newest]
        for folder in others[: max(0, len(others) - (self.keep - 1))]:
            self._remove(folder)
        if (self.directory / newest / "replay").exists():
            for folder in others:
                self._remove(folder / "replay")

    def _remove(self, folder: Path) -> None:
        """Removes a folder as a whole: a process that is killed meanwhile leaves nothing that looks complete."""
        if folder.exists():
            with contextlib.suppress(OSError):
                os.rename(folder, self.directory / f".frames_removed-{folder.parent.name}-{folder.name}.partial")
            self._remove_partials()

    def _remove_partials(self) -> None:
        for stale in self.directory.glob(".frames_*.partial"):
            shutil.rmtree(stale, ignore_errors=True)


def find_checkpoint(path: Path | str) -> Path:
    """Finds a checkpoint folder.

    Args:
        path: a checkpoint, the `checkpoints` folder of a run, or the run's folder (then: its newest, in the last stage
            that has any).

    Raises:
        CheckpointError: if there is none, or it links to what lies elsewhere.
    """
    path = Path(path).expanduser()
    if (path / _STATE).is_file():
        found = path
    else:
        folder = _checkpoint_folder(path)
        complete = _complete(folder) if folder.is_dir() else []
        if not complete:
            raise CheckpointError(
                f"no checkpoint at {path}: expected a run's folder, its checkpoints/ or one folder of them"
            )
        newest = _pointed_to(folder)
        found = next((checkpoint for checkpoint in complete if checkpoint.name == newest), complete[-1])
        if not found.resolve().is_relative_to(path.resolve()):
            raise CheckpointError(f"{found} lies at {found.resolve()}: expected a checkpoint inside of {path}, no link")
    check_contained(found)
    return found


def read_state(path: Path | str, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Reads `state.pt` of a checkpoint, or a weights file, without executing anything from it.

    Args:
        path: a checkpoint folder, or a file.
        device: where tensors go.

    Raises:
        CheckpointError: if it is damaged, of another schema, would need pickle, holds weights that are not finite, or
            was trained with an option that is gone.
    """
    path = Path(path)
    file = path / _STATE if path.is_dir() else path
    state = load_state(file, device)
    if state.get("schema") != SCHEMA_VERSION:
        raise CheckpointError(
            f"{file} has schema {state.get('schema')!r}, this version of coachable reads schema {SCHEMA_VERSION}"
        )
    check_finite({name: state[name] for name in _WEIGHTS if name in state}, file)
    return {k: _without_former_options(v, file) if k in ("config", "network") else v for k, v in state.items()}


def _without_former_options(config: Any, file: Path) -> Any:
    """Return a saved configuration without options that are gone; one with another behaviour is refused."""
    if isinstance(config, list):
        return [_without_former_options(entry, file) for entry in config]
    if not isinstance(config, dict):
        return config
    for name in config.keys() & _FORMER_OPTIONS:
        if config[name] != _FORMER_OPTIONS[name]:
            raise CheckpointError(
                f"{file} was trained with {name}={config[name]}, which this version of coachable no longer has: "
                f"expected {_FORMER_OPTIONS[name]}"
            )
    return {k: _without_former_options(v, file) for k, v in config.items() if k not in _FORMER_OPTIONS}


def check_fits(saved: Mapping[str, Tensor], present: Mapping[str, Tensor], what: str, source: Path | str) -> None:
    """Compares two sets of parameters by name and shape.

    Args:
        saved: from the checkpoint.
        present: of this run.
        what: what they are, for the message ("actor").
        source: where `saved` came from.

    Raises:
        CheckpointError: naming what is missing, unexpected or shaped differently.
    """
    problems = [f"{name} is missing in the checkpoint" for name in present if name not in saved]
    problems += [f"{name} is unknown here" for name in saved if name not in present]
    for name, value in present.items():
        there = saved.get(name, value)
        if not isinstance(there, Tensor) or there.is_floating_point() != value.is_floating_point():
            problems.append(f"{name} is no tensor of {value.dtype}s in the checkpoint")
        elif there.shape != value.shape:
            problems.append(f"{name} is {tuple(there.shape)} in the checkpoint, {tuple(value.shape)} here")
    if problems:
        shown = "; ".join(problems[:6]) + (f"; and {len(problems) - 6} more" if len(problems) > 6 else "")
        raise CheckpointError(
            f"the {what} of {source} does not fit this run: {shown}. "
            "Choose the same network settings (network.*), loss and domain, or start without resume and init_from."
        )


def check_unused(directory: Path | str) -> None:
    """Makes sure before a new training starts that its folder holds no other one.

    Args:
        directory: folder of the new run.

    Raises:
        CheckpointError: if it holds checkpoints.
    """
    if _complete(_checkpoint_folder(Path(directory))):
        raise CheckpointError(
            f"{directory} holds a run already. Continue it with resume={directory}, or choose another folder with "
            "run_dir=PATH"
        )


def check_writable(directory: Path | str, required_bytes: int = 0) -> None:
    """Makes sure before a training starts that its folder can be written to and is large enough.

    Args:
        directory: created if missing.
        required_bytes: what the run is going to need.

    Raises:
        CheckpointError: saying what is wrong and what to change.
    """
    directory = Path(directory)
    probe = directory / ".write_test"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with probe.open("wb") as file:
            file.write(b"\0" * 2**20)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise CheckpointError(
            f"cannot write to {directory}: {error}. Choose another folder with run_dir=PATH"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
    free = shutil.disk_usage(directory).free
    if free < required_bytes:
        raise CheckpointError(
            f"{directory} has {free / 1e6:,.0f} MB free, checkpoints need about {required_bytes / 1e6:,.0f} MB. Choose "
            "another folder with run_dir=PATH, or leave the replay buffer out with checkpoint.replay=false"
        )


def _checkpoint_folder(run: Path) -> Path:
    """The `checkpoints` folder of a run or of its last stage that has checkpoints; the folder itself without any."""
    if (run / "checkpoints").is_dir():
        return run / "checkpoints"
    stages = [folder for folder in run.glob("stages/[1-9]*_*/checkpoints") if _complete(folder)]
    return max(stages, key=lambda folder: int(folder.parent.name.split("_")[0]), default=run)


def _complete(directory: Path) -> list[Path]:
    """Complete checkpoints, oldest first (by time of writing: a resumed run may have gone back in frames)."""
    found = [p for p in directory.glob("frames_*") if (p / _STATE).is_file()]
    return sorted(found, key=lambda p: ((p / _STATE).stat().st_mtime_ns, p.name))


def _pointed_to(folder: Path) -> str:
    """Name of the newest checkpoint, as the pointer says; it is only ever compared with names that exist."""
    pointer = folder / _LATEST
    if not pointer.is_file() or pointer.is_symlink():
        return ""
    with pointer.open("rb") as stream:
        return stream.read(100).decode(errors="replace").strip()


def _provenance() -> dict[str, Any]:
    packages = ("coachable", "torch", "torchrl", "tensordict")
    created = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    return {"schema": SCHEMA_VERSION, "created": created, "versions": {name: version(name) for name in packages}}
