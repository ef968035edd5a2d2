"""A session of the echo domain."""

import pytest

from tests.coach.echo_domain import echo_session


@pytest.fixture
def session():
    session = echo_session(seed=3)
    yield session
    session.close()
