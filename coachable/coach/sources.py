"""Where an agent is that the command line names; torch, whose import takes seconds, is not imported."""

from __future__ import annotations

import zipfile
from pathlib import Path

__all__ = ["SOURCE_HELP", "located", "require_agent"]

SOURCE_HELP = "a run's folder, a checkpoint, a weights file, an exported model, or a domain that ships with weights"
_PRETRAINED = Path(__file__).resolve().parent.parent / "pretrained"
_OF_RUNS = ("state.pt", "frames_*", "checkpoints", "stages")  # in the folder of a run or a checkpoint


def located(source: str) -> str:
    """Return a source, or a shipped agent's weights if a folder of its name is in the way that holds no run.

    Args:
        source: What the command line names.
    """
    folder = Path(source)
    if source in _shipped() and folder.is_dir() and not any(any(folder.glob(name)) for name in _OF_RUNS):
        return str(_PRETRAINED / source / "weights.pt")
    return source


def require_agent(source: str) -> None:
    """Check that a source can be an agent.

    Args:
        source: What the command line names.

    Raises:
        ValueError: If it cannot; the message lists the agents that ship with weights.
    """
    shipped = _shipped()
    if source in shipped or (source and Path(source).is_dir()):
        return
    names = ", ".join(shipped)
    if not source or not Path(source).exists():
        raise ValueError(f"there is no agent {source!r}: expected {SOURCE_HELP} ({names})")
    if not source.endswith(".onnx") and not zipfile.is_zipfile(source):
        raise ValueError(f"{source} is no weights file: expected {SOURCE_HELP} ({names})")


def _shipped() -> list[str]:
    """Return the names of the agents that ship with weights."""
    return sorted(path.parent.name for path in _PRETRAINED.glob("*/weights.pt"))
