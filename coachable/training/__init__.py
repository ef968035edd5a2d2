"""Training: the loop, what it collects with and learns with, checkpoints and metrics."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coachable.training.checkpoint import CheckpointStore
    from coachable.training.collection import make_collector
    from coachable.training.episodes import EpisodeSums
    from coachable.training.learner import Learner
    from coachable.training.logging import MetricsLog, Progress
    from coachable.training.train_settings import TrainSettings
    from coachable.training.trainer import Trainer
    from coachable.training.weights import agent_state

# Resolved on first use, so that one part does not load the others.
_MODULE_OF = {
    "CheckpointStore": "checkpoint",
    "EpisodeSums": "episodes",
    "Learner": "learner",
    "MetricsLog": "logging",
    "Progress": "logging",
    "TrainSettings": "train_settings",
    "Trainer": "trainer",
    "agent_state": "weights",
    "make_collector": "collection",
}

__all__ = [
    "CheckpointStore",
    "EpisodeSums",
    "Learner",
    "MetricsLog",
    "Progress",
    "TrainSettings",
    "Trainer",
    "agent_state",
    "make_collector",
]


def __getattr__(name: str) -> object:
    if name in _MODULE_OF:
        return getattr(import_module(f"coachable.training.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'coachable.training' has no attribute {name!r}; it offers {', '.join(__all__)}")
