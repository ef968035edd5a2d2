"""Films of recorded sessions."""

import warnings

import pytest

from coachable.coach.page.film import _lines, film
from coachable.styles import StyleRangeWarning
from tests.coach.echo_domain import echo_session


@pytest.fixture
def session():
    session = echo_session(seed=2)
    yield session
    session.close()


def test_a_film_of_the_last_seconds_of_a_session_that_goes_on(session, tmp_path):
    av = pytest.importorskip("av")
    session.set(target=0.05)
    session.run(2.0)
    recording = session.recording()
    session.run(0.5)
    shares = []
    file = film(recording, session, tmp_path / "out" / "film.mp4", last=0.5, size=(64, 96), on_progress=shares.append)
    with av.open(str(file)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 10 and frames[0].shape == (96, 64, 3)
    assert shares[-1] == 1.0 and shares == sorted(shares)
    assert session.step_count == 50, "the session itself is not touched"


def test_the_caption_has_only_what_fits(session):
    """A caption of everything that is measured runs off the picture where there are many measures."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StyleRangeWarning)
        session.set(target=2.0)
    session.step()
    asked, measured = _lines(session)
    assert asked == "requested: target 0.8 m (clamped from 2), mood calm"
    assert measured == "measured: target 0.8 m"


def test_what_cannot_be_filmed(session, tmp_path):
    with pytest.raises(ValueError, match="nothing was recorded yet"):
        film(session.recording(), session, tmp_path / "film.mp4")
    session.step()
    with pytest.raises(ValueError, match=r"cannot write film.avi: expected a file ending in .mp4"):
        film(session.recording(), session, tmp_path / "film.avi")
