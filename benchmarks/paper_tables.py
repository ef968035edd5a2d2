"""Rows of the paper's tables of fights, from the results of `fight_grid` of one agent per training seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from coachable.domains.combat.coached_fight import SOURCES, STATES
from coachable.domains.combat.fights import OUTCOMES, PARTS
from coachable.envs.combat.rewards import WEAPON_OF
from coachable.envs.combat.tables import AMMO, ELEMENTS, WEAPONS, load_table
from coachable.evaluation.statistics import bootstrap_interval, wilson_interval

__all__ = [
    "KINDS",
    "WEAPON_STYLES",
    "implied_kinds",
    "matrix_rows",
    "mixture_rows",
    "obedience_rows",
    "part_rows",
    "radar_rows",
    "record_rows",
    "share_columns",
    "win_rows",
]

KINDS = (*SOURCES, *STATES)
"""Kinds of damage, the rows of the matrix: sources, then elemental states."""

WEAPON_STYLES = SOURCES[2:]
_RESAMPLES = 1000
_LEAST, _LEAST_PARTS = 1.0, 0.01  # HP and units per fight: what ratios are divided by, if there is less

Grids = Sequence[Mapping[str, np.ndarray]]
"""Results of `fight_grid` (styles, opponents, fights), one per training seed."""


def implied_kinds() -> dict[str, frozenset[str]]:
    """Return which other kinds of damage each single request implies, from the tables of weapons.

    A weapon all of whose ammunition has an element implies the states of these elements. An element that only one
    weapon has implies this weapon. Both are there without obeying a request for the implied kind.
    """
    table = load_table("weapons")
    elements = {
        style: [set(table.words(ammo, "element", ELEMENTS)) for ammo in AMMO[WEAPONS.index(weapon)]]
        for style, weapon in WEAPON_OF.items()
    }
    implied = {kind: set[str]() for kind in KINDS}
    for style, ammo in elements.items():
        if all(ammo):
            implied[style] |= set().union(*ammo)
    for element in STATES:
        carriers = [style for style, ammo in elements.items() if element in set().union(*ammo)]
        if len(carriers) == 1:
            implied[element] |= set(carriers)
    return {kind: frozenset(others) for kind, others in implied.items()}


def matrix_rows(grids: Grids, labels: Sequence[str]) -> list[dict[str, Any]]:
    """Return the mean damage per fight by kind, for each request, with 95 % bootstrap intervals.

    The intervals are those over training seeds, or over the fights of a single seed, by opponent. `share` is the share
    of all damage.

    Args:
        grids: Results of `fight_grid`, one per training seed.
        labels: Names of the requested styles.
    """
    rows = []
    for index, label in enumerate(labels):
        draws = _resampled(grids, index, KINDS)
        total = np.mean([grid["damage"][index].mean() for grid in grids])
        for number, kind in enumerate(KINDS):
            mean = float(np.mean([grid[kind][index].mean() for grid in grids]))
            low, high = np.percentile(draws[:, number], [2.5, 97.5])
            row = {"requested": label, "kind": kind, "damage": mean, "low": float(low), "high": float(high)}
            rows.append(row | {"share": mean / max(total, 1e-9)})
    return rows


def obedience_rows(grids: Grids, labels: Sequence[str]) -> list[dict[str, Any]]:
    """Return how far each request stands out in the matrix, along its row and along its column.

    `over_requests` is the damage of the requested kind over the largest one under another single request, or none, that
    does not imply the kind: a kind that is there anyway does not count as obeying. `over_kinds` is the damage of the
    requested kind over that of the largest other kind of its group, sources or states, under the same request.
    Less than 1 HP counts as 1 HP. Intervals are as in `matrix_rows`.

    Args:
        grids: Results of `fight_grid`, one per training seed.
        labels: Names of the requested styles.
    """
    implied = implied_kinds()
    draws = {label: _resampled(grids, index, KINDS) for index, label in enumerate(labels)}
    means = {
        label: np.mean([[grid[kind][index].mean() for kind in KINDS] for grid in grids], 0)
        for index, label in enumerate(labels)
    }
    single = [label for label in labels if " + " not in label]
    rows = []
    for label in single:
        if label not in KINDS:
            continue
        number = KINDS.index(label)
        others = [other for other in single if other != label and label not in implied.get(other, ())]
        group = SOURCES if label in SOURCES else STATES
        kinds = [KINDS.index(kind) for kind in group if kind != label]
        largest = max(others, key=lambda other: means[other][number])
        beside = max(kinds, key=lambda kind: means[label][kind])
        row: dict[str, Any] = {"requested": label, "damage": float(means[label][number])}
        for name, what, base, spread in (
            ("over_requests", largest, means[largest][number], draws[largest][:, number]),
            ("over_kinds", KINDS[beside], means[label][beside], draws[label][:, beside]),
        ):
            ratios = draws[label][:, number] / np.maximum(spread, _LEAST)
            low, high = np.percentile(ratios, [2.5, 97.5])
            row |= {name: float(means[label][number] / max(base, _LEAST)), f"{name}_largest": what}
            row |= {f"{name}_low": float(low), f"{name}_high": float(high)}
        rows.append(row)
    return rows


def win_rows(grids: Grids, labels: Sequence[str], opponents: Sequence[str]) -> list[dict[str, Any]]:
    """Return the share of fights won by request and opponent, with Wilson's 95 % intervals over all fights.

    Args:
        grids: Results of `fight_grid`, one per training seed.
        labels: Names of the requested styles.
        opponents: Names of the opponents.
    """
    rows = []
    for (i, label), (j, opponent) in ((a, b) for a in enumerate(labels) for b in enumerate(opponents)):
        won = np.concatenate([grid["won"][i, j] for grid in grids])
        low, high = wilson_interval(int(won.sum()), len(won))
        row = {"requested": label, "opponent": opponent, "fights": len(won), "won": float(won.mean())}
        rows.append(row | {"low": low, "high": high})
    return rows


def record_rows(grids: Grids, labels: Sequence[str], machines: Sequence[str]) -> list[dict[str, Any]]:
    """Return wins, deaths, fights out of bounds and timeouts by machine, beside the paper's record.

    Composed requests are left out. The paper's records have 1140 to 1146 fights, ours all of the grid.

    Args:
        grids: Results of `fight_grid`, one per training seed.
        labels: Names of the requested styles.
        machines: Names of the opponents.
    """
    single = [index for index, label in enumerate(labels) if " + " not in label]
    paper = load_table("paper_records")
    rows = []
    for index, machine in enumerate(machines):
        row: dict[str, Any] = {"machine": machine}
        row |= {name: int(sum(grid[name][single, index].sum() for grid in grids)) for name in OUTCOMES}
        known = machine in paper.rows
        row |= {f"paper_{name}": int(paper.number(machine, name)) if known else "" for name in OUTCOMES}
        rows.append(row)
    return rows


def radar_rows(grids: Grids, labels: Sequence[str], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return the damage per fight by weapon while the requested state was active, one row per agent and element.

    Args:
        grids: Results, one per agent.
        labels: Requests.
        names: Names of the agents.
    """
    rows = []
    for name, grid in zip(names, grids, strict=True):
        for index, label in enumerate(labels):
            if label in STATES:
                done = grid["by_state"][index, :, :, :, ELEMENTS.index(label)].mean((0, 1))
                row = {"agent": name, "requested": label, **dict(zip(SOURCES, done.tolist(), strict=True))}
                rows.append(row | {"state_damage": float(done.sum())})
    return rows


def part_rows(grids: Grids, labels: Sequence[str]) -> list[dict[str, Any]]:
    """Return the units of parts removed per fight, under the request for the type and under other single requests.

    Other requests for parts are left out of "others", because one blow often removes parts of several types. Intervals
    are as in `matrix_rows`.

    Args:
        grids: Results of `fight_grid`, one per training seed.
        labels: Names of the requested styles.
    """
    rows = []
    for part in PARTS:
        if part not in labels:
            continue
        others = [i for i, label in enumerate(labels) if " + " not in label and label not in PARTS]
        asked = _resampled(grids, labels.index(part), (part,))[:, 0]
        beside = np.mean([_resampled(grids, i, (part,))[:, 0] for i in others], 0)
        mean = float(np.mean([grid[part][labels.index(part)].mean() for grid in grids]))
        base = float(np.mean([grid[part][others].mean() for grid in grids]))
        row = {"part": part, "requested": mean, "others": base, "ratio": mean / max(base, _LEAST_PARTS)}
        for name, draws in (
            ("requested", asked),
            ("others", beside),
            ("ratio", asked / np.maximum(beside, _LEAST_PARTS)),
        ):
            low, high = np.percentile(draws, [2.5, 97.5])
            row |= {f"{name}_low": float(low), f"{name}_high": float(high)}
        rows.append(row)
    return rows


def mixture_rows(grids: Grids, mixtures: Sequence[tuple[str, str, float]]) -> list[dict[str, Any]]:
    """Return how two kinds of damage that are requested at once share it.

    `share` is the damage of the first kind over that of both, `both` the damage of both over all damage.

    Args:
        grids: Results of `fight_grid`, one per training seed, with a cell per mixture.
        mixtures: Both kinds of each mixture, and the requested share of the first.
    """
    rows = []
    for index, (first, second, requested) in enumerate(mixtures):
        both = (first, second)
        shares = {"share": ((first,), both), "both": (both, ("damage",))}
        row = {"first": first, "second": second, "requested": requested}
        rows.append(row | share_columns(grids, index, shares))
    return rows


def share_columns(
    grids: Grids, index: int, shares: Mapping[str, tuple[Sequence[str], Sequence[str]]]
) -> dict[str, float]:
    """Return shares of damage under a request, with the fights and how many of them were won.

    Shares have the 95 % bootstrap interval over fights, `won` has Wilson's (`_low`, `_high`).

    Args:
        grids: Results of `fight_grid`, one per training seed.
        index: Number of the request.
        shares: For each name of a share the measures that are summed above and below the line.
    """
    columns: dict[str, float] = {}
    for name, measures in shares.items():
        part, whole = (sum(_fights(grids, measure, index) for measure in each) for each in measures)
        fights = np.arange(len(whole))  # fights are drawn again, so that their two numbers stay together
        columns[name] = float(_ratio(part, whole, fights))
        interval = bootstrap_interval(fights, partial(_ratio, part, whole), resamples=_RESAMPLES)
        columns[f"{name}_low"], columns[f"{name}_high"] = interval
    won = _fights(grids, "won", index)
    columns |= {"fights": len(won), "won": float(won.mean())}
    columns["won_low"], columns["won_high"] = wilson_interval(int(won.sum()), len(won))
    return columns


def _fights(grids: Grids, measure: str, index: int) -> np.ndarray:
    return np.concatenate([grid[measure][index].reshape(-1) for grid in grids])


def _ratio(part: np.ndarray, whole: np.ndarray, fights: np.ndarray, axis: int = -1) -> np.ndarray:
    return part[fights].sum(axis) / np.maximum(whole[fights].sum(axis), 1e-9)


def _resampled(grids: Grids, index: int, kinds: Sequence[str]) -> np.ndarray:
    """Return bootstrap means of measures under a request, (resamples, kinds).

    Several seeds are drawn again as a whole, the same ones under every request, because requests share what a seed has
    learned. The fights of a single seed are drawn again within each opponent.
    """
    if len(grids) > 1:
        units = np.array([[[grid[kind][index].mean() for kind in kinds] for grid in grids]])
    else:
        units = np.stack([grids[0][kind][index] for kind in kinds], -1)
    opponents, count = units.shape[:2]
    random = np.random.default_rng(index if len(grids) == 1 else 0)
    weights = random.multinomial(count, np.full(count, 1.0 / count), (_RESAMPLES, opponents))
    return np.tensordot(weights, units, 2) / (opponents * count)
