"""Figures of an evaluation, drawn without a display."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from coachable.evaluation.style_grid import StyleGrid, mean_of, measured_column
from coachable.styles import Choice, Setpoint, StyleSpace, Weight

_LABELS = {"survived": "episodes without a fall", "pose_held": "steps in pose", "forward_speed": "forward speed [m/s]"}
_SHARES = ("survived", "pose_held")
# Distinguishable without colour as well.
_MARKERS = "osD^vP*X"


def draw_style_grid(grid: StyleGrid, space: StyleSpace, path: Path, title: str, panels: Sequence[str]) -> None:
    """Requested against measured style, and what it costs, one line per option of the space's choice.

    Args:
        grid: the evaluation.
        space: its style space, with one set-point or weight on the horizontal axis.
        path: PNG file to write.
        title: above the figure.
        panels: further metrics to draw over the same axis.
    """
    axis = next(p for p in space.parameters if isinstance(p, Setpoint | Weight))
    choice = next((p for p in space.parameters if isinstance(p, Choice)), None)
    groups: list[Any] = list(choice.options) if choice else [None]
    rows = grid.rows()
    names = [name for name in (axis.name, *panels) if name in grid.episodes]
    figure, axes = plt.subplots(1, len(names), figsize=(4.2 * len(names), 3.8), squeeze=False, layout="constrained")
    unit = f" [{axis.unit}]" if axis.unit else ""
    for panel, name in zip(axes[0], names, strict=True):
        for index, group in enumerate(groups):
            cells = [i for i, cell in enumerate(grid.cells) if choice is None or cell[choice.name] == group]
            x = np.array([grid.cells[i][axis.name] for i in cells])
            column = measured_column(name, grid.cells[0])
            values = np.array([mean_of(grid.episodes[name][i]) for i in cells])
            spread = np.array([[rows[i][f"{column}_low"], rows[i][f"{column}_high"]] for i in cells])
            offset = (index - (len(groups) - 1) / 2) * 0.004 * (axis.high - axis.low) / 0.35
            error = np.abs(spread - values[:, None]).T
            panel.errorbar(x + offset, values, error, marker=_MARKERS[index], label=readable(group), capsize=2, ms=5)
        if name == axis.name:
            panel.plot([axis.low, axis.high], [axis.low, axis.high], color="0.6", ls="--", lw=1, label="as requested")
            panel.set_ylabel(f"measured {readable(name)}{unit}")
        else:
            panel.set_ylabel(_LABELS.get(name, readable(name)))
            if name in _SHARES:
                panel.set_ylim(-0.03, 1.05)
        panel.set_xlabel(f"requested {readable(axis.name)}{unit}")
        panel.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def readable(name: Any) -> str:
    """A name as people write it."""
    return str(name).replace("_", " ")
