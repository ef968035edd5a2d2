"""Task reward, factor by factor."""

import numpy as np
import pytest

from coachable.envs.humanoid.gait import StepReport
from coachable.envs.humanoid.model import CONTROL_STEP
from coachable.envs.humanoid.observation import cosine_to_course
from coachable.envs.humanoid.rewards import COSTS, bearing_reward, move_reward, walk_costs


def reward(speed=1.0, head=1.5, upright=1.0, facing=1.0, control=0.0):
    values = [np.array([value]) for value in (speed, head, upright, facing)]
    return move_reward(*values, np.full((1, 21), control))[0]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, 1.0),
        ({"speed": 1.2}, 1.0),
        ({"speed": 1.7}, 0.5),  # running earns less
        ({"speed": 0.5}, 0.5),
        ({"speed": 0.0}, 0.0),
        ({"speed": -0.5}, -0.5),  # walking backwards costs
        ({"speed": -3.0}, -1.0),
        ({"head": 1.4 - 0.35}, 0.1),  # a Gaussian's value at its margin
        ({"upright": 0.7}, 0.5),
        ({"facing": 0.45}, 0.5),
        ({"facing": -0.5}, 0.0),
        ({"control": 1.0}, 0.5),
        ({"control": 0.5}, 0.5 + 0.5 * 0.75),
    ],
)
def test_each_factor(change, expected):
    assert reward(**change) == pytest.approx(expected)


@pytest.mark.parametrize(
    "change", [{}, {"head": 1.2}, {"upright": 0.7}, {"facing": 0.3}, {"facing": -1.0}, {"control": 0.6}]
)
def test_the_bearing_is_the_reward_at_the_best_speed(change):
    given = {"head": 1.5, "upright": 1.0, "facing": 1.0} | change
    control = given.pop("control", 0.0)
    values = [np.array([given[name]]) for name in ("head", "upright", "facing")]
    assert bearing_reward(*values, np.full((1, 21), control))[0] == reward(speed=1.1, **change)


def test_facing_is_the_cosine_of_the_heading_relative_to_the_course():
    heading, course = np.array([0.3, 2.0, -1.0]), np.array([0.3, 0.5, 1.0])
    quaternion = np.stack([np.cos(heading / 2), 0 * heading, 0 * heading, np.sin(heading / 2)], axis=1)
    np.testing.assert_allclose(cosine_to_course(quaternion, course), np.cos(heading - course), atol=1e-12)


def costs(power=0.0, forces=(0.0, 0.0), clearance=(0.0, 0.0), steps=0, **report):
    """Costs of one walker; `steps` are those of the step that ended."""
    zeros = {name: np.zeros(1) for name in StepReport.__dataclass_fields__}
    given = {name: np.array([value]) for name, value in report.items()}
    ended = StepReport(**{**zeros, "duration": np.array([steps * CONTROL_STEP]), **given})
    found = walk_costs(np.array([power]), np.array([forces]), np.array([clearance]), ended)
    assert set(found) == set(COSTS)
    return {name: value[0] for name, value in found.items() if value[0] != 0}


@pytest.mark.parametrize(
    ("walk", "expected"),
    [
        ({}, {}),
        ({"power": 250.0}, {"power": 0.25}),
        ({"power": 9000.0}, {"power": 3.0}),
        ({"forces": (1.5, 0.3)}, {}),  # what walking takes is free
        ({"forces": (0.0, 4.0)}, {"impact": 0.5}),
        ({"forces": (30.0, 0.0)}, {"impact": 3.0}),
        ({"clearance": (0.06, -0.01)}, {}),
        ({"clearance": (0.135, 0.0)}, {"clearance": 0.5}),
        ({"steps": 20, "pitch": np.deg2rad(5.0)}, {"strike_pitch": 5.0}),  # paid for each control step of the step
        ({"steps": 20, "pitch": -np.deg2rad(25.0)}, {}),  # heel first
        ({"steps": 10, "pitch": -np.deg2rad(45.0)}, {"strike_pitch": 10.0}),  # on the heels
        ({"steps": 10, "drift": -0.05}, {"drift": 5.0}),
        ({"steps": 10, "drift": 0.5}, {"drift": 30.0}),
    ],
)
def test_each_cost(walk, expected):
    assert costs(**walk) == pytest.approx(expected)
