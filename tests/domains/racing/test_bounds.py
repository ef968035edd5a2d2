"""Bounds of racing: which of them are reached, from rows whose values are known."""

import math

import numpy as np
import pytest

from coachable.domains.racing.bounds import (
    bound,
    bounds_report,
    bounds_summary,
    drift_bounds,
    lap_bounds,
    levels_apart,
    rank_interval,
    saving_bounds,
    traffic_bounds,
)


def reached(rows):
    return [row["reached"] for row in rows]


def test_a_bound_is_reached_at_its_value():
    assert (
        bound("x", 0.9 - 1e-15, at_least=0.9)["reached"] == bound("x", -0.9 + 1e-15, at_most=-0.9)["reached"] == "yes"
    )
    assert bound("x", 0.89, at_least=0.9)["reached"] == bound("x", -0.89, at_most=-0.9)["reached"] == "no"
    assert bound("x", math.nan, at_least=0.9)["reached"] == bound("x", math.nan, at_most=0.9)["reached"] == "no"


def test_the_report_counts_what_is_reached():
    rows = [bound("laps", 0.97, (0.95, 0.99), at_least=0.95), bound("turns", 2.0, at_most=1.0)]
    text = bounds_report(rows)
    assert "1 of 2 are reached." in text
    assert "| laps | at least 0.95 | 0.97 | [0.95, 0.99] | yes |" in text
    assert "| turns | at most 1 | 2 |  | no |" in text
    assert bounds_summary(rows) == {"laps": 0.97, "turns": 2.0}


def test_laps_on_held_out_circuits_and_at_home():
    lap = {"over_low": 0.02, "over_high": 0.04}
    circuits = [
        {"circuit": "home", "trained": "yes", "clean_laps": 1.0, "over": 0.03, **lap},
        {"circuit": "other", "trained": "yes", "clean_laps": 0.0, "over": 0.9, **lap},
        {"circuit": "new", "trained": "no", "clean_laps": 1.0, "over": 0.04, **lap},
        {"circuit": "newer", "trained": "no", "clean_laps": 0.8, "over": 0.10, **lap},
    ]
    clean, over, home = lap_bounds(circuits, "home")
    assert (clean["measured"], clean["low"], clean["high"]) == pytest.approx((0.9, 0.8, 1.0))
    assert over["measured"] == pytest.approx(0.07) and (home["measured"], home["low"], home["high"]) == (
        0.03,
        0.02,
        0.04,
    )
    assert reached([clean, over, home]) == ["no", "yes", "yes"]
    circuits[3]["over"] = math.nan  # nobody finished a lap there
    clean, over, home = lap_bounds(circuits, "home")
    assert (
        math.isnan(over["measured"])
        and math.isnan(over["low"])
        and reached([clean, over, home])
        == [
            "no",
            "no",
            "yes",
        ]
    )


def test_range_gained_for_seconds_lost():
    common = {"range_gain_low": 0.3, "range_gain_high": 0.6, "seconds_lost_low": 1.0, "seconds_lost_high": 5.0}
    stints = [
        {"circuit": track, "resource": resource, "range_gain": gain, "seconds_lost": lost, **common}
        for track in ("home", "new")
        for resource, full in (("fuel", (0.39, 3.9)), ("tyre", (0.31, 4.1)))
        for gain, lost in ((0.0, 0.0), full)
    ]
    rows = saving_bounds(stints)
    assert reached(rows) == 2 * ["no", "yes", "yes", "no"]
    assert rows[0]["quantity"] == "fuel: range gained on home" and rows[0]["low"] == 0.3


def test_the_worst_race_decides():
    fine = {"sweep": "overtake", "metres": 1.0, "apart": "yes", "contacts": 1.0}
    assert reached(traffic_bounds([fine, fine])) == ["yes", "yes", "yes"]
    assert reached(traffic_bounds([fine, fine | {"metres": 0.8}])) == ["no", "yes", "yes"]
    assert reached(traffic_bounds([fine, fine | {"apart": "no"}])) == ["yes", "no", "yes"]
    assert reached(traffic_bounds([fine, fine | {"contacts": 1.6}])) == ["yes", "yes", "no"]
    assert traffic_bounds([]) == []


def sweep(angles, **measured):
    rows = []
    for weight, angle in enumerate(angles):
        row = {"sideslip": angle, "sideslip_corners": angle, "pace_kept": 0.8, "turned_per_km": 0.1}
        row |= {"drift_corners": 0.6, "drift_straights": 0.1, **measured}
        row |= {
            f"{name}_{end}": value + step for name, value in row.items() for end, step in (("low", -1), ("high", 1))
        }
        rows.append({"weight": float(weight), **row})
    return rows


def test_drifts():
    assert reached(drift_bounds(sweep([3, 6, 9, 20]), 3.0)) == 7 * ["yes"]
    assert reached(drift_bounds(sweep([5, 6, 9, 50]), 3.0)) == ["no", "yes", "no", "yes", "yes", "yes", "no"]
    slow = sweep([3, 6, 9, 20], pace_kept=0.4, turned_per_km=2.0, drift_straights=0.3)
    assert reached(drift_bounds(slow, 3.0)) == ["yes", "yes", "yes", "no", "no", "no", "yes"]
    never = drift_bounds(sweep([3, 6, 9, 20], drift_straights=0.0), 3.0)
    assert never[4]["measured"] == math.inf and never[4]["reached"] == "yes"
    nowhere = drift_bounds(sweep([3, 6, 9, 20], drift_corners=0.0, drift_straights=0.0), 3.0)
    assert math.isnan(nowhere[4]["measured"]) and nowhere[4]["reached"] == "no"


def test_levels_rise_by_more_than_their_intervals():
    assert levels_apart(sweep([0, 3, 6, 9]), "sideslip") == 4
    assert levels_apart(sweep([0, 1, 2, 3, 4, 5]), "sideslip") == 2
    assert levels_apart(sweep([9, 6, 3, 0]), "sideslip") == 1
    assert levels_apart(sweep([0, 9, 3, 6]), "sideslip") == 3  # without the 9
    assert levels_apart([], "sideslip") == 0


def test_the_interval_of_a_rank_correlation():
    generator = np.random.default_rng(1)
    requested = np.arange(5.0)
    noise = generator.normal(size=(5, 200))
    low, high = rank_interval(requested, noise - 10.0 * requested[:, None])
    assert (low, high) == pytest.approx((-1.0, -1.0))
    low, high = rank_interval(requested, noise)
    assert low < 0.0 < high
    assert all(map(math.isnan, rank_interval(requested, np.zeros((5, 9)))))
