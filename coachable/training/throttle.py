"""Upper bound on the rate at which the environment is stepped."""

import time


class Throttle:
    """Limit on the number of env-steps per second.

    The paper limits the humanoid's training to 60 env-steps/s (section "DMC Humanoid"). The limit holds for the average
    since the first frame. After a pause, such as that for a checkpoint, the collection catches up by at most `burst`
    seconds' worth of frames.

    Args:
        rate: Highest rate [env-steps/s]; None never waits.
        burst: Longest pause that is caught up [s].

    Raises:
        ValueError: If `rate` is not positive.

    Example:
        >>> Throttle(None).remaining()
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
        """Count frames that were just collected."""
        if self.rate is None:
            return
        now = time.monotonic()
        due = now if self._due is None else max(self._due, now - self.burst)
        self._due = due + frames / self.rate

    def remaining(self) -> float:
        """Return the time until more frames may be collected [s]."""
        return 0.0 if self._due is None else max(0.0, self._due - time.monotonic())

    def wait(self) -> None:
        """Sleep until more frames may be collected."""
        pause = self.remaining()
        if pause > 0:
            time.sleep(pause)
