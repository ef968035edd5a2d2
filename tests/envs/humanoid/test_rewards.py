"""Task reward, factor by factor."""

import numpy as np
import pytest

from coachable.envs.humanoid.observation import cosine_to_course
from coachable.envs.humanoid.rewards import move_reward


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


def test_facing_is_the_cosine_of_the_heading_relative_to_the_course():
    heading, course = np.array([0.3, 2.0, -1.0]), np.array([0.3, 0.5, 1.0])
    quaternion = np.stack([np.cos(heading / 2), 0 * heading, 0 * heading, np.sin(heading / 2)], axis=1)
    np.testing.assert_allclose(cosine_to_course(quaternion, course), np.cos(heading - course), atol=1e-12)
