"""The paper's figures of fights, from the rows of `paper_tables`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from paper_tables import KINDS, WEAPON_STYLES

from coachable.domains.combat.coached_fight import SOURCES, STATES
from coachable.evaluation.figures import MARKERS, draw_heat_map, drawing
from coachable.evaluation.wording import readable

__all__ = ["draw_matrix", "draw_mixtures", "draw_pareto", "draw_parts", "draw_radars", "draw_wins"]

Rows = Sequence[Mapping[str, Any]]


def draw_matrix(rows: Rows, path: Path) -> None:
    """Draw the mean damage by kind (rows) under each request (columns) (paper).

    Args:
        rows: Result of `matrix_rows`.
        path: PNG file to write.
    """
    labels = list(dict.fromkeys(row["requested"] for row in rows))
    damage = {(row["kind"], row["requested"]): row["damage"] for row in rows}
    values = np.array([[damage[kind, label] for label in labels] for kind in KINDS])
    kinds, labels = list(map(readable, KINDS)), list(map(readable, labels))
    draw_heat_map(path, values, kinds, labels, ".0f", "mean damage per fight [HP]", row_line=len(SOURCES))


def draw_wins(rows: Rows, path: Path, trained: int) -> None:
    """Draw the share of fights won by request (rows) and opponent (columns) (paper).

    Args:
        rows: Result of `win_rows`.
        path: PNG file to write.
        trained: Number of opponents that the agents were trained on, which come first.
    """
    labels = list(dict.fromkeys(row["requested"] for row in rows))
    opponents = list(dict.fromkeys(row["opponent"] for row in rows))
    won = {(row["requested"], row["opponent"]): row["won"] for row in rows}
    values = np.array([[won[label, opponent] for opponent in opponents] for label in labels])
    labels, opponents = list(map(readable, labels)), list(map(readable, opponents))
    draw_heat_map(path, values, labels, opponents, ".0%", "share of fights won", column_line=trained, high=1.0)


def draw_radars(rows: Rows, path: Path) -> None:
    """Draw which weapons do the damage in each requested state, with a radar per agent (paper).

    Args:
        rows: Result of `radar_rows`.
        path: PNG file to write.
    """
    agents = list(dict.fromkeys(row["agent"] for row in rows))
    angles = np.linspace(0.0, 2 * np.pi, len(WEAPON_STYLES), endpoint=False)
    closed = np.append(angles, angles[0])
    options: dict[str, Any] = {"subplot_kw": {"projection": "polar"}}
    with drawing(path, 1, len(agents), size=(0.8 + 4.2 * len(agents), 4.6), **options) as panels:
        for panel, agent in zip(panels[0], agents, strict=True):
            for number, row in enumerate(row for row in rows if row["agent"] == agent):
                done = np.array([row[weapon] for weapon in WEAPON_STYLES])
                line = {"label": row["requested"], "marker": MARKERS[number % len(MARKERS)], "ms": 4}
                panel.plot(closed, np.append(done, done[0]), color=f"C{STATES.index(row['requested'])}", **line)
            panel.set_xticks(angles, [readable(weapon).replace(" ", "\n") for weapon in WEAPON_STYLES], fontsize=8)
            panel.tick_params(axis="y", labelsize=7)
            panel.set_title(f"{agent}: HP in the state per fight", fontsize=9)
        panels[0, -1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.1, 1.1))


def draw_parts(rows: Rows, path: Path) -> None:
    """Draw the parts removed per fight when they are requested and when something else is (paper).

    Args:
        rows: Result of `part_rows`.
        path: PNG file to write.
    """
    places = np.arange(len(rows))
    with drawing(path, size=(5.0, 3.2)) as ((axes,),):
        for shift, name in ((-0.2, "requested"), (0.2, "others")):
            heights = np.array([row[name] for row in rows])
            ends = np.array([[row[f"{name}_low"], row[f"{name}_high"]] for row in rows])
            axes.bar(places + shift, heights, 0.38, yerr=np.abs(ends.T - heights), capsize=3, label=name)
        axes.set_xticks(places, [f"{readable(row['part'])}\nratio {row['ratio']:.2f}" for row in rows])
        axes.set_ylabel("units removed per fight")
        axes.legend(fontsize=8)


def draw_pareto(rows: Rows, path: Path) -> None:
    """Draw fights won over the style score as a style's weight falls from its maximum to 0 (paper).

    Args:
        rows: Rows with `style`, `weight`, `style_score` and `won`, and the ends `_low` and `_high` of the last two.
        path: PNG file to write.
    """
    with drawing(path, size=(6.4, 4.4)) as ((axes,),):
        for number, style in enumerate(dict.fromkeys(row["style"] for row in rows)):
            points = [row for row in rows if row["style"] == style]
            x, y = (np.array([point[name] for point in points]) for name in ("style_score", "won"))
            errors = [
                np.abs(np.array([[p[f"{name}_low"], p[f"{name}_high"]] for p in points]).T - values)
                for name, values in (("style_score", x), ("won", y))
            ]
            line = {"marker": MARKERS[number % len(MARKERS)], "ms": 4, "lw": 1, "elinewidth": 0.6}
            axes.errorbar(x, y, errors[1], errors[0], label=readable(style), **line)
            axes.annotate("0", (x[0], y[0]), fontsize=7, xytext=(3, 3), textcoords="offset points")
        axes.set(xlabel="style score: share of the damage that counts", ylabel="fights won")
        axes.set_xlim(-0.03, 1.03)
        axes.set_ylim(None, 1.03)
        axes.legend(fontsize=8)


def draw_mixtures(rows: Rows, path: Path) -> None:
    """Draw the measured over the requested share of two kinds of damage that are requested at once.

    Args:
        rows: Result of `mixture_rows`.
        path: PNG file to write.
    """
    with drawing(path, size=(5.6, 4.4)) as ((axes,),):
        axes.plot([0, 1], [0, 1], color="0.7", lw=1, ls="--")
        for number, pair in enumerate(dict.fromkeys((row["first"], row["second"]) for row in rows)):
            points = [row for row in rows if (row["first"], row["second"]) == pair]
            x, y, low, high = (
                np.array([p[n] for p in points]) for n in ("requested", "share", "share_low", "share_high")
            )
            line = {"marker": MARKERS[number % len(MARKERS)], "ms": 4, "lw": 1, "elinewidth": 0.6}
            label = f"{readable(pair[0])}, not {readable(pair[1])}"
            axes.errorbar(x, y, np.abs(np.stack([low, high]) - y), label=label, **line)
        axes.set(xlabel="requested share of the first weapon", ylabel="its share of the damage of both")
        axes.set_xlim(-0.03, 1.03)
        axes.set_ylim(-0.03, 1.03)
        axes.legend(fontsize=8)
