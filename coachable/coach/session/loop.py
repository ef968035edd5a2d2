"""Runs a session in real time, in a thread of its own; everybody else hands it what to do through a queue."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from coachable.coach.session.session import CoachSession

_LATE = 0.25  # [s], a delay beyond this is not made up for
_IDLE = 0.05  # [s], between looks at the queue while paused
_WAITING = 256  # changes, beyond which further ones are refused


class LiveLoop:
    """Steps a session at the pace of its control step.

    Only the loop's thread touches the session. What others want done is submitted, and carried out before the next
    step: a request therefore acts at the next observation. A step that raises pauses the loop; the text of any
    exception is kept in `problem`.

    Args:
        session: stepped here and nowhere else.
        on_step: called in the loop's thread after each step and after each submitted change.
        pause_at_end: how long an ended episode stays on view before the next begins [s].

    Attributes:
        speed: simulated seconds per second, a finite number above 0.
        paused: no steps except single ones.
        problem: text of the last exception, empty if there was none since the last change.
    """

    def __init__(
        self, session: CoachSession, on_step: Callable[[], None] = lambda: None, pause_at_end: float = 1.0
    ) -> None:
        self.session, self.on_step, self.pause_at_end = session, on_step, pause_at_end
        self._speed = 1.0
        self.paused = False
        self.problem = ""
        self._changes: queue.Queue[Callable[[CoachSession], Any]] = queue.Queue(_WAITING)
        self._stopping = threading.Event()
        self._stale = threading.Event()
        self._thread = threading.Thread(target=self._run, name="coaching", daemon=True)
        self._steps: deque[float] = deque(maxlen=max(2, round(1.0 / session.domain.control_step)))

    @property
    def speed(self) -> float:
        """See above.

        Raises:
            ValueError: if it is set to anything else.
        """
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if not 0.0 < speed < math.inf:
            raise ValueError(f"speed = {speed}: expected a finite number above 0")
        self._speed = speed

    def start(self) -> None:
        """Begins to step."""
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread after the step in progress."""
        self._stopping.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def submit(self, change: Callable[[CoachSession], Any]) -> None:
        """Has something done to the session before its next step; returns at once.

        What exceeds the steps that the session can take meanwhile is left out: see `problem`.
        """
        try:
            self._changes.put_nowait(change)
        except queue.Full:
            self.problem = "more was asked for than can be carried out; some of it was left out"

    def refuse(self, reason: str) -> None:
        """Says why something that was asked for is not carried out, as if it had been tried."""

        def complain(_session: CoachSession) -> None:
            raise ValueError(reason)

        self.submit(complain)

    def show(self) -> None:
        """Has what is shown brought up to date, even while paused; returns at once."""
        self._stale.set()

    def single_step(self) -> None:
        """Pauses, and takes one step."""
        self.paused = True
        self.submit(lambda session: session.step())

    @property
    def factor(self) -> float:
        """Real-time factor over the last second of simulated time: 1 is real time; 0 while paused."""
        moments = list(self._steps)
        if self.paused or len(moments) < 2 or time.perf_counter() - moments[-1] > 1.0 + self.pause_at_end:
            return 0.0
        return (len(moments) - 1) * self.session.domain.control_step / (moments[-1] - moments[0])

    def _run(self) -> None:
        due = time.perf_counter()
        while not self._stopping.is_set():
            changed = self._drain() or self._stale.is_set()
            self._stale.clear()
            now = time.perf_counter()
            if self.paused:
                due = now
                self._steps.clear()
            elif now >= due:
                self._attempt(lambda session: session.step())
                due = self._next(due, now)
                changed = True  # a step that failed has something to show as well
            if changed:
                self._attempt(lambda _: self.on_step(), pause=False)  # what is shown may fail, the agent goes on
            time.sleep(_IDLE if self.paused else min(_IDLE, max(0.0, due - time.perf_counter())))

    def _next(self, due: float, now: float) -> float:
        """When the step after the one that was just taken is due."""
        if self.session.ended is not None:
            self._steps.clear()
            return now + self.pause_at_end
        self._steps.append(now)
        due += self.session.domain.control_step / self.speed
        return due if due > now - _LATE else now

    def _drain(self) -> bool:
        waiting = self._changes.qsize()  # what comes meanwhile waits for the next step
        for _ in range(waiting):
            self.problem = ""
            self._attempt(self._changes.get_nowait(), pause=False)
        return waiting > 0

    def _attempt(self, change: Callable[[CoachSession], Any], pause: bool = True) -> None:
        """A refused change leaves the agent acting, a failed step pauses it."""
        try:
            change(self.session)
        except Exception as error:  # whatever it is, the page must show it and stay alive
            self.problem = f"{error}" or type(error).__name__
            self.paused = self.paused or pause
