"""What can be judged of a style, by hand: nothing is called met that was not measured."""

import math

import pytest
import torch
from tensordict import TensorDict

from coachable.domains.racing.metrics import RacingMeasures
from coachable.envs.racing.race.features import GAPS, OVERTAKE
from coachable.envs.racing.race.observation import own_columns
from coachable.envs.racing.race.referee import TELEMETRY

T = {name: column for column, name in enumerate(TELEMETRY)}


def race(gaps, theta):
    """One step of one car; `gaps` holds longitudinal and lateral distance [m] and near of each other car."""
    features = torch.cat([torch.zeros(GAPS), torch.tensor(gaps, dtype=torch.float32).flatten()])
    observation = torch.zeros(1, own_columns("controls").stop)
    telemetry = torch.zeros(1, len(TELEMETRY))
    after = {"observation": observation, "telemetry": telemetry, "style_features": features[None]}
    return TensorDict({"style": torch.tensor([theta]), "next": TensorDict(after, [1])}, [1])


@pytest.mark.parametrize(
    ("gaps", "judged", "kept", "longitudinal", "lateral"),
    [
        ([(30.0, 0.0, 0.0), (50.0, 3.0, 0.0)], False, False, None, None),  # nobody within 10 m
        ([(4.0, 0.0, 1.0), (6.0, 0.0, 1.0)], True, True, 4.0, None),  # two ahead, in line
        ([(0.5, 0.0, 1.0), (30.0, 0.0, 0.0)], True, False, 0.5, None),  # too close behind one
        ([(0.0, 0.3, 1.0), (0.0, 0.8, 1.0)], True, False, None, 0.3),  # between two, too close to one
        ([(0.0, 0.8, 1.0), (4.0, 0.0, 1.0)], True, True, 4.0, 0.8),
    ],
)
def test_margins_are_judged_by_cars_nearby(gaps, judged, kept, longitudinal, lateral):
    measures = RacingMeasures("aggressiveness")
    found = measures.step(race(gaps, [1.0, 0.5]))
    record = {name: value[None] for name, value in found.items()}
    assert measures.judged(record).item() is judged
    assert measures.complies(record).item() is kept
    for name, value in {"longitudinal": longitudinal, "lateral": lateral}.items():
        expected = float("nan") if value is None else value
        assert found[name].item() == pytest.approx(expected, nan_ok=True)
    assert measures.needs == "another car within 10 m"


@pytest.mark.parametrize("margins", [(0.0, 1.0), (2.0, 0.0)])
def test_a_margin_of_nothing_leaves_the_other_one(margins):
    """Cars side by side or in line overlap in one direction; those that are diagonal to each other do not."""
    measures = RacingMeasures("aggressiveness")
    gaps = {(0.0, 1.0): [(0.0, 0.4, 1.0)], (2.0, 0.0): [(1.5, 0.0, 1.0)]}[margins]
    for gap, kept in ((gaps, False), ([(1.5, 0.4, 1.0)], True)):
        record = {name: value[None] for name, value in measures.step(race(gap, [*margins])).items()}
        assert measures.complies(record).item() is kept


def test_the_smallest_gap_is_what_a_margin_is_about():
    measures = RacingMeasures("aggressiveness")
    gaps = ([(4.0, 0.0, 1.0)], [(1.5, 0.0, 1.0)], [(0.2, 0.0, 1.0)])
    found = [measures.step(race(gap, [1.0, 0.5])) for gap in gaps]
    record = {name: torch.stack([row[name] for row in found]) for name in found[0]}
    summary = measures.summarise(record, torch.tensor([[True], [True], [False]]))  # the last one does not count
    assert summary["longitudinal_least"].item() == 1.5 and summary["longitudinal"].item() == 2.75
    assert summary["lateral_least"].isnan().all()


def test_gains_are_measured_among_others_only():
    measures = RacingMeasures("resources")
    alone = measures.step(race([], [1.0, 1.0, 0.0, 0.0]))
    assert alone["overtake"].isnan().all() and alone["defend"].isnan().all()
    step = race([(4.0, 0.0, 1.0)], [1.0, 1.0, 0.0, 0.0])
    step["next", "style_features"][0, OVERTAKE] = 0.3
    assert measures.step(step)["overtake"].item() == pytest.approx(3.0)  # [m/s], of 0.1 s


def test_alone_on_the_track_no_margin_is_judged():
    measures = RacingMeasures("aggressiveness")
    found = measures.step(race([], [1.0, 0.5]))
    assert not measures.judged({name: value[None] for name, value in found.items()}).any()
    assert found["longitudinal"].isnan().all() and found["lateral"].isnan().all()


def test_driving_is_measured_in_its_units():
    step = race([], [0.0, 0.0, 100.0, 1.0])
    values = {"progress": 4.5, "speed": 46.0, "off": 1.0, "contact": 2.0, "wall": 3.0, "place": 4.0}
    for name, value in values.items():
        step["next", "telemetry"][0, TELEMETRY.index(name)] = value
    found = RacingMeasures("resources").step(step)
    assert found["pace"].item() == pytest.approx(45.0)  # [m/s], of 0.1 s
    for name in ("speed", "off", "contact", "wall", "place"):
        assert found[name].item() == values[name]


def test_savings_are_not_judged_by_single_steps():
    measures = RacingMeasures("resources")
    found = measures.step(race([], [0.0, 0.0, 100.0, 1.0]))
    assert found["complied"].isnan().all()
    assert not measures.judged({name: value[None] for name, value in found.items()}).any()
    assert "whole stints" in measures.needs


def test_slip_ratios_are_measured_where_they_are_asked_for():
    step = race([], [0.0, 0.0, 0.0, 0.0])
    step["next", "style_features"][0, :4] = torch.tensor([0.1, 0.2, 0.3, 0.4])
    found = RacingMeasures("drift").step(step)
    assert (found["slip_ratio_front"].item(), found["slip_ratio_rear"].item()) == pytest.approx((0.3, 0.4))


@pytest.mark.parametrize(
    ("degrees", "radius", "speed", "weight", "complied"),
    [
        (30.0, 50.0, 20.0, 3.0, True),
        (-30.0, -50.0, 20.0, 3.0, True),
        (10.0, 50.0, 20.0, 3.0, False),
        (70.0, 50.0, 20.0, 3.0, False),
        (180.0, 50.0, 20.0, 3.0, False),  # backwards is no drift, and no grip either
        (30.0, 50.0, 5.0, 3.0, False),
        (30.0, 1000.0, 20.0, 3.0, None),  # a request cannot be judged on a straight
        (3.0, 1000.0, 50.0, 0.0, True),
        (180.0, 1000.0, 50.0, 0.0, False),
    ],
)
def test_drifts_are_measured_by_the_true_sideslip(degrees, radius, speed, weight, complied):
    step = race([], [0.0, weight, 0.0, 0.0])
    for name, value in {"sideslip": math.radians(degrees), "curvature": 1.0 / radius, "speed": speed}.items():
        step["next", "telemetry"][0, T[name]] = value
    measures = RacingMeasures("drift")
    found = measures.step(step)
    record = {name: value[None] for name, value in found.items()}
    assert measures.judged(record).item() is (complied is not None)
    assert measures.complies(record).item() is bool(complied)
    here, there = ("corners", "straights") if abs(radius) < 250 else ("straights", "corners")
    assert found[f"sideslip_{here}"].item() == pytest.approx(abs(degrees)) and found[f"sideslip_{there}"].isnan()
    assert found[f"drift_{here}"].item() == (15 <= abs(degrees) <= 60 and speed > 8) and found[f"drift_{there}"].isnan()


def test_turning_round_is_counted_per_kilometre():
    headings = torch.tensor([0.0, 1.0, 2.0, 3.0, -3.0, -1.0, 0.0, -2.0, 0.0, 0.0])[:, None]
    nothing = torch.zeros(10, 1)
    record = {"pace": nothing + 200.0, "heading": headings, "wear": nothing, "fuel": nothing}
    found = RacingMeasures("drift").summarise(record, torch.ones(10, 1, dtype=torch.bool))
    assert found["turned_per_km"].item() == pytest.approx(2 / 0.2)  # twice in 200 m
    assert found["backwards"].item() == pytest.approx(0.4)
