"""Training: the loop, collectors, the learner, checkpoints and metrics."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coachable.training.learner import Learner

__all__ = ["Learner"]


def __getattr__(name: str) -> object:
    if name != "Learner":
        raise AttributeError(f"module 'coachable.training' has no attribute {name!r}; it offers Learner")
    return import_module("coachable.training.learner").Learner  # lazily, because it imports TorchRL's losses
