"""Real-time loop that steps a session in its own thread; other threads submit their changes through a queue."""

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from coachable.coach.session.session import CoachSession

_LATE = 0.25  # [s], the loop does not catch up on longer delays
_IDLE = 0.05  # [s], longest time between checks of the queue
_FRAME = 1.0 / 30.0  # [s], longest time between two calls of `on_wait`
_READABLE = 4.0  # [s], for which a problem is shown although other changes succeed
_WAITING = 256  # changes in the queue, further ones are refused


class LiveLoop:
    """Thread that steps a session in real time.

    Only this thread uses the session. Other threads submit changes, which are made before the next step, so a request
    applies from the next observation on. An exception in a step pauses the loop; the text of the last exception is
    kept in `problem`.

    Args:
        session: The session, which no other thread may step.
        on_step: Called in the loop's thread after each step and after each submitted change.
        on_stop: Called in the loop's thread when it ends.
        on_wait: Called in the loop's thread about 30 times per second while it waits for the next step.

    Attributes:
        pause_at_end: How long an ended episode is shown before the next one begins [s].
        speed: Simulated seconds per second, a finite number above 0.
        paused: Whether the loop only makes single steps.
        problem: Text of the last exception; empty if changes were made without one for some seconds since.
    """

    pause_at_end = 1.0

    def __init__(
        self,
        session: CoachSession,
        on_step: Callable[[], None] = lambda: None,
        on_stop: Callable[[], None] = lambda: None,
        on_wait: Callable[[], None] = lambda: None,
    ) -> None:
        self.session, self.on_step, self.on_stop, self.on_wait = session, on_step, on_stop, on_wait
        self._stepped = 0.0
        self._speed = 1.0
        self.paused = False
        self._problem, self._problem_at = "", -math.inf
        self._changes: queue.Queue[Callable[[CoachSession], Any]] = queue.Queue(_WAITING)
        self._stopping = threading.Event()
        self._stale = threading.Event()
        self._thread = threading.Thread(target=self._run, name="coaching", daemon=True)
        self._steps: deque[float] = deque(maxlen=max(2, round(1.0 / session.domain.control_step)))

    @property
    def speed(self) -> float:
        """Simulated seconds per second.

        Raises:
            ValueError: If it is set to anything but a finite number above 0.
        """
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if not 0.0 < speed < math.inf:
            raise ValueError(f"speed = {speed}: expected a finite number above 0")
        self._speed = speed

    @property
    def problem(self) -> str:
        """Text of the last exception."""
        return self._problem

    @problem.setter
    def problem(self, problem: str) -> None:
        self._problem, self._problem_at = problem, time.perf_counter()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread after the current step."""
        self._stopping.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def submit(self, change: Callable[[CoachSession], Any]) -> None:
        """Queue a change of the session, to be made before its next step, and return at once.

        If the queue is full, the change is dropped and `problem` says so.

        Args:
            change: Function of the session, called in the loop's thread.
        """
        try:
            self._changes.put_nowait(change)
        except queue.Full:
            self.problem = "too many requests are waiting; some were dropped"

    def refuse(self, reason: str) -> None:
        """Report a refused request as a problem, in the order of the submitted changes."""

        def complain(_session: CoachSession) -> None:
            raise ValueError(reason)

        self.submit(complain)

    def show(self) -> None:
        """Call `on_step` soon, even while paused, and return at once."""
        self._stale.set()

    def single_step(self) -> None:
        """Pause the loop and make one step."""
        self.paused = True
        self.submit(lambda session: session.step())

    @property
    def factor(self) -> float:
        """Real-time factor over the last second of simulated time: 1 is real time, 0 is paused."""
        moments = list(self._steps)
        if self.paused or len(moments) < 2 or time.perf_counter() - moments[-1] > 1.0 + self.pause_at_end:
            return 0.0
        return (len(moments) - 1) * self.session.domain.control_step / (moments[-1] - moments[0])

    @property
    def share(self) -> float:
        """Share of the control step that has passed since the last step, 1 while paused and between episodes."""
        if self.paused or self.session.ended is not None:
            return 1.0
        return min(1.0, (time.perf_counter() - self._stepped) * self.speed / self.session.domain.control_step)

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
                self._stepped = now
                self._attempt(lambda session: session.step())
                due = self._next(due, now)
                changed = True  # a failed step has a problem to show
            if changed:
                self._attempt(lambda _: self.on_step(), pause=False)  # the agent continues if the display fails
            elif not self.paused:
                self._attempt(lambda _: self.on_wait(), pause=False)
            time.sleep(_IDLE if self.paused else min(_FRAME, max(0.0, due - time.perf_counter())))
        self.on_stop()

    def _next(self, due: float, now: float) -> float:
        """Return the time at which the next step is due."""
        if self.session.ended is not None:
            self._steps.clear()
            return now + self.pause_at_end
        self._steps.append(now)
        due += self.session.domain.control_step / self.speed
        return due if due > now - _LATE else now

    def _drain(self) -> bool:
        waiting = self._changes.qsize()  # changes submitted from now on wait for the next step
        for _ in range(waiting):
            if time.perf_counter() > self._problem_at + _READABLE:
                self.problem = ""
            self._attempt(self._changes.get_nowait(), pause=False)
        return waiting > 0

    def _attempt(self, change: Callable[[CoachSession], Any], pause: bool = True) -> None:
        """Call a function of the session and keep the text of an exception; pause the loop then if `pause`."""
        try:
            change(self.session)
        except Exception as error:  # the page shows any problem and keeps running
            self.problem = f"{error}" or type(error).__name__
            self.paused = self.paused or pause
