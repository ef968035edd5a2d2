"""Training: the loop, what it collects with and learns with, checkpoints and metrics."""

from coachable.training.checkpoint import CheckpointStore
from coachable.training.collection import make_collector
from coachable.training.episodes import EpisodeSums
from coachable.training.learner import Learner
from coachable.training.logging import MetricsLog, Progress
from coachable.training.train_settings import TrainSettings
from coachable.training.trainer import Trainer
from coachable.training.weights import agent_state

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
