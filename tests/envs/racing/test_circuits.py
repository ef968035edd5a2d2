"""Circuits: sets of them, generated ones, and races that take turns on several."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from coachable.envs.racing import RacingEnv
from coachable.envs.racing.circuit.circuits import HELD_OUT, SETS, SHIPPED, TRAINED, load_track, load_tracks
from coachable.envs.racing.circuit.profile import Envelope, speed_profiles
from coachable.envs.racing.circuit.track import clearance
from coachable.envs.racing.physics.cars import load_car
from coachable.envs.racing.race.observation import own_columns


def test_no_circuit_is_both_trained_and_held_out():
    assert SETS["training"] == SHIPPED + TRAINED and SETS["held_out"] == HELD_OUT
    assert len({*SHIPPED, *TRAINED, *HELD_OUT}) == 3 + 160 + 8


@pytest.mark.parametrize("name", ["circuit-0", "circuit-1003"])
def test_a_numbered_circuit_is_one_to_drive_on(name):
    track = load_track(name)
    load_track.cache_clear()
    assert torch.equal(load_track(name).table, track.table) and track.name == name
    assert 2250.0 < track.length < 7150.0 and 10.0 <= float(track.table[:, 5:7].sum(1).min()) <= 15.0
    assert clearance(track, apart=150.0) > 60.0
    assert 27.0 < 1.0 / float(track.table[:, 4].abs().max()) < 160.0
    assert (track.table[:, 4] > 1e-3).any() and (track.table[:, 4] < -1e-3).any()  # it turns both ways


def test_tracks_are_loaded_by_name_as_objects_and_as_sets():
    ring = load_track("ring")
    assert load_tracks("ring") == (ring,) and load_tracks(ring) == (ring,)
    assert [track.name for track in load_tracks([ring, "oval"])] == ["ring", "oval"]
    with pytest.raises(ValueError, match="no track given"):
        load_tracks([])
    with pytest.raises(ValueError, match="unknown track 'circuit-x'"):
        load_tracks(["circuit-x"])


def test_speeds_of_several_lines_are_those_of_each():
    lines = [load_track(name) for name in ("oval", "lakeside")]
    curvatures, spacings = [line.table[:, 4].numpy() for line in lines], [line.spacing for line in lines]
    envelope = Envelope(load_car("gt3"))
    both = speed_profiles(envelope, curvatures, spacings)
    for speeds, curvature, spacing in zip(both, curvatures, spacings, strict=True):
        assert speeds == pytest.approx(speed_profiles(envelope, [curvature], [spacing])[0], rel=2e-3)


def test_races_take_turns_on_the_circuits():
    env = RacingEnv(6, cars=2, track=["ring", "oval"], seed=0, episode_steps=2)
    names = [track.name for track in env.tracks]
    env.reset()
    assert names == ["ring", "oval"] and env.circuit.tolist() == [0, 1, 0]
    current = env.reset(TensorDict({"_reset": torch.tensor([[True], [False], [False]] * 2)}, [6]))
    assert env.circuit.tolist() == [1, 1, 0] and current["observation"].isfinite().all()
    alike = RacingEnv(8, cars=2, track=["ring", "oval", "lakeside"], seed=0, copies=2)
    alike.reset()
    assert alike.circuit.tolist() == [0, 1, 0, 1]


def test_a_car_drives_a_circuit_of_several_as_if_it_were_the_only_one():
    names, cars = ["ring", "lakeside", "circuit-3"], 2
    both = RacingEnv(6, cars=cars, track=names, seed=0, curvature=True)
    both.reset()
    start = both.simulator_state()
    actions = torch.rand(20, 6, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    for race, name in enumerate(names):
        alone = RacingEnv(2, cars=cars, track=name, seed=0, curvature=True)
        alone.reset()
        rows = torch.tensor([race, race + 3])
        both.load_simulator_state(start)
        alone.state, alone.group = both.state[:, rows].clone(), both.group[:, race : race + 1].clone()
        groups = alone.group
        alone.run = alone.referee.begin(alone.state, both.run[0, rows], both.run[4, rows], alone.garage.car, groups)
        alone.compound = both.compound[:, rows].clone()
        for action in actions:
            one = both.step(TensorDict({"action": action}, [6]))["next"]
            same = alone.step(TensorDict({"action": action[rows]}, [2]))["next"]
            for key in ("observation", "task_reward", "style_features", "telemetry"):
                torch.testing.assert_close(one[key][rows], same[key], atol=2e-3, rtol=1e-3)


def test_the_state_of_several_circuits_is_restored():
    env, other = (RacingEnv(4, track=["ring", "oval", "lakeside"], seed=seed, episode_steps=3) for seed in (0, 1))
    action = torch.rand(8, 4, 2, generator=torch.Generator().manual_seed(0))
    current = env.reset()
    for one in action[:4]:
        current = env.step(current.set("action", one))["next"]
    env.reset()
    other.reset()
    other.load_simulator_state(env.simulator_state())
    assert torch.equal(env.circuit, other.circuit)
    for one in action[4:6]:
        found = [e.step(TensorDict({"action": one}, [4]))["next", "observation"] for e in (env, other)]
        assert torch.equal(*found)


def test_curvature_replaces_the_place_on_the_lap():
    plain, blind = (RacingEnv(2, track="ring", seed=0, curvature=curvature) for curvature in (False, True))
    seen, seen_blind = (env.reset()["observation"] for env in (plain, blind))
    place = own_columns("place")
    assert not seen_blind[:, place.start : place.start + 2].any() and seen[:, place.start].any()
    assert torch.equal(seen[:, place.stop :], seen_blind[:, place.stop : -20])
    torch.testing.assert_close(seen_blind[:, -20:], torch.full((2, 20), 30.0 / 200.0))


def turning(name):
    """How much a circuit turns, to either side [deg/km]."""
    track = load_track(name)
    return math.degrees(float(track.table[:, 4].abs().sum()) * track.spacing) / track.length * 1000


def test_circuits_that_turn_much_are_trained_on_and_held_out():
    """The numbers of docs/domains/racing.md."""
    trained = np.array([turning(name) for name in TRAINED])
    assert np.percentile(trained[:128], [0, 50, 95, 100]) == pytest.approx([72, 116, 195, 237], abs=1)
    assert np.percentile(trained[128:], [0, 100]) == pytest.approx([197, 242], abs=1)
    held_out = {name: turning(name) for name in HELD_OUT}
    assert held_out.pop("circuit-1003") == pytest.approx(208, abs=1)
    assert held_out.pop("circuit-1006") == pytest.approx(254, abs=1)
    assert max(held_out.values()) < 130
