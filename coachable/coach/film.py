"""A recorded session as a film: it is run again, and drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from coachable.coach.recording import Recording
from coachable.coach.session import CoachSession
from coachable.evaluation.video import CAPTION, caption, write_video


def film(
    recording: Recording,
    session: CoachSession,
    out: Path,
    *,
    last: float | None = None,
    size: tuple[int, int] = (640, 480),
    on_progress: Callable[[float], None] = lambda share: None,
) -> Path:
    """Replays a recording beside its session, which may go on meanwhile, and writes what it looked like.

    Args:
        recording: what to show.
        session: whose policy and domain to use; it is not touched.
        out: `.mp4` or `.gif`.
        last: only the last so many seconds.
        size: width and height [px].
        on_progress: called with the share that is done, from 0 to 1.

    Returns:
        `out`.

    Raises:
        ValueError: if nothing was recorded, or for another suffix.
        ImportError: for mp4 without PyAV; names the extra to install.
    """
    if out.suffix not in (".mp4", ".gif"):
        raise ValueError(f"cannot write {out.name}: expected a file ending in .mp4 or .gif")
    if recording.steps == 0:
        raise ValueError("nothing was recorded yet: step the session first")
    out.parent.mkdir(parents=True, exist_ok=True)
    replica = session.replica()
    try:
        write_video(_frames(replica, recording, last, size, on_progress), out, round(1 / session.domain.control_step))
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
    asked = ", ".join(f"{n} {v:.2f}" if isinstance(v, float) else f"{v}" for n, v in report.requested.items())
    shown = ", ".join(f"{name} {value:.2f}" for name, value in report.measured.items())
    return f"asked: {asked}".replace("_", " "), f"measured: {shown}".replace("_", " ")
