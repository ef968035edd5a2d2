"""A race on a mirrored circuit, driven as in the mirror, is the mirror image of the original in every number."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from tensordict import TensorDict

from coachable.domains.racing.events import SLIDE, racing_events
from coachable.domains.racing.families import family_env, racing_family
from coachable.domains.racing.mirror_maps import racing_mirror_maps
from coachable.envs.racing import RacingEnv
from coachable.envs.racing.circuit.circuits import load_track
from coachable.envs.racing.physics.cars import Resources
from coachable.envs.racing.physics.dynamics import WheelSet
from coachable.envs.racing.physics.state import HEATS, ROW, SPINS, WEARS
from coachable.envs.racing.race.driver import LineFollower
from coachable.envs.racing.race.features import GAPS
from coachable.envs.racing.race.referee import TELEMETRY
from coachable.envs.racing.race.run import Run
from coachable.envs.racing.race.scenarios import Conditions, race_scenarios
from coachable.signals import Signal, entry_names
from coachable.transforms.mirror import mirror_map

STEPS = 200
WORN = Conditions.resources()
TURNED = ("y", "yaw", "vy", "yaw_rate", "steer", "ay", "steer_command")  # fields of the state whose sign changes
TURNED_TELEMETRY = ("offset", "sideslip", "heading", "curvature")


def image(mirror, vector):
    return vector[..., list(mirror.source)] * torch.tensor(mirror.sign, dtype=vector.dtype)


def circuit_and_its_image():
    """Return a circuit that is wider to the left of its centre line, and its mirror image."""
    track = load_track("circuit-3")
    table = track.table.clone()
    table[:, 5] += 1.5
    mirrored = table[:, [0, 1, 2, 3, 4, 6, 5, 7]] * torch.tensor([1.0, -1, 1, -1, -1, 1, 1, 1])
    return [replace(track, table=table), replace(track, table=mirrored)]


def start_in_pairs(env):
    """Start every odd race as the mirror image of the one before it.

    In double precision roundings do not grow to what can be seen.
    """
    env.reset()
    env.course.double()
    if env.garage.pooled:
        env.garage.model[1::2] = env.garage.model[0::2]
        env.garage._assemble()
    env.simulation.wheels = WheelSet.of(env.garage.car, dtype=torch.float64)
    env.simulation.set_cars(env.garage.car)
    state, compound, run = (
        value.double().unflatten(1, env.group.shape) for value in (env.state, env.compound, env.run)
    )
    other = state[..., 0::2].clone()
    for name in TURNED:
        other[ROW[name]] *= -1
    for wheels in (SPINS, HEATS, WEARS):
        other[wheels] = state[wheels, :, 0::2][[1, 0, 3, 2]]
    state[..., 1::2] = other
    for value in (compound, run, env.group):
        value[..., 1::2] = value[..., 0::2]
    env.state, env.compound = state.flatten(1), compound.flatten(1)
    begun = Run(*run.flatten(1).unbind(0))
    env.run = env.referee.begin(env.state, begun.s, begun.distance, env.garage.car, env._groups)


@pytest.mark.parametrize(
    "family, cars, make_env",
    [
        ("drift", 1, partial(family_env, family="drift", course_points=5)),
        ("resources", 3, partial(family_env, family="resources")),
        ("aggressiveness", 5, partial(RacingEnv, car="pool", conditions=WORN, resources=Resources.calibrated("gt3"))),
    ],
)
def test_a_mirrored_race_stays_the_mirror_image(family, cars, make_env):
    options = {"scenarios": race_scenarios(cars, {"passing": 0.5, "slipstream": 0.5})} if cars > 1 else {}
    env = make_env(6 * cars, cars=cars, track=circuit_and_its_image(), curvature=True, seed=1, **options)
    start_in_pairs(env)
    maps, names = racing_mirror_maps(env), entry_names(env.observation_groups)
    mirror = maps["observation"]
    changes = torch.tensor([mirror.sign[i] < 0 or mirror.source[i] != i for i in range(env.observation_size)])
    driver = LineFollower(env.tracks, env.garage.typical, grip=1.05, lanes=(0.0, 1.0, -1.0))
    space, events = racing_family(family).make_space(), racing_events(family)
    style_reward = racing_family(family).make_reward(space)
    generator = torch.Generator().manual_seed(0)
    theta = space.low + (space.high - space.low) * torch.rand(3 * cars, space.dim, generator=generator)
    sign = torch.ones(len(TELEMETRY), dtype=torch.float64)
    sign[[TELEMETRY.index(name) for name in TURNED_TELEMETRY]] = -1
    happened, varied = set(), torch.zeros(env.observation_size, dtype=torch.bool)

    def halves(value):
        """Return the rows of the original races, and those of their images."""
        split = value.unflatten(0, env.group.shape)
        return split[:, 0::2].flatten(0, 1), split[:, 1::2].flatten(0, 1)

    for step in range(STEPS):
        if step % 5 == 0:  # hands that slip now and then
            shove = torch.randn(3 * cars, 2, generator=generator) * torch.tensor([0.3, 0.7])
            shove = shove * (torch.rand(3 * cars, 1, generator=generator) < 0.4)
        wanted = (halves(driver(env.field, env._observation))[0] + shove).clamp(-1.0, 1.0).float()
        action = torch.stack([wanted.unflatten(0, (cars, 3)), image(maps["action"], wanted).unflatten(0, (cars, 3))], 2)
        after = env.step(TensorDict({"action": action.flatten(0, 2)}, [6 * cars]))["next"]
        seen, mirrored = halves(after["observation"])
        varied |= (seen != 0).any(0)
        apart = (image(mirror, seen) - mirrored).abs().amax(0)
        assert (apart < 1e-5).all(), (step, [(names[i], float(apart[i])) for i in (apart >= 1e-5).nonzero()[:, 0]])
        here, there = halves(after["style_features"])
        torch.testing.assert_close(here[:, :GAPS], there[:, :GAPS], atol=1e-5, rtol=1e-5)
        # A spin amplifies the rounding of the yaw, which counts times the distance in gaps to cars far away.
        torch.testing.assert_close(here[:, GAPS:], there[:, GAPS:], atol=1e-3, rtol=1e-5)
        torch.testing.assert_close(*halves(after["task_reward"]), atol=1e-5, rtol=1e-5)
        here, there = halves(after["telemetry"])
        torch.testing.assert_close(here * sign, there, atol=1e-5, rtol=1e-5)
        features = [value.float() for value in halves(after["style_features"])]
        torch.testing.assert_close(*(style_reward(value, theta) for value in features), atol=1e-3, rtol=1e-4)
        assert torch.equal(*halves(after["done"]))
        told = halves(events(TensorDict({"next": after}, [6 * cars])))
        assert torch.equal(*told)
        happened |= {name for name, flag in zip(events.names, told[0].any(0), strict=True) if flag}
        slides = (here[:, TELEMETRY.index("speed")] > 20.0) & (features[0][:, 1] > SLIDE)
        happened |= {"fast slide"} if slides.any() else set()
    assert happened == {*events.names, "fast slide"}
    assert cars < 5 or varied[changes].all(), "no entry that the mirror changes was always 0"


def test_the_place_on_the_lap_has_no_mirror_image():
    with pytest.raises(
        ValueError, match=r"need env.curvature=true: without it the observation has the place on the lap"
    ):
        racing_mirror_maps(RacingEnv(1, track="ring"))


def test_unknown_blocks_are_refused():
    with pytest.raises(ValueError, match="block 'wind' has no mirror image: expected one of motion, fuel"):
        mirror_map([Signal("fuel", 1), Signal("wind", 2)], {"motion": (), "fuel": ()})
