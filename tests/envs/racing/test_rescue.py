"""Stranded cars, and when they are put back on the track."""

import math

import pytest
import torch

from coachable.envs.racing import RacingEnv
from coachable.envs.racing.physics.simulation import CONTROL_STEP
from coachable.envs.racing.physics.state import ROW
from coachable.envs.racing.race.referee import TELEMETRY
from coachable.envs.racing.race.rescue import RESCUE_SPEED, way_clear
from coachable.envs.racing.race.run import Run
from coachable.envs.racing.race.scenarios import rolling_start

T = {name: column for column, name in enumerate(TELEMETRY)}


@pytest.mark.parametrize("cars", [1, 2])
def test_stranded_cars_are_put_back_where_they_were(cars):
    env = RacingEnv(2 * cars, cars=cars, track="ring", seed=0, put_back=True, scenarios=rolling_start(cars))
    start = env.reset()
    x, y, along = env.course.place(env.run[0, :1], torch.tensor([8.0]))  # row 0, car 0 of race 0: beside the track
    env.state[ROW["x"] : ROW["vx"], 0] = torch.cat([x, y, along + math.pi])  # against it, and braking
    env.state[ROW["vx"] : ROW["spin_rr"] + 1, 0] = 0.0
    action = torch.tensor([0.0, 0.2]).repeat(2 * cars, 1)
    action[0, 1] = -1.0
    seen = []
    for _ in range(33):
        seen.append(env.step(start.set("action", action))["next"].clone())
    assert not torch.stack(seen)["done"].any()
    telemetry = torch.stack(seen)["telemetry"][:, 0]
    back = int((telemetry[:, T["speed"]] > 10.0).int().argmax())
    assert 29 <= back <= 31
    assert telemetry[back - 1, T["offset"]].abs() > 3.0
    torch.testing.assert_close(telemetry[back, T["offset"]], torch.tensor(0.0), atol=0.01, rtol=0)
    torch.testing.assert_close(telemetry[back, T["heading"]], torch.tensor(0.0), atol=0.01, rtol=0)
    metres = CONTROL_STEP * RESCUE_SPEED
    torch.testing.assert_close(telemetry[back, T["distance"]], torch.tensor(metres), atol=0.1, rtol=0)
    assert telemetry[back, T["fuel"]] <= telemetry[back - 1, T["fuel"]] and telemetry[back, T["fuel"]] > 29.0
    assert (env._steps == 33).all()


def test_a_stranded_car_waits_for_others_to_pass():
    env = RacingEnv(3, cars=3, track="ring", seed=0, put_back=True, scenarios=rolling_start(3))
    env.reset()
    env.run[0] = env.run[0, 0] + torch.tensor([0.0, -10.0, 300.0])  # the second car is close behind the first
    run = Run(*env.run.unbind(0))
    first, second = torch.tensor([True, False, False]), torch.tensor([True, True, False])
    assert way_clear(env.course, run, first, env.group).tolist() == [False, False, True]
    assert way_clear(env.course, run, second, env.group).tolist() == [True, False, True]
