"""Training: the learner, its precision, and (elsewhere in this package) the loop around it."""

from coachable.training.learner import Learner, NonFiniteLossError
from coachable.training.precision import resolve_precision, supports_bf16

__all__ = ["Learner", "NonFiniteLossError", "resolve_precision", "supports_bf16"]
