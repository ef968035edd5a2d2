"""A Gymnasium environment with a style, shared by the tests of both directions."""

import gymnasium
import numpy as np
from gymnasium import spaces

from coachable.styles import Choice, Setpoint, StyleReward, StyleSpace, Term

STEPS = 5


class Walk(gymnasium.Env):
    """A walk on a line: moves by the action, pays 1 per step, ends beyond 3 (terminated) or after 5 steps."""

    action_space = spaces.Box(-1.0, 1.0, (1,))
    observation_space = spaces.Box(-10.0, 10.0, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.steps = self.np_random.uniform(-1, 1), 0
        return self._observation(), {"options": options}

    def step(self, action):
        self.position += float(action[0])
        self.steps += 1
        return self._observation(), 1.0, abs(self.position) > 3, self.steps >= STEPS, {"moved": float(action[0])}

    def _observation(self):
        return np.array([self.position, self.steps / STEPS], dtype=np.float32)


SPACE = StyleSpace([Setpoint("stride", -1.0, 1.0), Choice("hat", ("red", "blue"))])


def style_reward():
    """Minus the distance between the move and the requested one; a red hat costs 10."""
    return StyleReward(
        SPACE,
        {
            "stride": Term(lambda f, s: -(f[..., 0] - s["stride"]).abs(), parameters=("stride",)),
            "hat": Term(lambda f, s: -10.0 * s["hat"][..., 0], parameters=("hat",)),
        },
    )


def moved(observation, action, info):
    assert info["moved"] == action[0]
    return action
