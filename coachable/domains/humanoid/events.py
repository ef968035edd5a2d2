"""Rare events of the humanoid, for the event tables."""

from tensordict import TensorDictBase
from torch import Tensor

from coachable.envs.humanoid.features import COMPLETED
from coachable.keys import STYLE_FEATURES
from coachable.replay.routing import PredicateEvents


def humanoid_events() -> PredicateEvents:
    """Tables "step", of strikes of the expected foot, and "fall"."""
    return PredicateEvents({"step": _step, "fall": _fall})


def _step(transitions: TensorDictBase) -> Tensor:
    return transitions.get(("next", STYLE_FEATURES))[..., COMPLETED] > 0


def _fall(transitions: TensorDictBase) -> Tensor:
    return transitions.get(("next", "terminated")).squeeze(-1)
