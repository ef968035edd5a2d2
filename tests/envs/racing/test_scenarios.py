"""Starts of races: which random numbers they use."""

import torch

from coachable.envs.racing import RacingEnv
from coachable.envs.racing.physics.state import WEARS
from coachable.envs.racing.race.scenarios import Conditions, race_scenarios


def test_worn_tyres_say_nothing_about_where_the_cars_start():
    env = RacingEnv(
        2,
        cars=2,
        track="ring",
        seed=0,
        scenarios=race_scenarios(2, {"slipstream": 1.0}),
        conditions=Conditions(wear=True),
    )
    races = 4000
    seed, none = torch.arange(races), torch.zeros(races, dtype=torch.int64)
    starts = env.starter.draw(seed, none, env.garage.typical, none)
    gap = -starts.distance.min(0).values
    wear = starts.state[WEARS, 0]  # (4, B) of the first car of each race
    inside = ((wear > 0.0) & (wear < 1.0)).all(0)
    spread = (wear - wear.mean(0)).abs()[:, inside]
    for tyre in spread:
        assert torch.corrcoef(torch.stack([tyre, gap[inside]]))[0, 1].abs() < 0.06


def test_every_seed_of_63_bits_starts_a_race():
    env = RacingEnv(2, track="oval")
    starts = []
    for seed in (5, 2**45, 2**63 - 1):
        env.set_seed(seed)
        starts.append(env.reset()["observation"])
    assert not torch.equal(starts[0], starts[1]) and not torch.equal(starts[1], starts[2])
