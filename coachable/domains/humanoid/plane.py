"""Evaluation of the humanoid over the plane of walking speed and step length."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coachable.domain import Domain
from coachable.domains.humanoid.metrics import LENGTH_TOLERANCE, SPEED_TOLERANCE
from coachable.evaluation.evaluate import evaluate_styles
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.figures import drawing
from coachable.evaluation.style_grid import StyleGrid, markdown_table, mean_of, rows_where, write_csv
from coachable.evaluation.wording import readable
from coachable.training.weights import LoadedPolicy

LEAST_SURVIVAL = 0.9  # share of the episodes without a fall
_PANELS = {  # label, format, values at the ends of the colours
    "survived": ("episodes without a fall", ".0%", (0.0, 1.0)),
    "measured_speed": ("measured speed [m/s]", ".2f", (0.2, 1.6)),
    "measured_length": ("measured step length [m]", ".2f", (0.2, 0.75)),
}


def evaluate_gait(domain: Domain, agent: LoadedPolicy, out: Path, settings: EvaluationSettings) -> str:
    """Evaluate an agent as `evaluate_styles` does, and report which pairs of speed and step length it walks.

    Further files are `plane.csv` and `plane.png`.

    Args:
        domain: Domain humanoid_gait.
        agent: Policy and its style space.
        out: Folder for the results, created if missing.
        settings: Numbers of episodes and settings of the rollouts.

    Returns:
        The report as Markdown.
    """
    out.mkdir(parents=True, exist_ok=True)
    report, grid = evaluate_styles(domain, agent, out, settings)
    rows = plane_rows(grid)
    write_csv(rows, out / "plane.csv")
    _draw_plane(rows, out / "plane.png")
    report += _section(rows)
    (out / "report.md").write_text(report, encoding="utf-8")
    return report


def plane_rows(grid: StyleGrid) -> list[dict[str, Any]]:
    """Return the requests and measurements of each style of humanoid_gait, and whether the agent walks it.

    A style is walked if at least 90 % of the episodes end without a fall, the mean speed differs from the request by at
    most 0.15 m/s, and the mean step length by at most 0.06 m.
    """
    rows = []
    for index, cell in enumerate(grid.cells):
        survived, speed, length = (mean_of(grid.episodes[name][index]) for name in ("survived", "speed", "step_length"))
        followed = abs(speed - cell["speed"]) <= SPEED_TOLERANCE
        followed &= abs(length - cell["step_length"]) <= LENGTH_TOLERANCE
        row = {**cell, "steps_per_second": cell["speed"] / cell["step_length"], "survived": survived}
        row |= {"measured_speed": speed, "measured_length": length}
        rows.append(row | {"walked": "yes" if followed and survived >= LEAST_SURVIVAL else "no"})
    return rows


def _draw_plane(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw survival, speed and step length over the plane of requests, a column per pose; walked styles are framed."""
    poses = list(dict.fromkeys(row["pose"] for row in rows))
    speeds, lengths = (sorted({row[name] for row in rows}) for name in ("speed", "step_length"))
    with drawing(path, len(_PANELS), len(poses), size=(3.6 * len(poses), 3.2 * len(_PANELS)), grid=False) as panels:
        for line, (name, (label, form, (low, high))) in zip(panels, _PANELS.items(), strict=True):
            for panel, pose in zip(line, poses, strict=True):
                values = np.full((len(speeds), len(lengths)), np.nan)
                for row in rows_where(rows, pose=pose):
                    y, x = speeds.index(row["speed"]), lengths.index(row["step_length"])
                    values[y, x] = value = row[name]
                    walked = row["walked"] == "yes"
                    box = {"boxstyle": "square,pad=0.25", "fc": "white", "ec": "black" if walked else "none"}
                    text = "-" if np.isnan(value) else format(value, form)
                    panel.text(x, y, text, ha="center", va="center", fontsize=7, bbox=box)
                panel.imshow(values, origin="lower", aspect="auto", cmap="viridis", vmin=low, vmax=high)
                panel.set_xticks(range(len(lengths)), [f"{length:g}" for length in lengths])
                panel.set_yticks(range(len(speeds)), [f"{speed:g}" for speed in speeds])
                panel.set_title(f"{readable(pose)}: {label}", fontsize=8)
        for panel in panels[-1]:
            panel.set_xlabel("requested step length [m]")
        for panel in panels[:, 0]:
            panel.set_ylabel("requested speed [m/s]")


def _section(rows: Sequence[Mapping[str, Any]]) -> str:
    missed = rows_where(rows, walked="no")
    text = "\n## Plane of speed and step length\n\n![speed and step length](plane.png)\n\n"
    text += f"Walked: {len(rows) - len(missed)} of {len(rows)} styles, with at most {1 - LEAST_SURVIVAL:.0%} falls, "
    text += f"a speed within {SPEED_TOLERANCE:g} m/s and a step length within {LENGTH_TOLERANCE:g} m of the request.\n"
    if not missed:
        return text
    numbers = {"step_length": ".3g", "speed": ".3g", "steps_per_second": ".1f", "survived": ".0%"}
    numbers |= {"measured_speed": ".2f", "measured_length": ".3f"}
    units = {"step_length": "m", "speed": "m/s", "measured_speed": "m/s", "measured_length": "m"}
    return text + "\nThese were not walked:\n\n" + markdown_table(missed, {"pose": "", **numbers}, units)
