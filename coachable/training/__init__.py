"""Training: the loop, what it collects with and learns with, checkpoints and metrics."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coachable.training.checkpoint import CheckpointStore
    from coachable.training.collection import make_collector
    from coachable.training.episodes import EpisodeSums
    from coachable.training.learner import Learner, NonFiniteLossError
    from coachable.training.logging import MetricsLog, Progress
    from coachable.training.precision import resolve_precision, supports_bf16
    from coachable.training.train_settings import TrainSettings
    from coachable.training.trainer import Trainer
    from coachable.training.weights import agent_state

# Resolved on first use, so that one part does not load the others.
_MODULE_OF = {
    "CheckpointStore": "coachable.training.checkpoint",
    "EpisodeSums": "coachable.training.episodes",
    "Learner": "coachable.training.learner",
    "MetricsLog": "coachable.training.logging",
    "NonFiniteLossError": "coachable.training.learner",
    "Progress": "coachable.training.logging",
    "Trainer": "coachable.training.trainer",
    "TrainSettings": "coachable.training.train_settings",
    "agent_state": "coachable.training.weights",
    "make_collector": "coachable.training.collection",
    "resolve_precision": "coachable.training.precision",
    "supports_bf16": "coachable.training.precision",
}

__all__ = [
    "CheckpointStore",
    "EpisodeSums",
    "Learner",
    "MetricsLog",
    "NonFiniteLossError",
    "Progress",
    "TrainSettings",
    "Trainer",
    "agent_state",
    "make_collector",
    "resolve_precision",
    "supports_bf16",
]


def __getattr__(name: str) -> object:
    if name in _MODULE_OF:
        return getattr(import_module(_MODULE_OF[name]), name)
    raise AttributeError(f"module 'coachable.training' has no attribute {name!r}; it offers {', '.join(__all__)}")
