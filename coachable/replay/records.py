"""Records of a replay buffer on disk: one `.npy` file with a checksum per entry, written and read in chunks."""

import json
import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from coachable.files import CheckpointError, refusing, write_text

_VERSION = 2
_INDEX = "index.json"
_CHUNK = 65_536  # records per copy, which limits the extra memory


def write_records(storage: Any, folder: Path, unused: np.ndarray | None = None) -> None:
    """Write the filled part of a `TensorStorage`.

    Args:
        storage: Storage of a replay buffer.
        folder: An existing folder.
        unused: Whether each slot was never written, `(len(storage),)` bool. Such slots are zeros in the files, because
            their content is undefined and equal buffers must have equal files.

    Raises:
        OSError: If writing fails.
    """
    filled = len(storage)
    unused = np.zeros(filled, dtype=bool) if unused is None else unused
    index: dict[str, Any] = {"version": _VERSION, "filled": filled, "capacity": storage.max_size, "entries": []}
    data = storage.get(slice(0, filled)).items(include_nested=True, leaves_only=True) if filled else ()
    for key, value in data:
        path = [key] if isinstance(key, str) else list(key)
        dtype = np.lib.format.dtype_to_descr(_numpy(value[:1]).dtype)
        crc = 0
        with (folder / _file(path)).open("wb") as stream:
            header = {"descr": dtype, "fortran_order": False, "shape": tuple(value.shape)}
            np.lib.format.write_array_header_1_0(stream, header)
            for start in range(0, filled, _CHUNK):
                chunk, stray = _numpy(value[start : start + _CHUNK]), unused[start : start + _CHUNK]
                if stray.any():
                    chunk = chunk.copy()  # the chunk may share the storage's memory
                    chunk[stray] = 0
                crc = zlib.crc32(chunk.data, crc)
                chunk.tofile(stream)
            stream.flush()
            os.fsync(stream.fileno())
        index["entries"].append({"key": path, "dtype": dtype, "shape": list(value.shape), "crc32": crc})
    write_text(folder / _INDEX, json.dumps(index, indent=1))


def read_records(storage: Any, folder: Path) -> int:
    """Fill a storage from `write_records`'s files.

    Args:
        storage: Storage of a buffer made like the saved one. If reading fails, it may contain a part of the records.
        folder: Folder written by `write_records`.

    Returns:
        Number of records read.

    Raises:
        CheckpointError: If files are missing, damaged or named outside the folder, or the capacities differ, on which
            the order of a ring buffer depends.
    """
    if not (folder / _INDEX).is_file():
        raise CheckpointError(f"no such file: {folder / _INDEX}, which lists the records of the replay buffer")
    with refusing(folder / _INDEX, "a list of records"):
        index = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
        if index.get("version") != _VERSION:
            raise ValueError(f"it has version {index.get('version')!r}, expected {_VERSION}")
        filled, capacity = index["filled"], index["capacity"]
    if capacity != storage.max_size:
        raise CheckpointError(
            f"the replay buffer in {folder} holds {capacity} records, this run's {storage.max_size}: set the same "
            f"capacity (replay_capacity), or remove {folder} to resume without it"
        )
    with refusing(folder, "records"):
        arrays = {tuple(entry["key"]): _array(folder, entry, filled) for entry in index["entries"]}
        if bool(arrays) != bool(filled):
            raise ValueError(f"there are {len(arrays)} entries of {filled} records")
        found = dict.fromkeys(arrays, 0)
        for start in range(0, filled, _CHUNK):
            stop = min(start + _CHUNK, filled)
            chunk = TensorDict({}, batch_size=[stop - start])
            for key, array in arrays.items():
                values = np.array(array[start:stop], order="C")
                found[key] = zlib.crc32(values.data, found[key])
                chunk.set(key, torch.from_numpy(values))
            storage.set(torch.arange(start, stop), chunk)
    for entry in index["entries"]:
        if found[tuple(entry["key"])] != entry["crc32"]:
            raise CheckpointError(
                f"{folder / _file(entry['key'])} is damaged: its content does not agree with its checksum in {_INDEX}. "
                f"Resume from another checkpoint, or remove {folder} to resume without the replay buffer"
            )
    return filled


def record_bytes(storage: Any) -> int:
    """Return the size of a storage's records on disk [bytes]."""
    if not len(storage):
        return 0
    first = storage.get(slice(0, 1))
    return len(storage) * sum(v.numel() * v.element_size() for v in first.values(True, True))


def _array(folder: Path, entry: dict[str, Any], filled: int) -> np.ndarray:
    file = folder / _file(entry["key"])
    if not file.is_file():
        raise CheckpointError(f"no such file: {file}, which {_INDEX} names")
    try:
        array = np.lib.format.open_memmap(file, mode="r")  # refuses arrays of objects, which would need pickle
    except ValueError as error:
        raise CheckpointError(f"{file} is damaged or not an array of numbers: {error}") from error
    expected = entry["dtype"], tuple(entry["shape"])
    if (np.lib.format.dtype_to_descr(array.dtype), array.shape) != expected or array.shape[0] != filled:
        raise CheckpointError(
            f"{file} holds {array.dtype.str} of shape {array.shape}: {_INDEX} says {expected[0]} of shape {expected[1]}"
        )
    return array


def _file(key: list[str]) -> str:
    """Return the name of an entry's file, which is never outside its folder."""
    name = ".".join(key) + ".npy"
    if Path(name).name != name:
        raise CheckpointError(f"{name!r} is not the name of a file of records: expected one without folders")
    return name


def _numpy(value: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(value.detach().cpu().numpy())
