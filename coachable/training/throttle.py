"""An upper bound on the rate at which the environment is stepped."""

import time

__all__ = ["Throttle"]


class Throttle:
    """Holds env-steps per second at or below a rate.

    The paper throttles the humanoid's collection to 60 env-steps/s, so that the learner makes many updates per step
    (section "DMC Humanoid"). The bound holds over the time since the first frame, not per call: a pause for a
    checkpoint is made good afterwards, by at most `burst` seconds' worth of frames.

    Args:
        rate: [env-steps/s]; None never waits.
        burst: [s] how far the collection may catch up after a pause.

    Raises:
        ValueError: if `rate` is not positive.

    Example:
        >>> Throttle(None).remaining(10_000)
        0.0
    """

    def __init__(self, rate: float | None, burst: float = 5.0) -> None:
        if rate is not None and not rate > 0:
            raise ValueError(
                f"throttle must be a positive number of env-steps per second or null (no limit), got {rate!r}"
            )
        self.rate = rate
        self.burst = burst
        self._due: float | None = None

    def add(self, frames: int) -> None:
        """Counts frames that were just collected."""
        if self.rate is None:
            return
        now = time.monotonic()
        due = now if self._due is None else max(self._due, now - self.burst)
        self._due = due + frames / self.rate

    def remaining(self, frames: int = 0) -> float:
        """Tells how long to wait before more may be collected.

        Args:
            frames: counted as if just added (default: none).

        Returns:
            Seconds, 0.0 when collection may go on at once.
        """
        if self.rate is None or self._due is None:
            return 0.0
        return max(0.0, self._due + frames / self.rate - time.monotonic())

    def wait(self) -> None:
        """Sleeps until more may be collected."""
        pause = self.remaining()
        if pause > 0:
            time.sleep(pause)
