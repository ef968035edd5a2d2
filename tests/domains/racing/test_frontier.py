"""The dynamic programme: limits, monotone trade-offs, calibration."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from coachable.domains.racing import frontier
from coachable.domains.racing.frontier import SPEEDS, TANK, THROTTLE, WORN, LapProgramme
from coachable.envs.racing.circuit.circuits import load_track
from coachable.envs.racing.circuit.profile import Envelope, speed_profiles
from coachable.envs.racing.circuit.track import Track
from coachable.envs.racing.physics.cars import Resources, load_car
from coachable.envs.racing.physics.powertrain import drive_wheels
from coachable.envs.racing.race.driver import line_geometry


@pytest.fixture
def long_stages(monkeypatch):
    """Half as many stages of a lap."""
    monkeypatch.setattr(frontier, "STAGE", 2 * frontier.STAGE)


@pytest.fixture
def coarse_speeds(monkeypatch, long_stages):
    """A quarter as many: enough to compare prices."""
    monkeypatch.setattr(frontier, "SPEEDS", frontier.SPEEDS[::4])


def lakeside(car):
    """A car's programme on the centre line, and the lap that pays for nothing."""
    track = load_track("lakeside")
    programme = LapProgramme(track, load_car(car), Resources(1.0, 1.0), line=np.zeros(len(track.table)))
    [free] = programme.laps("fuel", [0.0])
    return programme, free


@pytest.mark.parametrize(("name", "expected"), [("gt3", 113.9), ("x2019", 88.8)])
def test_centre_line_laps_are_those_of_the_specification(name, expected):
    """An independent calculation of the centre line gave 113.9 s and 88.8 s in quasi-steady state."""
    _, free = lakeside(name)
    track = load_track("lakeside")
    curvature, spacing = line_geometry(track, None)
    [speed] = speed_profiles(Envelope(load_car(name)), [curvature], [spacing])
    assert np.sum(2 * spacing / (speed + np.roll(speed, -1))) == pytest.approx(expected, rel=0.01)
    assert free.time == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("car, resource", [("gt3", "tyre"), ("x2019", "fuel")])
def test_a_higher_price_saves_more_and_costs_more(car, resource, coarse_speeds):
    programme, free = lakeside(car)
    scale = {"tyre": free.wear, "fuel": free.fuel}[resource]
    laps = programme.laps(resource, [0.0, 3.0 / scale, 30.0 / scale])
    times = [lap.time for lap in laps]
    used = [{"tyre": lap.wear, "fuel": lap.fuel}[resource] for lap in laps]
    assert times[0] == pytest.approx(free.time, abs=1e-9)
    assert all(a < b for a, b in pairwise(times))
    assert all(a > b for a, b in pairwise(used))


def test_a_heavier_car_is_slower_and_wears_its_tyres_more(coarse_speeds):
    [light], [heavy] = (frontier.sweep("x2019", "tyre", [], **fuel) for fuel in ({}, {"fuel": 100.0}))  # half a tank
    assert heavy["lap_time"] > light["lap_time"] and heavy["wear_per_lap"] > light["wear_per_lap"]


def test_a_ring_is_driven_at_the_speed_that_friction_allows():
    """Radius 200 m: the lap of a steady speed, to the width of the speed grid."""
    track, car = load_track("ring"), load_car("gt3")
    envelope = Envelope(car)
    speed = speed_profiles(envelope, [np.full(len(track.table), 1 / 200.0)], [track.spacing])[0].mean()
    programme = LapProgramme(track, car, Resources(1.0, 1.0), line=np.zeros(len(track.table)))
    [lap] = programme.laps("tyre", [0.0])
    assert lap.time == pytest.approx(track.length / speed, rel=0.01)


def test_hairpins_are_driven(long_stages):
    turns = [(100.0, 180.0, 14.0), (200.0, 180.0, 14.0), (100.0, 0.0, 14.0)]
    track, car = Track.from_turns(turns, width=8.0, margin=3.0), load_car("street")
    profile = speed_profiles(Envelope(car), [track.table[:, 4].numpy()], [track.spacing])[0]
    [lap] = LapProgramme(track, car, Resources(1.0, 1.0), line=np.zeros(len(track.table))).laps("fuel", [0.0])
    assert lap.time == pytest.approx((track.spacing / profile).sum(), rel=0.1)


@pytest.mark.parametrize("car", ["gt3", "x2019"])
def test_a_stint_lasts_about_ten_laps(car, long_stages):
    """An uncoached lap: the fastest of the programme on its own line."""
    programme = LapProgramme(load_track("lakeside"), load_car(car), Resources.calibrated(car))
    [lap] = programme.laps("fuel", [0.0])
    assert TANK / lap.fuel == pytest.approx(10.0, abs=1.0)
    assert WORN / lap.wear == pytest.approx(10.0, abs=1.0)


def test_coasting_and_full_throttle_are_the_simulators():
    """In third gear at 56 % and 90 % of the highest engine speed, the latter at the engine's full power."""
    track, car, h = load_track("ring"), load_car("gt3"), 0.01
    programme = LapProgramme(track, car, Resources(1.0, 3.0), line=np.zeros(len(track.table)))
    pedal = torch.tensor([0.0, 1.0], dtype=torch.float64)
    gear, tank = torch.full_like(pedal, 3.0), torch.full_like(pedal, 30.0)
    omega = torch.tensor([0.56, 0.9], dtype=torch.float64) * car.rpm_max * 2 * math.pi / 60
    wheels = omega / (car.gears[2] * car.final_drive)
    drive = drive_wheels(car, Resources(1.0, 3.0), pedal, wheels, gear, 0.0 * pedal, tank, h)
    assert drive.gear.tolist() == [3.0, 3.0]  # no shift
    braking = (drive.resistance * wheels)[0].item() / programme.envelope.mass / SPEEDS  # power over momentum
    np.testing.assert_allclose(programme._pull[:, 0], -braking)
    np.testing.assert_allclose(programme._pull[:, -1], programme.envelope.engine(SPEEDS))
    burnt = (tank - drive.fuel) / h
    np.testing.assert_allclose(programme._fuel_rate[[0, len(THROTTLE) - 1]], burnt, rtol=1e-6)


def test_bad_input_is_refused():
    programme = LapProgramme(load_track("ring"), load_car("gt3"), Resources())
    with pytest.raises(ValueError, match="unknown resource 'brakes': expected tyre or fuel"):
        programme.laps("brakes", [0.0])
    with pytest.raises(ValueError, match="no calibrated wear and fuel rates of 'street': expected one of gt3, x2019"):
        Resources.calibrated("street")
