"""State dicts on disk without pickle."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl.checkpoint import StateDictCheckpointAdapter

__all__ = ["load_state", "save_state"]


class _State:
    """What the checkpoint adapter takes for a component."""

    def __init__(self, state: Mapping[str, Any] | None = None) -> None:
        self.state = state

    def state_dict(self) -> Mapping[str, Any] | None:
        return self.state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.state = state


def save_state(state: Mapping[str, Any], path: Path) -> None:
    """Writes nested dicts and lists of tensors, numbers and strings as memory-mapped tensors and JSON."""
    StateDictCheckpointAdapter().save(_State(state), path, args=(), kwargs={})


def load_state(path: Path) -> Any:
    """Reads what `save_state` wrote; the tensors are mapped to the files, so clone what is kept."""
    loaded = _State()
    StateDictCheckpointAdapter().load(loaded, path, map_location="cpu", tensor_load_kwargs={}, args=(), kwargs={})
    return loaded.state
