"""Training: the loop, what it collects with and learns with, checkpoints and metrics."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coachable.training.learner import Learner

__all__ = ["Learner"]


def __getattr__(name: str) -> object:
    if name != "Learner":
        raise AttributeError(f"module 'coachable.training' has no attribute {name!r}; it offers Learner")
    return import_module("coachable.training.learner").Learner  # most modules do without: it loads TorchRL's losses
