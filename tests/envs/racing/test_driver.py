"""The scripted driver laps without leaving the track."""

import pytest
import torch

from coachable.envs.racing import RacingEnv
from coachable.envs.racing.circuit.line import minimum_curvature_line
from coachable.envs.racing.race.driver import LineFollower
from coachable.envs.racing.race.referee import TELEMETRY
from coachable.envs.racing.race.scenarios import Scenario

T = {name: column for column, name in enumerate(TELEMETRY)}
ALONE = (Scenario("solo", 1.0, "solo"),)


def drive(env, driver, steps):
    """Telemetry (steps, N, 11)."""
    current, seen = env.reset(), []
    for _ in range(steps):
        current = env.step(current.set("action", driver(env.field, current["observation"])))["next"]
        seen.append(current["telemetry"].clone())
    return torch.stack(seen)


def test_it_keeps_to_the_road_of_an_oval():
    env = RacingEnv(8, track="oval", seed=0, scenarios=ALONE)
    seen = drive(env, LineFollower(env.tracks, env.garage.typical), 60)
    assert seen[..., T["off"]].sum() == 0
    assert (seen[-1, :, T["distance"]] > 60 * 0.1 * 30.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("car, bound", [("gt3", 120.0), ("x2019", 96.0)])
def test_a_lap_of_lakeside(car, bound):
    """The bounds leave room for a simple driver, which needs 115.5 s and 93.4 s."""
    env = RacingEnv(3, track="lakeside", car=car, seed=0, scenarios=ALONE)
    line = minimum_curvature_line(env.tracks[0], margin=2.0)
    driver = LineFollower(env.tracks, env.garage.typical, grip=0.93, line=line)
    seen = drive(env, driver, int(10 * bound))
    assert seen[..., T["off"]].sum() == 0
    assert (seen[-1, :, T["distance"]] > env.course.length).all()
