"""Bounds that racing agents should reach, beside what was measured, with intervals."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coachable.evaluation.statistics import bootstrap_interval, rank_correlation
from coachable.evaluation.style_grid import markdown_table, rows_where

Row = Mapping[str, Any]

CLEAN = 0.95  # smallest share of clean laps on held-out circuits
OVER_HELD_OUT, OVER_HOME = 0.08, 0.04  # largest lap time above the quasi-steady state, as a share of it
FOLLOWS = 0.9  # smallest rank correlation of a style with what it asks for
RANGE_GAIN = {"fuel": 0.4, "tyre": 0.3}  # smallest gain at the largest weight
SECONDS_LOST = 4.0  # [s], largest loss per lap at the largest weight
CONTACTS = 1.5  # largest time in contact at the largest weight, over that at the smallest
NEUTRAL_DEG = 4.0  # [deg], largest sideslip without a request
MIDDLE_DEG = (15.0, 45.0)  # [deg], sideslip in corners at a middle request
PACE_KEPT = 0.5  # smallest share of the pace at a middle request
CORNERS_OVER_STRAIGHTS = 3.0  # smallest ratio of the shares of time that the car drifts there
TURNED_PER_KM = 1.0  # most turns at a middle request
LEVELS = 4  # fewest weights whose sideslips differ by more than their intervals
_RESAMPLES = 500  # of the rank correlations
_ROUNDING = 1e-9  # of rank correlations


def bound(
    quantity: str,
    measured: float,
    interval: tuple[float, float] = (math.nan, math.nan),
    *,
    at_least: float | None = None,
    at_most: float | None = None,
) -> dict[str, Any]:
    """Return a row of `bounds_report`.

    Args:
        quantity: What was measured, with its unit.
        measured: The measured value; if it is NaN, the bound is not reached.
        interval: Its 95 % interval; NaN if there is none.
        at_least: Smallest value that reaches the bound.
        at_most: Largest value that does; give one of the two.
    """
    asked = f"at least {at_least:g}" if at_least is not None else f"at most {at_most:g}"
    if at_least is not None:
        reached = measured >= at_least - _ROUNDING
    else:
        reached = at_most is not None and measured <= at_most + _ROUNDING
    low, high = interval
    row = {"quantity": quantity, "asked": asked, "measured": float(measured), "low": low, "high": high}
    return row | {"reached": "yes" if reached else "no"}


def bounds_report(rows: Sequence[Row]) -> str:
    """Return the section on bounds of a report as Markdown, from rows of `bound`."""
    shown = [
        {"quantity": row["quantity"], "asked": row["asked"], "measured": f"{row['measured']:.4g}"}
        | {"interval": "" if math.isnan(row["low"]) else f"[{row['low']:.4g}, {row['high']:.4g}]"}
        | {"reached": row["reached"]}
        for row in rows
    ]
    reached = len(rows_where(rows, reached="yes"))
    text = f"\n## Bounds\n\n{reached} of {len(rows)} are reached.\n\n"
    return text + markdown_table(shown, dict.fromkeys(shown[0], ""))


def bounds_summary(rows: Sequence[Row]) -> dict[str, float]:
    """Return the measured values of rows of `bound` by quantity, for `summary.json`."""
    return {row["quantity"]: row["measured"] for row in rows}


def lap_bounds(circuits: Sequence[Row], home: str) -> list[dict[str, Any]]:
    """Return the bounds of laps on held-out circuits and on the agent's own.

    Intervals of held-out circuits are over circuits, as a new circuit would differ; those of the own one over laps.

    Args:
        circuits: Rows of `drive_circuits`.
        home: Name of the circuit of the family, or of the only one of the training.
    """
    unseen, own = rows_where(circuits, trained="no"), rows_where(circuits, circuit=home)
    rows = []
    if unseen:
        clean, over = (np.array([row[name] for row in unseen]) for name in ("clean_laps", "over"))
        label = f"{len(unseen)} held-out circuits"
        # A circuit without a lap after the first one makes the mean NaN: the bound is then not reached.
        interval = (math.nan, math.nan) if np.isnan(over).any() else bootstrap_interval(over)
        rows += [
            bound(f"clean laps on {label}", clean.mean(), bootstrap_interval(clean), at_least=CLEAN),
            bound(f"lap over quasi-steady state on {label}", over.mean(), interval, at_most=OVER_HELD_OUT),
        ]
    for row in own:
        interval = row["over_low"], row["over_high"]
        rows.append(bound(f"lap over quasi-steady state on {home}", row["over"], interval, at_most=OVER_HOME))
    return rows


def saving_bounds(stints: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the bounds of range gained and time lost at the largest weights, on each circuit.

    Args:
        stints: Rows of stints by circuit, resource and weight, see `evaluate_resources`.
    """
    rows = []
    for circuit, resource in dict.fromkeys((row["circuit"], row["resource"]) for row in stints):
        full = rows_where(stints, circuit=circuit, resource=resource)[-1]
        for name, unit, limit in (
            ("range_gain", "range gained", {"at_least": RANGE_GAIN[resource]}),
            ("seconds_lost", "seconds lost per lap", {"at_most": SECONDS_LOST}),
        ):
            interval = full[f"{name}_low"], full[f"{name}_high"]
            rows.append(bound(f"{resource}: {unit} on {circuit}", full[name], interval, **limit))
    return rows


def traffic_bounds(response: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the bounds of overtaking and defending from `traffic_response`: the worst of all starts and savers."""
    rows = []
    for sweep in dict.fromkeys(row["sweep"] for row in response):
        own = rows_where(response, sweep=sweep)
        kinds = f"{sweep}, {len(own)} kinds of races"
        ranks, contacts = (np.array([row[name] for row in own]) for name in ("metres", "contacts"))
        rows += [
            bound(f"{kinds}: lowest rank correlation", ranks.min(), at_least=FOLLOWS),
            bound(f"{kinds}: ends apart", len(rows_where(own, apart="yes")), at_least=len(own)),
            bound(f"{kinds}: most contacts over those at 0", contacts.max(), at_most=CONTACTS),
        ]
    return rows


def drift_bounds(sweep: Sequence[Row], middle: float) -> list[dict[str, Any]]:
    """Return the bounds of drifting, for the rows of one sweep of `evaluate_drift`.

    Args:
        sweep: Rows by weight, with the intervals of the measures.
        middle: Weight of a middle request.
    """

    def measured(name: str, weight: float) -> tuple[float, tuple[float, float]]:
        [row] = rows_where(sweep, weight=weight)
        return row[name], (row[f"{name}_low"], row[f"{name}_high"])

    angle, straights = "sideslip_corners", measured("drift_straights", middle)[0]
    corners = measured("drift_corners", middle)[0]
    ratio = corners / straights if straights else math.inf if corners else math.nan
    at = f"at weight {middle:g}"
    asked = [row for row in sweep if row["weight"] >= 0.0]
    return [
        bound("sideslip without a request [deg]", *measured("sideslip", 0.0), at_most=NEUTRAL_DEG),
        bound(f"sideslip in corners {at} [deg]", *measured(angle, middle), at_least=MIDDLE_DEG[0]),
        bound(f"the same, not too large {at} [deg]", *measured(angle, middle), at_most=MIDDLE_DEG[1]),
        bound(f"pace kept {at}", *measured("pace_kept", middle), at_least=PACE_KEPT),
        bound(f"drift in corners over straights {at}", ratio, at_least=CORNERS_OVER_STRAIGHTS),
        bound(f"turned per km {at}", *measured("turned_per_km", middle), at_most=TURNED_PER_KM),
        bound("levels whose intervals are apart", levels_apart(asked, angle), at_least=LEVELS),
    ]


def levels_apart(rows: Sequence[Row], measure: str) -> int:
    """Return the largest number of rows whose 95 % intervals are apart and rise from one to the next.

    Args:
        rows: Rows in the order of the request, with `measure_low` and `measure_high`.
        measure: Name of the measure.
    """
    longest: list[int] = []
    for index, row in enumerate(rows):
        below = (longest[i] for i in range(index) if rows[i][f"{measure}_high"] < row[f"{measure}_low"])
        longest.append(1 + max(below, default=0))
    return max(longest, default=0)


def rank_interval(margins: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the rank correlation of a request with the means of what it asks for.

    Args:
        margins: Requested values (n,).
        values: Measured values (n, episodes), of which each row is resampled by itself.
    """
    generator = np.random.default_rng(0)
    count = values.shape[1]
    ranks = [
        rank_correlation(margins, np.take_along_axis(values, generator.integers(0, count, values.shape), 1).mean(1))
        for _ in range(_RESAMPLES)
    ]
    low, high = np.nanpercentile(ranks, [2.5, 97.5]) if not np.isnan(ranks).all() else (math.nan, math.nan)
    return float(low), float(high)
