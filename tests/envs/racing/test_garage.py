"""Which car each race drives."""

import math

import pytest
import torch

from coachable.envs.racing import RacingEnv
from coachable.envs.racing.physics.cars import car_pool
from coachable.envs.racing.race.garage import Garage


@pytest.mark.parametrize("adaptive", [True, False])
def test_cars_of_the_pool_that_spin_are_drawn_more_often(adaptive):
    races = 20_000
    garage = Garage("pool", 2, races, torch.device("cpu"), adaptive=adaptive)
    every, seeds = torch.ones(races, dtype=torch.bool), torch.arange(races)
    garage.model[:] = 7
    garage.draw(every, seeds, torch.full((races,), 2), torch.full((2 * races,), 40.0))  # car 7 spins in all its races
    assert garage.spinning[7] == pytest.approx(2.0) and garage.spinning.sum() == garage.spinning[7]  # a twentieth of 40
    share = 2.1 / (2.1 + 529 * 0.1) if adaptive else 1 / 530
    found = float((garage.model == 7).float().mean())
    assert abs(found - share) < 5 * math.sqrt(share * (1 - share) / races)
    assert len(garage.model.unique()) == 530


def test_the_gt3_cars_of_the_pool_take_turns():
    env = RacingEnv(2 * 50, cars=2, car="gt3_pool", track="ring", seed=3)
    env.reset()
    first, pool = env.garage.model, car_pool()
    assert first.sort().values.tolist() == list(range(50))
    assert torch.equal(env.garage.car.mass, pool[0, first].repeat(2))  # the cars of a race are alike
    env.reset()
    assert torch.equal(env.garage.model, (first + 1) % 50)
    env.set_seed(3)
    env.reset()
    assert torch.equal(env.garage.model, first)
