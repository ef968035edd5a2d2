"""Trainings as parts of a comparison: each in a process of its own, continued where it was interrupted."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from coachable.training.checkpoint import CheckpointError, find_checkpoint, read_state

RECIPES = Path(__file__).resolve().parent.parent / "recipes"


def train(recipe: str, run_dir: Path, arguments: Sequence[str]) -> None:
    """Train with the preset `cpu` on one thread, unless the folder holds the end of that training.

    Args:
        recipe: name of a script in recipes/.
        run_dir: of the training.
        arguments: KEY=VALUE for the recipe, if it starts anew.
    """
    try:
        state = read_state(find_checkpoint(run_dir))
        if state["loop"]["frames"] >= state["config"]["train"]["total_frames"]:
            return
        chosen = [f"resume={run_dir}"]
    except CheckpointError:
        chosen = ["preset=cpu", f"run_dir={run_dir}", *arguments]
    chosen += ["threads.simulator=1", "threads.learner=1"]
    subprocess.run([sys.executable, str(RECIPES / f"{recipe}.py"), *chosen], check=True)
