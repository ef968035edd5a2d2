"""Messages of browsers that are wrong, too many or too long change nothing."""

import math
import socket
import threading
import warnings

import pytest

viser = pytest.importorskip("viser")


from coachable.styles import StyleRangeWarning  # noqa: E402
from tests.coach.page.driving import do, wait_for, wire  # noqa: E402


def test_nan_from_a_browser_changes_nothing(page):
    page.widgets["target"].handle.value = 0.5
    do(page)
    page.widgets["target"].handle.value = math.nan
    wait_for(lambda: "**Problem:**" in page.status.content and "NaN" in page.status.content)
    assert page.session.style["target"] == pytest.approx(0.5)
    assert page.widgets["target"].handle.value == pytest.approx(0.5)


@pytest.mark.parametrize("speed", [math.nan, math.inf, -1.0, 0.0, 1e6])
def test_impossible_speeds_are_refused(page, speed):
    page.speed.value = 2.0
    wait_for(lambda: page.loop.speed == 2.0)
    page.speed.value = speed
    wait_for(lambda: "speed = " in page.status.content and "from 0.1 to 4" in page.status.content)
    assert page.loop.speed == 2.0 and page.speed.value == 2.0


def test_an_unknown_option_or_button_changes_nothing(page):
    page.widgets["mood"].handle.value = "angry"
    wait_for(lambda: "is not an option" in page.status.content and page.widgets["mood"].handle.value == "calm")
    page._press("Explode")
    do(page)
    assert page.loop.paused and page.session.style["mood"] == "calm"


def test_more_requests_than_can_be_carried_out_are_left_out(page):
    held, go = threading.Event(), threading.Event()
    page.loop.submit(lambda _: held.set() or go.wait(20))
    assert held.wait(20)
    for _ in range(1000):
        page.loop.submit(lambda session: session.set(target=0.1))
    assert "some were dropped" in page.loop.problem
    go.set()
    wait_for(lambda: not page.loop._changes.qsize())
    do(page)
    assert page.session.style["target"] == pytest.approx(0.1)
    assert "some were dropped" in page.status.content  # although the changes in the queue succeeded
    page.loop._problem_at -= 60.0
    do(page)
    assert page.loop.problem == ""


def test_changes_that_keep_coming_leave_the_agent_time_to_act(page):
    """Each change asks for the next, as a browser can."""

    def again(_session):
        page.loop.submit(again)

    page.loop.submit(again)
    page._press("Resume")
    count = page.session.step_count
    wait_for(lambda: page.session.step_count > count + 5)


def test_bad_numbers_in_a_message(page):
    target = page.widgets["target"].handle
    with wire(page) as (send, _), warnings.catch_warnings():
        warnings.simplefilter("ignore", StyleRangeWarning)
        send(target, 0.5)
        wait_for(lambda: page.session.style["target"] == pytest.approx(0.5))
        for value in (math.nan, math.inf, -math.inf):
            page.status.content = ""
            send(target, value)
            wait_for(lambda: "**Problem:**" in page.status.content or page.session.report().outside)
            wait_for(lambda: page.widgets["target"].handle.value == pytest.approx(page.session.style["target"]))
        send(target, 7.0)
        wait_for(lambda: page.session.report().outside == {"target": 7.0})
        assert page.session.style["target"] == pytest.approx(0.8)
        wait_for(lambda: page.widgets["target"].handle.value == pytest.approx(0.8))  # which replaces a new value, too
        send(target, 0.25)
        wait_for(lambda: page.session.style["target"] == pytest.approx(0.25))


def test_one_of_two_browsers_breaks_off_while_the_agent_acts(page):
    page._press("Resume")
    with wire(page) as (send, _), wire(page) as (_, dying):
        dying.socket.shutdown(socket.SHUT_RDWR)  # no goodbye
        wait_for(lambda: len(page.server.get_clients()) == 1)
        count = page.session.step_count
        wait_for(lambda: page.session.step_count > count + 3)
        send(page.widgets["target"].handle, 0.5)
        wait_for(lambda: page.session.style["target"] == pytest.approx(0.5))
    count = page.session.step_count
    wait_for(lambda: page.session.step_count > count + 3)
    assert page.loop.problem == ""


def test_long_phrases_and_plans_are_not_read(page):
    page.phrase.value = "target 0.4 m " * 200
    page.say.value = True
    wait_for(lambda: "the phrase has 2,600 characters: at most 200 are read" in page.status.content)
    page.plan.value = "1: default\n" * 1000
    page.run_plan.value = True
    wait_for(lambda: "the plan has 11,000 characters: at most 2,000 are read" in page.status.content)
    assert page.session.style["target"] == 0.0 and not page.session.scheduled


def test_a_recording_with_an_unknown_control_is_refused_and_the_session_goes_on(page):
    page._press("Step")
    do(page)
    bad = page.session.recording()
    bad.events.append({"step": 0, "controls": {"altitude": 1.0}})
    page.loop.submit(lambda session: session.replay(bad))
    wait_for(lambda: "no live control named" in page.status.content)
    page.widgets["target"].handle.value = 0.5
    page._press("Step")
    do(page)
    assert page.session.style["target"] == pytest.approx(0.5) and page.session.step_count > 1
    assert "no live control named" in page.loop.problem  # still to be read
