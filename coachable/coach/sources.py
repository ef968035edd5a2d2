"""Whether there is an agent that the command line names; torch, whose import takes seconds, is not imported."""

from __future__ import annotations

import zipfile
from pathlib import Path

from coachable.shipped import shipped_agents

__all__ = ["SOURCE_HELP", "require_agent"]

SOURCE_HELP = "a run's folder, a checkpoint, a weights file, an exported model, or a domain that ships with weights"


def require_agent(source: str) -> None:
    """Check that a source can be an agent.

    Args:
        source: What the command line names.

    Raises:
        ValueError: If it cannot; the message lists the agents that ship with weights.
    """
    shipped = shipped_agents()
    if source in shipped or (source and Path(source).is_dir()):
        return
    names = ", ".join(shipped)
    if not source or not Path(source).exists():
        raise ValueError(f"there is no agent {source!r}: expected {SOURCE_HELP} ({names})")
    if not source.endswith(".onnx") and not zipfile.is_zipfile(source):
        raise ValueError(f"{source} is no weights file: expected {SOURCE_HELP} ({names})")
