"""Files of a replay buffer: its records, and the state of its writer, sampler and transforms."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from coachable.files import load_state, refusing, save_state
from coachable.replay.records import read_records, write_records


def write_replay(replay: ReplayBuffer, folder: Path) -> None:
    """Write the filled part of a buffer over a `LazyTensorStorage`, with the state of its writer, sampler, transforms.

    Args:
        replay: The buffer. Slots of an `EventTableBuffer` that were never written are zeros in the files.
        folder: The folder to write to, created if missing.

    Raises:
        OSError: If writing fails.
    """
    folder.mkdir(parents=True, exist_ok=True)
    regions = getattr(replay, "regions", None)
    write_records(replay.storage, folder, None if regions is None else regions.unused())
    save_state({name: value for name, value in replay.state_dict().items() if name != "_storage"}, folder / "state.pt")


def read_replay(replay: ReplayBuffer, folder: Path) -> int:
    """Fill a buffer from `write_replay`'s files, without executing anything from them.

    Args:
        replay: A buffer made like the saved one; a ring buffer must be empty.
        folder: Folder written by `write_replay`.

    Returns:
        Number of records in the buffer.

    Raises:
        CheckpointError: If files are missing or damaged, or the capacities differ.
    """
    storage: Any = replay.storage  # typed too narrowly in TorchRL: it takes slices and tensors
    state = load_state(folder / "state.pt")  # needed without records, too, because steps may be held back
    filled = read_records(storage, folder)
    with refusing(folder / "state.pt", "the state of a replay buffer"):
        # The storage already contains the records, so it gets its own state.
        replay.load_state_dict({**state, "_storage": storage.state_dict()})
    return filled


def replay_bytes(replay: ReplayBuffer, env: EnvBase, keys: Iterable[NestedKey]) -> int:
    """Return the size of a full buffer [bytes] of the entries `keys` of an environment's transitions."""
    transitions = env.fake_tensordict().select(*keys, strict=False)
    values = transitions.values(include_nested=True, leaves_only=True)
    record = sum(v.element_size() * v.numel() for v in values) // max(1, transitions.numel())
    if hasattr(replay, "regions"):
        record += torch.int64.itemsize
    return replay.storage.max_size * record
