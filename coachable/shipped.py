"""Agents that ship with the library, and what a name means: a shipped agent or a file; imports no torch."""

import zipfile
from pathlib import Path

SOURCE_HELP = "a run's folder, a checkpoint, a weights file, an exported model, or a domain that ships with weights"

_PRETRAINED = Path(__file__).resolve().parent / "pretrained"
_OF_RUNS = ("state.pt", "frames_*", "checkpoints", "stages")  # in the folder of a run or a checkpoint


def shipped_agents() -> list[str]:
    """Return the names of the agents that ship with weights."""
    return sorted(path.parent.name for path in _PRETRAINED.glob("*/weights.pt"))


def located(source: Path | str) -> Path:
    """Return the file or folder that a source names; the weights if it is the name of a shipped agent.

    A file of this name, or a folder that holds a run or a checkpoint, goes before the shipped agent. Any other folder
    does not.
    """
    path = Path(source).expanduser()
    if str(source) not in shipped_agents() or path.is_file() or any(any(path.glob(name)) for name in _OF_RUNS):
        return path
    return _PRETRAINED / str(source) / "weights.pt"


def require_agent(source: str) -> None:
    """Check that a source from the command line can be an agent.

    Raises:
        ValueError: If it cannot; the message lists the agents that ship with weights.
    """
    shipped, path = shipped_agents(), Path(source).expanduser()
    if source in shipped or (source and path.is_dir()):
        return
    names = ", ".join(shipped)
    if not source or not path.exists():
        raise ValueError(f"there is no agent {source!r}: expected {SOURCE_HELP} ({names})")
    if not source.endswith(".onnx") and not zipfile.is_zipfile(path):
        raise ValueError(f"{source} is not a weights file: expected {SOURCE_HELP} ({names})")
