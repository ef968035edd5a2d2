"""When the training loop does what."""

from dataclasses import dataclass, field, fields

from coachable.ranges import AMOUNT, COUNT, NOT_NEGATIVE, SHARE, Range

__all__ = ["TrainSettings"]


@dataclass(frozen=True)
class TrainSettings:
    """When the loop does what; the metadata of each field holds its range.

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

    total_frames: int = field(metadata={"range": COUNT})
    batch_size: int = field(default=256, metadata={"range": COUNT})
    warmup_frames: int = field(default=0, metadata={"range": AMOUNT})
    utd_ratio: float | None = field(default=1.0, metadata={"range": Range("[0, inf)", optional=True)})
    throttle: float | None = field(default=None, metadata={"range": Range("(0, inf)", optional=True)})
    anneal: float = field(default=0.0, metadata={"range": SHARE})
    anneal_entropy: float = field(default=1.0, metadata={"range": Range("(0, 1]")})
    eval_interval: int = field(default=0, metadata={"range": AMOUNT})
    log_interval: float = field(default=20.0, metadata={"range": NOT_NEGATIVE})
    checkpoint_interval: float = field(default=300.0, metadata={"range": NOT_NEGATIVE})

    def __post_init__(self) -> None:
        """Refuse numbers outside of their ranges, and as many updates as fit where collection has no throttle."""
        for entry in fields(self):
            if "range" in entry.metadata:
                entry.metadata["range"].check(entry.name, getattr(self, entry.name))
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
