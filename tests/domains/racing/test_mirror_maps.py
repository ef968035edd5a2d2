"""A race on a mirrored circuit, driven as in the mirror, is the mirror image of the original: shown by the simulator."""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from coachable.domains.racing.events import racing_events
from coachable.domains.racing.families import family_env, family_style
from coachable.domains.racing.mirror_maps import mirror_map, racing_mirror_maps
from coachable.envs.racing import RacingEnv
from coachable.envs.racing.circuit.circuits import load_track
from coachable.envs.racing.physics.cars import load_car
from coachable.envs.racing.physics.dynamics import WheelSet
from coachable.envs.racing.physics.state import HEATS, ROW, SPINS, WEARS
from coachable.envs.racing.race.driver import LineFollower
from coachable.envs.racing.race.features import OVERTAKE
from coachable.envs.racing.race.referee import TELEMETRY
from coachable.envs.racing.race.scenarios import race_scenarios
from coachable.signals import Signal, entry_names
from coachable.transforms import MirrorSymmetry

# Fields of the state whose sign changes.
STATE = ("y", "yaw", "vy", "yaw_rate", "steer", "ay", "steer_command")
TELEMETRY_SIGN = torch.ones(len(TELEMETRY))
for name in ("offset", "sideslip", "heading", "curvature"):
    TELEMETRY_SIGN[TELEMETRY.index(name)] = -1.0
STEPS = 250


def image(mirror, vector):
    return vector[..., list(mirror.source)] * torch.tensor(mirror.sign, dtype=vector.dtype)


def lopsided(track):
    """Return a circuit that is wider to the left of its centre line, so that the widths take part."""
    table = track.table.clone()
    table[:, 5] += 1.5
    return replace(track, table=table)


def mirrored_track(track):
    """Return the circuit in the mirror: y, ty and curvature change their sign, left and right widths swap."""
    table = track.table[:, [0, 1, 2, 3, 4, 6, 5, 7]] * torch.tensor([1.0, -1, 1, -1, -1, 1, 1, 1])
    return replace(track, table=table)


def mirrored_state(state):
    other = state.clone()
    for name in STATE:
        other[ROW[name]] *= -1
    for wheels in (SPINS, HEATS, WEARS):
        other[wheels] = state[wheels][[1, 0, 3, 2]]
    return other


def to_double(env):
    """Change an environment to double precision, in which roundings do not grow to what can be seen."""
    env.course.double()
    env.simulation.wheels = WheelSet.of(env.garage.car, dtype=torch.float64)
    env.state, env.compound = env.state.double(), env.compound.double()
    return env


def put_in_the_mirror(env, original):
    """Start the races of `env` as the mirror images of those that `original` starts."""
    env.group, env.compound, env.scenario = original.group, original.compound, original.scenario
    env.state = mirrored_state(original.state)
    for one in (env, original):
        groups = one.group if one.cars > 1 else None
        place, distance = original.run[0].double(), original.run[4].double()
        one.run = one.referee.begin(one.state, place, distance, one.garage.car, groups)


@pytest.mark.parametrize(
    "family, options",
    [
        ("drift", {}),
        ("drift", {"opponents": True, "course_points": 5}),
        ("resources", {"cars": 3, "scenarios": race_scenarios(3)}),
        ("aggressiveness", {"controlled": 5}),
        ("aggressiveness", {"controlled": 5, "car": "pool"}),
    ],
    ids=["drift", "drift with room for opponents", "resources in traffic", "aggressiveness", "cars from the pool"],
)
def test_a_mirrored_race_stays_the_mirror_image(family, options):
    track = lopsided(load_track("circuit-3"))
    settings = {"family": family, "curvature": True, "seed": 1, **options}
    here, there = (family_env(30, track=[one], **settings) for one in (track, mirrored_track(track)))
    for env in (here, there):
        env.reset()
        to_double(env)
    put_in_the_mirror(there, here)
    maps = racing_mirror_maps(here)
    seen, acted = maps["observation"], maps["action"]
    assert len(seen.source) == here.observation_size
    car = here.garage.typical
    driver = LineFollower(here.tracks, car, grip=1.05, lanes=(0.0, 1.0, -1.0))
    space, make_reward = family_style(family)
    style_reward, events = make_reward(space), racing_events(family)
    generator = torch.Generator().manual_seed(0)
    theta = space.low + (space.high - space.low) * torch.rand(30, space.dim, generator=generator)
    happened = {}
    shove = torch.zeros(30, 2)
    for step in range(STEPS):
        if step % 5 == 0:  # hands that slip now and then
            shove = torch.randn(30, 2, generator=generator) * torch.tensor([0.25, 0.6])
            shove = shove * (torch.rand(30, 1, generator=generator) < 0.4)
        action = (driver(here.field, here._observation) + shove).clamp(-1.0, 1.0).float()
        after, reflected = (
            env.step(TensorDict({"action": value}, [30]))["next"]
            for env, value in ((here, action), (there, image(acted, action)))
        )
        close = {"atol": 1e-5, "rtol": 1e-5, "check_dtype": False}
        expected = image(seen, after["observation"])
        if not torch.allclose(expected, reflected["observation"], atol=1e-5, rtol=1e-5):
            apart = (expected - reflected["observation"]).abs().amax(0)
            names = entry_names(here.observation_groups)
            raise AssertionError(f"step {step}: {[names[i] for i in (apart > 1e-5).nonzero()[:, 0]]}, by {apart.max()}")
        for key in ("style_features", "task_reward"):
            torch.testing.assert_close(reflected[key], after[key], **close)
        torch.testing.assert_close(reflected["telemetry"], after["telemetry"] * TELEMETRY_SIGN, **close)
        rewards = [style_reward(one["style_features"].float(), theta) for one in (after, reflected)]
        torch.testing.assert_close(*rewards, atol=1e-2, rtol=1e-4)
        assert torch.equal(after["done"], reflected["done"])
    print(happened)
