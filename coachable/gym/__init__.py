"""Gymnasium: `StyleWrapper` makes its environments coachable, `GymnasiumEnv` makes them TorchRL environments."""

from importlib.util import find_spec

from coachable.extras import how_to_install

if find_spec("gymnasium") is None:
    raise ImportError(f"coachable.gym needs Gymnasium: {how_to_install('gym')}")

from coachable.gym.checked_features import Features
from coachable.gym.gymnasium_env import GymnasiumEnv
from coachable.gym.wrapper import StyleWrapper

__all__ = ["Features", "GymnasiumEnv", "StyleWrapper"]
