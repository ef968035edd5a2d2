"""Checkpoints, which are written atomically, read without pickle, and rejected with a reason if they do not fit.

A checkpoint is a folder with `state.pt` (tensors, numbers, strings, containers: `torch.load(weights_only=True)`), a
readable `metadata.json` and, in the newest one, the replay buffer under `replay/`.
"""

import contextlib
import fcntl
import itertools
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

SCHEMA_VERSION = 1
_LATEST = "LATEST"
_STATE = "state.pt"
_WEIGHTS = ("actor", "critics", "learner")  # parts of a state that must be finite
_claimed: dict[Path, int] = {}  # descriptors of the folders that this process has locked


class CheckpointStore:
    """Checkpoints of one run.

    Args:
        directory: Folder of the checkpoints, created when the first one is written.
        keep: Number of checkpoints to keep; older ones are removed after a new one is complete.
        replay: Whether the newest checkpoint contains the replay buffer, which an exact resumption needs.

    Raises:
        ValueError: If `keep` is below 1.
    """

    def __init__(self, directory: Path | str, keep: int = 3, replay: bool = True) -> None:
        if keep < 1:
            raise ValueError(f"checkpoint.keep must be at least 1, got {keep}")
        self.directory = Path(directory)
        self.keep = keep
        self.replay = replay

    def save(self, state: Mapping[str, Any], metadata: Mapping[str, Any], replay: Any | None = None) -> Path:
        """Write one checkpoint atomically.

        The files are written to a hidden folder, which is synced to disk and then renamed. A process that is killed at
        any moment therefore leaves the previous checkpoint intact.

        Args:
            state: Content of `state.pt`.
            metadata: Content of `metadata.json`; must contain `frames`.
            replay: Replay buffer; saved if this store keeps replay buffers.

        Returns:
            The checkpoint's folder.

        Raises:
            CheckpointError: If a weight is NaN or infinite. Nothing is written.
            OSError: If writing fails (disk full, no permission). The message names the space that is needed, and the
                partial checkpoint is removed.
        """
        self._check_finite(state, int(metadata["frames"]))
        self.directory.mkdir(parents=True, exist_ok=True)
        replay = replay if self.replay else None
        required_bytes = tensor_bytes(state) + (0 if replay is None else record_bytes(replay.storage))
        self._remove_partials()  # a killed process may have left some, which take up space
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
                self.point_to(name)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        self._prune(name)
        return self.directory / name

    def point_to(self, name: str) -> None:
        """Make a complete checkpoint the one from which the run is resumed."""
        pointer = self.directory / f".{_LATEST}.partial"
        write_text(pointer, name + "\n")
        os.replace(pointer, self.directory / _LATEST)
        sync_folder(self.directory)

    def try_save(self, state: Mapping[str, Any], metadata: Mapping[str, Any], replay: Any | None = None) -> Path | None:
        """Call `save`, but warn and return None if writing fails, because a full disk should not end a long training.

        Raises:
            CheckpointError: If a weight is NaN or infinite.
        """
        try:
            return self.save(state, metadata, replay)
        except OSError as error:
            warnings.warn(
                f"checkpoint at {metadata['frames']} frames was not written: {error}. A previous one is intact.",
                stacklevel=2,
            )
            return None

    def _check_finite(self, state: Mapping[str, Any], frames: int) -> None:
        try:
            check_finite({name: state[name] for name in _WEIGHTS if name in state}, f"the agent at {frames} frames")
        except CheckpointError as error:
            complete = _complete(self.directory)
            kept = f"{complete[-1]} is kept" if complete else "there is no earlier one"
            raise CheckpointError(
                f"no checkpoint was written, {kept}: {error}. Look for rewards that are too large, lower the learning "
                "rates, or set learner.max_grad_norm"
            ) from None

    def _free_name(self, frames: int) -> str:
        base = f"frames_{frames:012d}"
        names = (base if copy == 1 else f"{base}-{copy}" for copy in itertools.count(1))
        return next(name for name in names if not (self.directory / name).exists())

    def _prune(self, newest: str) -> None:
        others = [folder for folder in _complete(self.directory) if folder.name != newest]
        for folder in others[: max(0, len(others) - (self.keep - 1))]:
            self._remove(folder)
        if (self.directory / newest / "replay").exists():
            for folder in others:
                self._remove(folder / "replay")

    def remove_replay(self) -> None:
        """Remove the replay buffer, which takes up most of a checkpoint's space; weights and settings stay."""
        for folder in _complete(self.directory):
            self._remove(folder / "replay")

    def _remove(self, folder: Path) -> None:
        """Rename a folder before removing it, so that a process killed meanwhile leaves nothing that looks complete."""
        if folder.exists():
            with contextlib.suppress(OSError):
                os.rename(folder, self.directory / f".frames_removed-{folder.parent.name}-{folder.name}.partial")
            self._remove_partials()

    def _remove_partials(self) -> None:
        for stale in self.directory.glob(".frames_*.partial"):
            shutil.rmtree(stale, ignore_errors=True)


def find_checkpoint(path: Path | str) -> Path:
    """Return the folder of a checkpoint.

    Args:
        path: A checkpoint, the `checkpoints` folder of a run, or a run's folder. In the latter two cases the newest
            checkpoint is returned, in a run with stages that of the last stage that has one.

    Raises:
        CheckpointError: If there is no checkpoint, or it links to files elsewhere.
    """
    path = Path(path).expanduser()
    if (path / _STATE).is_file():
        found = path
    else:
        folder = _checkpoint_folder(path)
        complete = _complete(folder)
        if not complete:
            raise CheckpointError(
                f"no checkpoint at {path}: expected a run's folder, its checkpoints/, or a folder in there"
            )
        newest = _pointed_to(folder)
        found = next((checkpoint for checkpoint in complete if checkpoint.name == newest), complete[-1])
        if not found.resolve().is_relative_to(path.resolve()):
            raise CheckpointError(f"{found} lies at {found.resolve()}: expected a checkpoint inside {path}, not a link")
    check_contained(found)
    return found


def read_state(path: Path | str, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read `state.pt` of a checkpoint's folder, or a weights file, without executing anything from it.

    Raises:
        CheckpointError: If the file is damaged, has another schema, would need pickle, or contains weights that are not
            finite.
    """
    path = Path(path)
    file = path / _STATE if path.is_dir() else path
    state = load_state(file, device)
    if state.get("schema") != SCHEMA_VERSION:
        raise CheckpointError(
            f"{file} has schema {state.get('schema')!r}, this version of coachable reads schema {SCHEMA_VERSION}"
        )
    check_finite({name: state[name] for name in _WEIGHTS if name in state}, file)
    return state


def check_fits(saved: Mapping[str, Tensor], present: Mapping[str, Tensor], what: str, source: Path | str) -> None:
    """Check that two sets of parameters have the same names and shapes.

    Args:
        saved: Parameters of the checkpoint.
        present: Parameters of this run.
        what: Name of the set for the message, such as "actor".
        source: File of `saved`.

    Raises:
        CheckpointError: If a parameter is missing, unexpected or of another shape.
    """
    problems = [f"{name} is missing in the checkpoint" for name in present if name not in saved]
    problems += [f"{name} is unknown here" for name in saved if name not in present]
    for name, value in present.items():
        there = saved.get(name, value)
        if not isinstance(there, Tensor) or there.is_floating_point() != value.is_floating_point():
            problems.append(f"{name} is not a tensor of {value.dtype} in the checkpoint")
        elif there.shape != value.shape:
            problems.append(f"{name} is {tuple(there.shape)} in the checkpoint, {tuple(value.shape)} here")
    if problems:
        shown = "; ".join(problems[:6]) + (f"; and {len(problems) - 6} more" if len(problems) > 6 else "")
        raise CheckpointError(
            f"the {what} of {source} does not fit this run: {shown}. "
            "Choose the same network settings (network.*), loss and domain, or start without resume and init_from."
        )


def check_unused(directory: Path | str) -> None:
    """Check that the folder of a new run contains no checkpoints, and no settings of something else.

    Raises:
        CheckpointError: If it contains checkpoints, or a `config.json` that is not a run's.
    """
    config = Path(directory) / "config.json"
    if config.exists() and not _is_config(config):
        raise CheckpointError(f"{config} is not the configuration of a run: choose another folder with run_dir=PATH")
    if _complete(_checkpoint_folder(Path(directory))):
        raise CheckpointError(
            f"{directory} holds a run already. Continue it with resume={directory}, or choose another folder with "
            "run_dir=PATH"
        )


def _is_config(file: Path) -> bool:
    try:
        return "domain" in json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return False


def check_writable(directory: Path | str, required_bytes: int = 0) -> None:
    """Check that a run's folder can be written to and has enough space.

    Args:
        directory: The folder, created if missing.
        required_bytes: Space that the run is going to need [bytes].

    Raises:
        CheckpointError: If writing fails or the space is too small.
    """
    directory = Path(directory)
    probe = directory / ".write_test"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_text(probe, "\0" * 2**20)
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


def claim_folder(directory: Path | str) -> None:
    """Keep trainings of other processes out of a run's existing folder until this process ends.

    A file system without locks does not prevent the training.

    Raises:
        CheckpointError: If another process has claimed it.
    """
    directory = Path(directory).resolve()
    if directory in _claimed:
        return
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise CheckpointError(
            f"another training is writing to {directory}. Wait until it ends, or choose another folder with "
            "run_dir=PATH"
        ) from None
    except OSError:
        pass
    _claimed[directory] = descriptor


def _checkpoint_folder(run: Path) -> Path:
    """Return the `checkpoints` folder of a run, or of its last stage that has checkpoints, or the run's folder."""
    if (run / "checkpoints").is_dir():
        return run / "checkpoints"
    stages = [folder for folder in run.glob("stages/[1-9]*_*/checkpoints") if _complete(folder)]
    return max(stages, key=lambda folder: int(folder.parent.name.split("_")[0]), default=run)


def _complete(directory: Path) -> list[Path]:
    """Return complete checkpoints by time of writing, because a resumed run may have gone back in frames."""
    found = [p for p in directory.glob("frames_*") if (p / _STATE).is_file()]
    return sorted(found, key=lambda p: ((p / _STATE).stat().st_mtime_ns, p.name))


def _pointed_to(folder: Path) -> str:
    """Return the name in the file `LATEST`, or an empty string."""
    pointer = folder / _LATEST
    if not pointer.is_file() or pointer.is_symlink():
        return ""
    with pointer.open("rb") as stream:
        return stream.read(100).decode(errors="replace").strip()


def _provenance() -> dict[str, Any]:
    versions = {name: version(name) for name in ("coachable", "torch", "torchrl", "tensordict")}
    created = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    return {"schema": SCHEMA_VERSION, "created": created, "versions": versions}
