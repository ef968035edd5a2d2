"""When the training loop does what."""

from dataclasses import dataclass

from coachable.ranges import AMOUNT, COUNT, NOT_NEGATIVE, SHARE, Range

__all__ = ["TrainSettings"]

_RANGES = {
    "total_frames": COUNT,
    "batch_size": COUNT,
    "warmup_frames": AMOUNT,
    "utd_ratio": Range("[0, inf)", optional=True),
    "throttle": Range("(0, inf)", optional=True),
    "anneal": SHARE,
    "anneal_entropy": Range("(0, 1]"),
    "eval_interval": AMOUNT,
    "log_interval": NOT_NEGATIVE,
    "checkpoint_interval": NOT_NEGATIVE,
}


@dataclass(frozen=True)
class TrainSettings:
    """When the loop does what.

    Attributes:
        total_frames: [env-steps] of the whole training, resumed parts included.
        batch_size: transitions per update.
        warmup_frames: [env-steps] before the first update.
        utd_ratio: updates per env-step, fractions allowed; None makes as many as fit into the time that the throttle
            leaves.
        throttle: [env-steps/s] upper bound on collection, or None.
        anneal: share of total_frames, at its end, over which the learning rates fall linearly to a tenth.
        anneal_entropy: what the entropy weight falls to meanwhile, as a share of its value before.
        eval_interval: [env-steps] between evaluations, 0 for none but the last.
        log_interval: [s] between rows of metrics.
        checkpoint_interval: [s] between checkpoints.
    """

    total_frames: int
    batch_size: int = 256
    warmup_frames: int = 0
    utd_ratio: float | None = 1.0
    throttle: float | None = None
    anneal: float = 0.0
    anneal_entropy: float = 1.0
    eval_interval: int = 0
    log_interval: float = 20.0
    checkpoint_interval: float = 300.0

    def __post_init__(self) -> None:
        """Refuses what cannot work."""
        for name, expected in _RANGES.items():
            expected.check(name, getattr(self, name))
        if self.utd_ratio is None and self.throttle is None:
            raise ValueError("utd_ratio=null (as many updates as fit) needs a throttle: set train.throttle=RATE")

    def learning_rate_factor(self, frames: int) -> float:
        """What the learning rates are multiplied with after so many env-steps (see `anneal`)."""
        return 1.0 - 0.9 * self._annealed(frames)

    def entropy_factor(self, frames: int) -> float:
        """What the entropy weight is multiplied with after so many env-steps (see `anneal_entropy`)."""
        return 1.0 - (1.0 - self.anneal_entropy) * self._annealed(frames)

    def _annealed(self, frames: int) -> float:
        """From 0 before the last part of the training to 1 at its end."""
        left = max(0.0, 1.0 - frames / self.total_frames)
        return 0.0 if left >= self.anneal else 1.0 - left / self.anneal
