"""Settings of the training loop."""

from dataclasses import dataclass, field, fields

from coachable.ranges import AMOUNT, COUNT, NOT_NEGATIVE, SHARE, Range


@dataclass(frozen=True)
class TrainSettings:
    """Settings of the training loop; the metadata of each field contains its range.

    Attributes:
        total_frames: Length of the whole training, including resumed parts [env-steps].
        batch_size: Transitions per update.
        warmup_frames: Length of the collection before the first update [env-steps].
        utd_ratio: Updates per env-step, which may be a fraction; None makes as many as fit in the time that the
            throttle leaves.
        throttle: Highest rate of the collection [env-steps/s]; None for no limit.
        anneal: Share of `total_frames`, at its end, over which the learning rates fall linearly to a tenth.
        anneal_entropy: Factor to which the entropy weight falls over the same share; it has no effect if `anneal` is 0.
        eval_interval: Distance between evaluations [env-steps]; with 0 there is one, at the end.
        log_interval: Time between rows of metrics [s].
        checkpoint_interval: Time between checkpoints [s].
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
        """Check that numbers are within their ranges, and that `utd_ratio=None` has a throttle."""
        for entry in fields(self):
            if "range" in entry.metadata:
                entry.metadata["range"].check(entry.name, getattr(self, entry.name))
        if self.utd_ratio is None and self.throttle is None:
            raise ValueError("utd_ratio=null (as many updates as fit) needs a throttle: set train.throttle=RATE")

    def learning_rate_factor(self, frames: int) -> float:
        """Return the factor on the learning rates after `frames` env-steps (see `anneal`)."""
        return 1.0 - 0.9 * self._annealed(frames)

    def entropy_factor(self, frames: int) -> float:
        """Return the factor on the entropy weight after `frames` env-steps (see `anneal_entropy`)."""
        return 1.0 - (1.0 - self.anneal_entropy) * self._annealed(frames)

    def _annealed(self, frames: int) -> float:
        """Return 0 before the annealed share of the training, rising to 1 at its end."""
        left = max(0.0, 1.0 - frames / self.total_frames)
        return 0.0 if left >= self.anneal else 1.0 - left / self.anneal
