"""A replay buffer on disk: one `.npy` file per entry, cut to what is filled, written and read in chunks."""

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

__all__ = ["read_replay", "replay_bytes", "write_replay"]

_CHUNK = 65_536  # records per copy: bounds the extra memory


def write_replay(replay: ReplayBuffer, folder: Path) -> None:
    """Writes the filled part of a buffer over a `LazyTensorStorage`, with the state of its writer, sampler, transforms.

    Args:
        replay: the buffer.
        folder: created.

    Raises:
        OSError: if writing fails.
    """
    folder.mkdir()
    storage: Any = replay.storage  # typed too narrowly in TorchRL: it takes slices and tensors
    filled = len(storage)
    index: dict[str, Any] = {"filled": filled, "capacity": storage.max_size, "entries": []}
    if filled:
        data = storage.get(slice(0, filled))
        for key, value in data.items(include_nested=True, leaves_only=True):
            path = [key] if isinstance(key, str) else list(key)
            file = ".".join(path) + ".npy"
            index["entries"].append({"key": path, "file": file})
            with (folder / file).open("wb") as stream:
                header = {"descr": np.lib.format.dtype_to_descr(_numpy(value[:1]).dtype), "fortran_order": False}
                np.lib.format.write_array_header_1_0(stream, {**header, "shape": tuple(value.shape)})
                for start in range(0, filled, _CHUNK):
                    _numpy(value[start : start + _CHUNK]).tofile(stream)
                stream.flush()
                os.fsync(stream.fileno())
    state = {name: value for name, value in replay.state_dict().items() if name != "_storage"}
    with (folder / "state.pt").open("wb") as stream:
        torch.save(state, stream)
        stream.flush()
        os.fsync(stream.fileno())
    with (folder / "index.json").open("w", encoding="utf-8") as text:
        json.dump(index, text, indent=1)
        text.flush()
        os.fsync(text.fileno())


def read_replay(replay: ReplayBuffer, folder: Path) -> int:
    """Fills an empty buffer from `write_replay`'s files.

    Args:
        replay: a new buffer, made like the saved one.
        folder: written by `write_replay`.

    Returns:
        How many records it now holds.

    Raises:
        ValueError: if the capacities differ (a ring buffer's order depends on it).
    """
    index = json.loads((folder / "index.json").read_text(encoding="utf-8"))
    storage: Any = replay.storage
    if index["capacity"] != storage.max_size:
        raise ValueError(
            f"the saved replay buffer holds {index['capacity']} records, this run's {storage.max_size}: "
            "set the same capacity (replay_capacity), or remove the checkpoint's replay folder to resume without it"
        )
    arrays = {tuple(e["key"]): np.load(folder / e["file"], mmap_mode="r", allow_pickle=False) for e in index["entries"]}
    for start in range(0, index["filled"], _CHUNK):
        stop = min(start + _CHUNK, index["filled"])
        chunk = TensorDict({}, batch_size=[stop - start])
        for key, array in arrays.items():
            chunk.set(key, torch.from_numpy(np.array(array[start:stop])))
        storage.set(torch.arange(start, stop), chunk)
    if index["filled"]:
        state = torch.load(folder / "state.pt", weights_only=True)
        # The records are in place already: the storage gets its own state.
        replay.load_state_dict({**state, "_storage": storage.state_dict()})
    return index["filled"]


def replay_bytes(env: EnvBase, keys: Iterable[NestedKey], capacity: int) -> int:
    """Size of a full buffer.

    Args:
        env: batched env whose transitions are stored.
        keys: what is stored of them.
        capacity: records.

    Returns:
        Bytes.
    """
    record = env.fake_tensordict().select(*keys, strict=False)
    values = record.values(include_nested=True, leaves_only=True)
    return capacity * sum(v.element_size() * v.numel() for v in values) // max(1, record.numel())


def _numpy(value: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(value.detach().cpu().numpy())
