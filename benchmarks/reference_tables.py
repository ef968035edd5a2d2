"""Machines, weapons, policy heads, rewards and styles as tables, with the origin of every number."""

from __future__ import annotations

from typing import Any

from coachable.envs.combat.gamepad import AXES, HEADS
from coachable.envs.combat.tables import load_table

__all__ = ["head_rows", "reference_tables"]

_FILES = {
    "table_machines": "machines",
    "table_weapons": "weapons",
    "table_traps": "traps",
    "table_task_rewards": "task_rewards",
    "table_style_rewards": "style_terms",
    "table_styles": "styles",
}
_PAPER_DIMS = {  # Table "Policy head outputs"; an axis has a location and a scale
    "axes": 8,
    "face": 4,
    "dpad": 6,
    "left_shoulder": 3,
    "right_shoulder": 3,
    "left_mode": 2,
    "right_mode": 2,
}


def reference_tables() -> dict[str, list[dict[str, Any]]]:
    """Return the tables by name; the columns end in the origin of their numbers, "(paper)" or "(ours)"."""
    return {name: _rows(file) for name, file in _FILES.items()} | {"table_heads": head_rows()}


def _rows(file: str) -> list[dict[str, Any]]:
    table = load_table(file)
    return [
        {"name": name} | {f"{column} ({table.origin[column]})": row[column] for column in table.origin}
        for name, row in table.rows.items()
    ]


def head_rows() -> list[dict[str, Any]]:
    """Return the outputs of the policy by component, and how many the paper has."""
    values = {"axes": AXES, **HEADS}
    ours = {"axes": 2 * len(AXES)} | {name: len(support) for name, support in HEADS.items()}
    return [
        {"component": name, "support": " ".join(values[name]), "outputs": ours[name], "outputs (paper)": count}
        for name, count in _PAPER_DIMS.items()
    ]
