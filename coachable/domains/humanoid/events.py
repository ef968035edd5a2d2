"""Rare events that fill the replay tables of the humanoid."""

from tensordict import TensorDictBase
from torch import Tensor

from coachable.envs.humanoid.features import COMPLETED
from coachable.keys import STYLE_FEATURES
from coachable.replay.routing import PredicateEvents


def humanoid_events() -> PredicateEvents:
    """Return the events "step", which are strikes of the expected foot, and "fall"."""
    return PredicateEvents({"step": _step, "fall": _fall})


def _step(transitions: TensorDictBase) -> Tensor:
    return transitions.get(("next", STYLE_FEATURES))[..., COMPLETED] > 0


def _fall(transitions: TensorDictBase) -> Tensor:
    return transitions.get(("next", "terminated")).squeeze(-1)
