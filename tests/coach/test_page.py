"""The page through viser, without a browser: widgets reach the session, and show what it says."""

import math
import socket
import threading
import time
import warnings
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

viser = pytest.importorskip("viser")

import msgspec  # noqa: E402, viser brings it
import websockets.sync.client as websockets  # noqa: E402, viser brings it

from coachable.coach import views  # noqa: E402
from coachable.coach.page import CoachPage  # noqa: E402
from coachable.coach.server import make_server  # noqa: E402
from coachable.coach.session import CoachSession  # noqa: E402
from coachable.styles import StyleRangeWarning  # noqa: E402
from tests.coach.echo_domain import echo_session  # noqa: E402


def wait_for(condition, seconds=20.0):
    """Until the loop's thread has got there."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.01)


@pytest.fixture(scope="module")
def server():
    server = make_server(port=18080)
    yield server
    server.stop()


@pytest.fixture
def page(server):
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


def do(page, action=lambda session: None):
    """Carries something out in the loop's thread, after all that was submitted before."""
    done = threading.Event()
    page.loop.submit(action)
    page.loop.submit(lambda _: done.set())
    assert done.wait(20.0)
    rounds = threading.Event()
    page.loop.submit(lambda _: rounds.set())  # the read-outs of the round before have been written
    assert rounds.wait(20.0)


def test_a_widget_for_every_parameter(page):
    assert list(page.widgets) == ["target", "mood", "fire"]
    slider, dropdown = page.widgets["target"].handle, page.widgets["mood"].handle
    assert (slider.label, slider.min, slider.max, slider.value) == ("target [m]", -0.8, 0.8, 0.0)
    assert dropdown.options == ("calm", "wild card")
    do(page)
    assert "trained -0.8 to 0.8 m" in page.measured["target"].handle.content


def test_a_slider_acts_at_the_next_step(page):
    page.widgets["target"].handle.value = 0.7
    page.widgets["mood"].handle.value = "wild card"
    do(page)
    assert page.session.style["target"] == pytest.approx(0.7)
    assert page.session.style["mood"] == "wild_card"
    page._press("Step")
    do(page)
    assert page.session.step_count == 1
    assert "measured **0.7 m**" in page.measured["target"].handle.content
    assert "**Request met**" in page.status.content


def test_widgets_follow_the_session(page):
    do(page, lambda session: session.set(target=-0.3, mood="wild_card"))
    assert page.widgets["target"].handle.value == pytest.approx(-0.3)
    assert page.widgets["mood"].handle.value == "wild card"
    assert len(page.session.recording().events) == 1, "following is no request"


def test_nan_from_a_browser_changes_nothing(page):
    page.widgets["target"].handle.value = 0.5
    do(page)
    page.widgets["target"].handle.value = math.nan
    wait_for(lambda: "**Problem:**" in page.status.content and "NaN" in page.status.content)
    assert page.session.style["target"] == pytest.approx(0.5)
    assert page.widgets["target"].handle.value == pytest.approx(0.5)
    speed = page.loop.speed
    page.speed.value = math.nan
    assert page.loop.speed == speed


@contextmanager
def wire(page):
    """A browser's connection without the browser: yields a function that sends a widget's new value."""
    from viser._messages import GuiUpdateMessage, ViewerCameraMessage

    address = f"127.0.0.1:{page.server.get_port()}"
    protocol = f"viser-v{viser.__version__}"
    with websockets.connect(
        f"ws://{address}", subprotocols=[protocol], origin=f"http://{address}", max_size=None
    ) as socket:

        def send(message):
            socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))

        known = set(page.server.get_clients())
        send(ViewerCameraMessage((1, 0, 0, 0), (0, 0, 1), 1.0, 0.1, 10.0, 600, 800, (0, 0, 0), (0, 0, 1)))
        wait_for(lambda: set(page.server.get_clients()) - known)  # only from then on is it heard
        yield lambda handle, value: send(GuiUpdateMessage(handle._impl.uuid, {"value": value})), socket


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


def say(page, phrase):
    page.phrase.value = phrase
    page.say.value = True  # a click
    wait_for(lambda: not page.loop._changes.qsize())
    do(page)


def test_the_phrase_box_says_what_it_understood(page):
    say(page, "wild card, target 0.4 m, sing")
    assert page.session.style["target"] == pytest.approx(0.4)
    assert page.widgets["target"].handle.value == pytest.approx(0.4)
    answer = page.answer.content.replace("\\", "")
    assert "target 0 → 0.4 m" in answer and "not understood: 'sing' (unknown: sing)" in answer


def test_outside_the_trained_range_is_flagged(page):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        say(page, "target 2 m")
    assert page.widgets["target"].handle.value == pytest.approx(0.8)
    assert "**Outside the trained range:** 2 m was asked for, 0.8 m is used" in page.measured["target"].handle.content
    page.widgets["target"].handle.value = 0.1
    do(page)
    assert "Outside" not in page.measured["target"].handle.content


def test_pause_step_resume_reset(page):
    do(page)
    assert "**paused**" in page.status.content and page.run.options[0] == "Resume"
    page._press("Resume")
    wait_for(lambda: page.session.step_count >= 3)
    page._press("Pause")
    do(page)
    count = page.session.step_count
    page._press("Step")
    do(page)
    assert page.session.step_count == count + 1
    episode = page.session.report().episode
    page._press("Reset")
    do(page)
    assert page.session.report().episode == episode + 1


def test_an_ended_episode_is_said_and_begins_again(page):
    page.loop.pause_at_end = 0.5
    do(page, lambda session: session.set(target=0.8))
    page._press("Resume")
    wait_for(lambda: "**The agent ended**" in page.status.content)
    wait_for(lambda: page.session.report().episode >= 2)


def test_presets_and_schedule(page):
    do(page, lambda session: session.set(target=0.25))
    page.preset_name.value = "mine"
    page.loop.submit(page._save_preset)
    do(page)
    assert page.preset.options == ("default", "mine") and page.preset.value == "mine"
    page.plan.value = "0: default; 0.1 s: mine\n0.2: target 0.5 and wild card"
    page.run_plan.value = True
    wait_for(lambda: page.session.scheduled == 3)
    targets = []
    for _ in range(5):
        page._press("Step")
        do(page)
        targets.append(page.session.style["target"])
    assert targets == pytest.approx([0.0, 0.0, 0.25, 0.25, 0.5])
    page.plan.value = "soon: mine"
    page.run_plan.value = True
    wait_for(lambda: "is no SECONDS: PHRASE" in page.status.content)


def test_replay_on_the_page(page):
    do(page, lambda session: session.set(target=0.5))
    for _ in range(4):
        page._press("Step")
    do(page)
    before = page.session.recording()
    do(page, lambda session: session.replay(session.recording()))
    assert "replaying" in page.status.content
    for _ in range(4):
        page._press("Step")
    do(page)
    assert page.session.recording() == before


def test_a_failing_step_pauses_and_says_so(page):
    def broken(transition):
        raise RuntimeError("a wheel came off")

    do(page)
    page.session.policy = broken
    page.loop.paused = False  # as when the very first step fails: nobody presses anything
    wait_for(lambda: "a wheel came off" in page.status.content)
    assert page.loop.paused


def test_a_failing_view_leaves_the_read_outs(page, monkeypatch):
    def torn():
        raise RuntimeError("the canvas is torn")

    do(page)
    monkeypatch.setattr(page._view, "update", torn)
    page._press("Resume")
    wait_for(lambda: "the canvas is torn" in page.status.content)
    count = page.session.step_count
    wait_for(lambda: page.session.step_count > count)


def test_a_weight_and_what_it_brings_about_have_an_axis_each(page):
    page._press("Step")
    do(page)
    assert page.chart.choice.value == "target" and len(page.chart.plot.axes) == 2
    page.chart.choice.value = "fire"
    wait_for(lambda: len(page.chart.plot.axes) == 3)
    assert page.chart.plot.series[2]["label"] == "measured (right)"
    page.chart.choice.value = "target"
    wait_for(lambda: len(page.chart.plot.axes) == 2)


def test_the_server_listens_on_this_machine_and_leaves_a_port_that_is_in_use(server):
    assert server.get_host() == "127.0.0.1"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        other = make_server(port=port)
        assert other.get_port() != port
        other.stop()


def test_no_tunnel_to_the_outside(server):
    assert server.request_share_url() is None


def test_a_view_that_cannot_be_made_is_explained(server, monkeypatch):
    def no_library(session):
        raise RuntimeError("no OpenGL library was found")

    session = echo_session()
    monkeypatch.setattr(views, "PictureView", lambda server, session: no_library(session))
    view = views.make_view(server, session)
    view.update()
    view.close()
    assert isinstance(view, views.NoView)
    session.close()


def test_a_picture_is_drawn_only_while_somebody_looks(server, monkeypatch):
    session = echo_session()
    view = views.make_view(server, session)
    drawn = []
    scene = SimpleNamespace(set_background_image=lambda picture, **_: drawn.append(picture.shape))
    client = SimpleNamespace(scene=scene, camera=SimpleNamespace(aspect=2.0, image_width=1200))
    view.update()
    assert drawn == []
    monkeypatch.setattr(server, "get_clients", lambda: {0: client})
    view.update()
    view.update()
    assert drawn == [(600, 1200, 3)], "as wide as the window, and not faster than it can be watched"
    view.close()
    session.close()


def test_pictures_keep_their_proportions():
    picture = np.zeros((60, 80, 3), dtype=np.uint8)
    assert views.padded(picture, 4 / 3).shape == (60, 80, 3)
    wide, tall = views.padded(picture, 2.0), views.padded(picture, 1.0)
    assert wide.shape == (60, 120, 3) and (wide[:, 20:100] == 0).all() and (wide[:, :20] > 0).all()
    assert tall.shape == (80, 80, 3) and (tall[10:70] == 0).all() and (tall[70:] > 0).all()


def test_the_humanoid_stays_in_the_middle_of_the_scene(server):
    pytest.importorskip("mjviser")
    server.scene.reset()
    session = CoachSession.open("humanoid", seed=1)
    view = views.make_view(server, session)
    assert isinstance(view, views.HumanoidView)
    session.run(0.5)
    view.update()
    position = session.base_env.simulation.positions[0, :2]
    assert view._scene.fixed_bodies_frame.position[:2] == pytest.approx(-position)
    session.steer(course=90.0)
    view.update()
    assert view._arrow.points[0, :, 0] == pytest.approx(0.0)
    session.close()
