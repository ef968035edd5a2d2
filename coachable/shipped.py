"""Agents that ship with the library, and what a name means: a shipped agent or a file; imports no torch."""

from __future__ import annotations

from pathlib import Path

__all__ = ["located", "shipped_agents"]

_PRETRAINED = Path(__file__).resolve().parent / "pretrained"
_OF_RUNS = ("state.pt", "frames_*", "checkpoints", "stages")  # in the folder of a run or a checkpoint


def shipped_agents() -> list[str]:
    """Return the names of the agents that ship with weights."""
    return sorted(path.parent.name for path in _PRETRAINED.glob("*/weights.pt"))


def located(source: Path | str) -> Path:
    """Return the file or folder that a source names; the weights if it is the name of a shipped agent.

    A file of this name, or a folder that holds a run or a checkpoint, goes before the shipped agent. Any other folder
    does not.

    Args:
        source: Path, or name of a shipped agent.
    """
    path = Path(source).expanduser()
    if str(source) not in shipped_agents() or path.is_file() or any(any(path.glob(name)) for name in _OF_RUNS):
        return path
    return _PRETRAINED / str(source) / "weights.pt"
