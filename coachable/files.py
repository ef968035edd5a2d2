"""Safe reading and writing of files: no code from a file is executed, and damage is detected."""

import contextlib
import itertools
import json
import os
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

_PLAIN = (bool, int, float, str, type(None))
_MOST_ENTRIES = 10_000_000  # of the containers of a file


class CheckpointError(RuntimeError):
    """A checkpoint or a weights file is missing, damaged, or does not fit its use."""


@contextlib.contextmanager
def refusing(source: Path | str, what: str) -> Iterator[None]:
    """Turn errors in the block into a `CheckpointError` that names the file.

    Args:
        source: The file or folder.
        what: Name of the content that is used in the block, such as "a style space".

    Raises:
        CheckpointError: For any exception but a `CheckpointError`, `OSError`, `ImportError` or a warning, which are
            raised unchanged.
    """
    try:
        yield
    except (CheckpointError, OSError, ImportError, Warning):
        raise
    except Exception as error:
        lines = str(error).strip().splitlines() or ["no reason given"]
        reason = f"{lines[0]} is missing" if isinstance(error, KeyError) else f"{type(error).__name__}: {lines[0]}"
        raise CheckpointError(
            f"{source} holds {what} that cannot be used: {reason}. Expected what this version of coachable writes."
        ) from error


@contextlib.contextmanager
def space_named(target: Path, required_bytes: int) -> Iterator[None]:
    """Add the required and the free space to the message of a failed write.

    Args:
        target: File to write, in an existing folder.
        required_bytes: Size of the file [byte].

    Raises:
        OSError: For any `OSError` in the block.
    """
    try:
        yield
    except OSError as error:
        free = shutil.disk_usage(target.parent).free
        raise OSError(
            f"cannot write {target}: it needs about {required_bytes / 1e6:,.1f} MB, {free / 1e6:,.1f} MB are free "
            f"({error.strerror or error})"
        ) from error


def tensor_bytes(value: Any) -> int:
    """Return the size of all tensors in nested containers [byte]."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, Mapping):
        return sum(map(tensor_bytes, value.values()))
    return sum(map(tensor_bytes, value)) if isinstance(value, list | tuple) else 0


def save_state(state: Mapping[str, Any], file: Path) -> None:
    """Write nested containers of tensors, numbers and strings, and sync them to disk.

    The file is a zip archive, which has a checksum of every member.

    Raises:
        CheckpointError: If `state` contains anything else, which could not be read back.
        OSError: If writing fails.
    """
    state = _written_out(dict(state))
    _check_plain(state, file.name, itertools.count(1))
    try:
        with file.open("wb") as stream:
            torch.save(state, stream)
            stream.flush()
            os.fsync(stream.fileno())
    except RuntimeError as error:  # torch's zip writer reports a failed write this way
        raise OSError("torch could not write all of it") from error


def load_state(file: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a file of `save_state`, without executing code from it.

    Raises:
        CheckpointError: If the file is missing, damaged, of another kind, or contains pickled objects.
    """
    if not file.is_file():
        raise CheckpointError(f"no such file: {file}")
    with refusing(file, "data"):
        _check_archive(file)
        try:
            state = torch.load(file, map_location=device, weights_only=True)
        except Exception as error:
            raise CheckpointError(
                f"cannot read {file}: it holds something other than tensors, numbers, strings and containers of these, "
                "which is not loaded because loading could run code"
            ) from error
        _check_plain(state, str(file), itertools.count(1))
        if not isinstance(state, dict):
            raise CheckpointError(f"{file} holds a {type(state).__name__}: expected a dictionary")
        return state


def check_finite(values: Any, source: Path | str, name: str = "") -> None:
    """Refuse NaN and infinity in the tensors of nested containers.

    Args:
        values: Containers, tensors and anything else.
        source: The file they come from, for the message.
        name: Name of `values` in the source.

    Raises:
        CheckpointError: If a tensor contains NaN or infinity; the message names it.
    """
    if isinstance(values, Tensor):
        finite = torch.isfinite(values)
        if not finite.all():
            raise CheckpointError(
                f"{source} is not usable: {int((~finite).sum())} of {values.numel()} values of {name} are NaN or "
                "infinite, expected finite ones"
            )
    elif isinstance(values, Mapping):
        for key, value in values.items():
            check_finite(value, source, f"{name}.{key}" if name else str(key))
    elif isinstance(values, list | tuple):
        for i, value in enumerate(values):
            check_finite(value, source, f"{name}.{i}")


def parse_json(text: str | bytes, what: str, longest: int) -> Any:
    """Return the content of a JSON text, which may come from anybody.

    Args:
        text: The text.
        what: What it is, for the message, such as "the message".
        longest: Largest number of characters.

    Raises:
        ValueError: If the text is longer, or not valid JSON, which has no NaN and no infinity.
    """
    if len(text) > longest:
        raise ValueError(f"{what} has {len(text):,} characters: expected at most {longest:,}")
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        raise ValueError(f"{what} is not valid JSON") from None


def _refuse_constant(constant: str) -> None:
    raise ValueError(f"{constant} is not valid JSON")


def check_contained(folder: Path, passed_over: str = "") -> None:
    """Refuse links in a folder that lead out of it, so that nothing is read or written elsewhere.

    Args:
        folder: The folder.
        passed_over: Name of folders whose own folders are not looked into, because nothing in these is used.

    Raises:
        CheckpointError: If there is such a link; the message names it.
    """
    home = folder.resolve()
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(place, name)
            if path.is_symlink() and not path.resolve().is_relative_to(home):
                raise CheckpointError(
                    f"{path} is a link to {path.resolve()}, outside of {folder}: expected a run whose files all lie in "
                    "its own folder"
                )
        if passed_over and Path(place).name == passed_over:
            folders.clear()


def write_text(file: Path, text: str) -> None:
    """Write a text file and sync it to disk."""
    with file.open("w", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())


def sync_folder(folder: Path) -> None:
    """Sync a folder's list of files to disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _check_archive(file: Path) -> None:
    """Check the archive's checksums, which torch ignores."""
    size = file.stat().st_size
    whole = False
    with contextlib.suppress(Exception), zipfile.ZipFile(file) as archive:  # damaged files raise many kinds of errors
        members = archive.infolist()
        stored = all(member.compress_type == zipfile.ZIP_STORED for member in members)  # as torch does
        whole = stored and sum(member.file_size for member in members) <= size and archive.testzip() is None
    if not whole:
        raise CheckpointError(
            f"{file} is damaged, cut short or of another kind ({size:,} bytes): expected an uncompressed archive as "
            "written by coachable, whose content agrees with its checksums"
        )


def _check_plain(value: Any, name: str, visits: Iterator[int]) -> None:
    """Refuse unusual content, and content that is much larger in use than in the file.

    Args:
        value: Containers, tensors and anything else.
        name: Name of `value`, for the message.
        visits: Count of the entries, from 1. Containers that contain each other several times have many.

    Raises:
        CheckpointError: If an entry is refused; the message names it.
    """
    if next(visits) > _MOST_ENTRIES:
        raise CheckpointError(f"{name} is one entry too many: expected at most {_MOST_ENTRIES:,} in a file")
    if isinstance(value, dict):
        for key, entry in value.items():
            _check_plain(entry, f"{name}, {key}", visits)
            if type(key) not in (str, int):
                raise CheckpointError(f"{name} has the key {key!r}: expected a string or an integer")
    elif isinstance(value, list | tuple):
        for i, entry in enumerate(value):
            _check_plain(entry, f"{name}, {i}", visits)
    elif isinstance(value, Tensor):
        if value.layout != torch.strided or value.is_meta or value.is_quantized:
            raise CheckpointError(f"{name} is a tensor of an unusual kind: expected a dense one")
        if _is_repetitive(value):
            stored, shape = value.untyped_storage().nbytes(), tuple(value.shape)
            raise CheckpointError(
                f"{name} has {stored:,} bytes for the shape {shape}: expected {tensor_bytes(value):,} bytes"
            )
    elif type(value) not in _PLAIN:
        raise CheckpointError(
            f"{name} is a {type(value).__name__}: expected tensors, numbers, strings and containers of these"
        )


def _written_out(value: Any) -> Any:
    """Return nested containers in which tensors such as expanded ones have storage for each of their numbers."""
    if isinstance(value, dict):
        return {key: _written_out(entry) for key, entry in value.items()}
    if type(value) in (list, tuple):
        return type(value)(map(_written_out, value))
    return value.contiguous() if isinstance(value, Tensor) and _is_repetitive(value) else value


def _is_repetitive(tensor: Tensor) -> bool:
    """Return whether a dense tensor has more numbers than its storage."""
    return tensor.layout == torch.strided and tensor_bytes(tensor) > tensor.untyped_storage().nbytes()
