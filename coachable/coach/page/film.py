"""Films of recorded sessions, which are replayed and drawn."""

import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from coachable.coach.session.recording import Recording
from coachable.coach.session.session import CoachSession
from coachable.evaluation.video import CAPTION, asked_line, caption, measured_line, write_video
from coachable.keys import TASK_REWARD
from coachable.outputs import complete_file

_LONGEST_SESSION = 600.0  # [s]; the whole session is replayed to film its last seconds


class FilmStudio:
    """Maker of films in a thread of its own, one at a time.

    Args:
        session: Session whose policy and domain are used; it is not changed.
        note: Called with messages on the progress.
    """

    def __init__(self, session: CoachSession, note: Callable[[str], None]) -> None:
        self._session, self._note = session, note
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def shoot(self, recording: Recording, last: float, deliver: Callable[[bytes], None]) -> None:
        """Start to film the last seconds of a recording and return at once.

        Args:
            recording: The recording.
            last: Length of the film [s].
            deliver: Called with the content of the finished mp4 file.

        Raises:
            ValueError: If another film is being drawn, or the recording is too long.
        """
        if self._thread is not None and self._thread.is_alive():
            raise ValueError("a film is being drawn already: wait until it is finished")
        seconds = recording.steps * self._session.domain.control_step
        if seconds > _LONGEST_SESSION:
            raise ValueError(
                f"the session has lasted {seconds:.0f} s, and a film replays all of it: expected at most "
                f"{_LONGEST_SESSION:.0f} s. Start over with a seed, or film the downloaded recording with "
                "coachable.coach.page.film"
            )
        self._thread = threading.Thread(target=self._draw, args=(recording, last, deliver), name="filming", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Cancel the film that is being drawn, if any."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()

    def _draw(self, recording: Recording, last: float, deliver: Callable[[bytes], None]) -> None:
        try:
            with tempfile.TemporaryDirectory() as folder:
                out = Path(folder) / "film.mp4"
                deliver(film(recording, self._session, out, last=last, on_progress=self._progress).read_bytes())
            self._note("drawn")
        except Exception as error:  # nothing above this thread reports it
            if not self._closing.is_set():
                self._note(f"Problem: {error}")

    def _progress(self, share: float) -> None:
        if self._closing.is_set():
            raise RuntimeError("the page is closing")
        self._note(f"drawing: {share:.0%}; the agent continues meanwhile")


def film(
    recording: Recording,
    session: CoachSession,
    out: Path,
    *,
    last: float | None = None,
    size: tuple[int, int] = (640, 480),
    on_progress: Callable[[float], None] = lambda share: None,
) -> Path:
    """Film a recording by replaying it in another session; the given one may be stepped at the same time.

    Args:
        recording: The recording.
        session: Session whose policy and domain are used; it is not changed.
        out: File to write, `.mp4`.
        last: Length of the end of the recording to film [s]; all of it if None.
        size: Width and height [px].
        on_progress: Called with the share of the steps that are done, from 0 to 1.

    Returns:
        `out`.

    Raises:
        ValueError: If nothing was recorded, or for another suffix.
        ImportError: Without PyAV; the message names the extra to install.
    """
    if out.suffix != ".mp4":
        raise ValueError(f"cannot write {out.name}: expected a file ending in .mp4")
    if recording.steps == 0:
        raise ValueError("nothing was recorded yet: step the session first")
    out.parent.mkdir(parents=True, exist_ok=True)
    replica = session.replica()
    try:
        fps = max(1, round(1 / session.domain.control_step))
        with complete_file(out) as unfinished:
            write_video(_frames(replica, recording, last, size, on_progress), unfinished, fps)
    finally:
        replica.close()
    return out


def _frames(
    session: CoachSession,
    recording: Recording,
    last: float | None,
    size: tuple[int, int],
    on_progress: Callable[[float], None],
) -> Iterator[np.ndarray]:
    first = 0 if last is None else recording.steps - round(last / session.domain.control_step)
    renderer = session.domain.make_renderer(size[0], size[1] - CAPTION)
    session.replay(recording)
    try:
        for step in range(recording.steps):
            session.step()
            on_progress((step + 1) / recording.steps)
            if step >= first:
                yield caption(renderer.draw(session.env), _lines(session))
    finally:
        renderer.close()


def _lines(session: CoachSession) -> tuple[str, str]:
    report = session.report()
    measured = {name: value for name, value in report.measured.items() if name != TASK_REWARD}
    return (
        asked_line(session.space, report.outside, report.requested),
        measured_line(session.domain, session.space, report.requested, measured),
    )
