"""The page through viser, without a browser. Imports are in the fixtures, because viser is an extra."""

import pytest

from tests.coach.echo_domain import echo_session


@pytest.fixture(scope="module")
def server():
    from coachable.coach.page.server import make_server

    server = make_server(port=18080)
    yield server
    server.stop()


@pytest.fixture
def page(server):
    from coachable.coach.page.coach_page import CoachPage

    server.gui.reset()
    server.scene.reset()
    session = echo_session(seed=3)
    page = CoachPage(server, session)
    page.loop.paused = True
    page.loop.pause_at_end = 0.0
    page.start()
    yield page
    page.stop()
    session.close()


@pytest.fixture
def walker(server):
    """A page with the humanoid, paused before its first step, and a browser that looks at it."""
    from coachable.coach.page.coach_page import CoachPage
    from coachable.coach.session.session import CoachSession

    server.gui.reset()
    server.scene.reset()
    session = CoachSession.open("humanoid", seed=1)
    page = CoachPage(server, session)
    page.loop.paused = True
    page.start()
    yield page
    page.stop()
    session.close()
