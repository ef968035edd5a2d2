"""The page through viser, without a browser: widgets reach the session, and show what it says."""

import gzip
import math
import socket
import threading
import time
import urllib.request
import warnings
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

viser = pytest.importorskip("viser")

import msgspec  # noqa: E402, viser brings it
import websockets.sync.client as websockets  # noqa: E402, viser brings it

from coachable.coach.page import film as film_module  # noqa: E402
from coachable.coach.page import scene_view, views  # noqa: E402
from coachable.coach.page.coach_page import CoachPage, verdict  # noqa: E402
from coachable.coach.page.server import make_server  # noqa: E402
from coachable.coach.session.readout import StyleReport  # noqa: E402
from coachable.coach.session.session import CoachSession  # noqa: E402
from coachable.domains.combat.stage import CombatStage  # noqa: E402
from coachable.domains.humanoid.stage import HumanoidStage  # noqa: E402
from coachable.domains.racing.stage import RacingStage  # noqa: E402
from coachable.scene.look import icon_link  # noqa: E402
from coachable.scene.parts import Parts  # noqa: E402
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
    assert "measured **0.7 m** in" in page.measured["target"].handle.content
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


@pytest.mark.parametrize("speed", [math.nan, math.inf, -1.0, 0.0, 1e6])
def test_impossible_speeds_are_refused(page, speed):
    page.speed.value = 2.0
    wait_for(lambda: page.loop.speed == 2.0)
    page.speed.value = speed
    wait_for(lambda: "speed = " in page.status.content and "from 0.1 to 4" in page.status.content)
    assert page.loop.speed == 2.0 and page.speed.value == 2.0


def test_an_unknown_option_or_button_changes_nothing(page):
    page.widgets["mood"].handle.value = "angry"
    wait_for(lambda: "no option" in page.status.content and page.widgets["mood"].handle.value == "calm")
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


def test_changes_that_keep_coming_leave_the_agent_time_to_act(page):
    """Each change asks for the next, as a browser can."""

    def again(_session):
        page.loop.submit(again)

    page.loop.submit(again)
    page._press("Resume")
    count = page.session.step_count
    wait_for(lambda: page.session.step_count > count + 5)


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


def test_long_phrases_and_plans_are_not_read(page):
    page.phrase.value = "target 0.4 m " * 200
    page.say.value = True
    wait_for(lambda: "the phrase has 2,600 characters: at most 200 are read" in page.status.content)
    page.plan.value = "1: default\n" * 1000
    page.run_plan.value = True
    wait_for(lambda: "the plan has 11,000 characters: at most 2,000 are read" in page.status.content)
    assert page.session.style["target"] == 0.0 and not page.session.scheduled


def test_the_agent_acts_while_a_phrase_is_read(page, monkeypatch):
    reading, finish = threading.Event(), threading.Event()
    read = page.session.grammar.read

    def slowly(*arguments):
        reading.set()
        assert finish.wait(20)
        return read(*arguments)

    monkeypatch.setattr(page.session.grammar, "read", slowly)
    page._press("Resume")
    page.phrase.value = "target 0.4 m"
    threading.Thread(target=setattr, args=(page.say, "value", True)).start()  # as viser does for a browser
    assert reading.wait(20)
    count = page.session.step_count
    wait_for(lambda: page.session.step_count > count + 5)
    page.run_plan.value = True
    wait_for(lambda: "the input before is still being read" in page.status.content)
    finish.set()
    wait_for(lambda: page.session.style["target"] == pytest.approx(0.4))


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
    assert page.session.style["target"] == pytest.approx(0.5) and page.loop.problem == ""


def test_presets_do_not_pile_up(page):
    page.preset_name.value = "x" * 100
    page.loop.submit(page._save_preset)
    wait_for(lambda: "at most 40 characters" in page.status.content)
    page.session.presets |= {f"p{number}": {} for number in range(48)}
    for name in ("last", "one too many"):
        page.preset_name.value = name
        page.loop.submit(page._save_preset)
        do(page)
    assert len(page.session.presets) == len(page.preset.options) == 50


def test_one_film_at_a_time_and_not_of_long_sessions(page, monkeypatch):
    go = threading.Event()
    monkeypatch.setattr(film_module, "film", lambda *_, **__: go.wait(20) and (_ for _ in ()).throw(ValueError("torn")))
    page._press("Step")
    for _ in range(2):
        page.loop.submit(lambda session: page._shoot(session, None))
    wait_for(lambda: "a film is being drawn already" in page.status.content)
    go.set()
    wait_for(lambda: page.film_note.content == "Problem: torn")
    monkeypatch.setattr(film_module, "_LONGEST_SESSION", 0.01)
    page.loop.submit(lambda session: page._shoot(session, None))
    wait_for(lambda: "expected at most 0 s" in page.status.content)


def test_the_chart_follows_what_was_asked_for_last(page):
    page._press("Step")
    do(page)
    page.widgets["fire"].handle.value = 1.0
    wait_for(lambda: page.chart.shown == "fire" and page.chart.choice.value == "fire")
    page.widgets["mood"].handle.value = "wild card"
    wait_for(lambda: page.chart.shown == "mood")
    say(page, "target 0.4 m")
    assert page.chart.shown == "target"
    page.chart.choice.value = "fire"
    wait_for(lambda: page.chart.shown == "fire")
    page.widgets["target"].handle.value = 0.5
    wait_for(lambda: page.chart.shown == "target")


def test_the_chart_has_a_fixed_axis_of_time_and_says_when_nothing_was_measured(page):
    for _ in range(2):
        page._press("Step")
        do(page)
    assert page.chart.plot.scales["x"]["range"] == (-30.0, 0.0)
    ago, asked, measured = page.chart.plot.data
    assert ago == pytest.approx([-0.05, 0.0]) and measured == pytest.approx(asked)
    assert not page.chart.note.visible
    page.chart.choice.value = "mood"
    wait_for(lambda: "mood: nothing was measured" in page.chart.note.content and page.chart.note.visible)
    assert len(page.chart.plot.data) == 2, "what was asked for only"


def test_what_is_shown_is_measured_or_says_that_it_is_not(page):
    page.widgets["target"].handle.value = 0.5
    do(page)
    texts = {name: text.handle.content for name, text in page.measured.items()}
    assert texts["target"] == "not measured yet · trained -0.8 to 0.8 m"
    page._press("Step")
    do(page)
    texts = {name: text.handle.content for name, text in page.measured.items()}
    assert texts["target"] == "measured **0.5 m** in 0.1 s · trained -0.8 to 0.8 m"
    assert texts["mood"] == "no measure of its own"
    assert "pace **0.5 m/step**" in page.others.content, "the domain declares the unit"
    do(page, lambda session: session.set(target=-0.5))
    assert "not measured yet" in page.measured["target"].handle.content, "0.5 m belongs to the request before"


def report(**changes):
    """Of a request that was met, with changes."""
    values = {
        "requested": {"target": 0.5},
        "measured": {"target": 0.5},
        "unmeasured": (),
        "seconds": 2.0,
        "outside": {},
        "asks": True,
        "complying": 1.0,
        "needs": "a footstep",
        "complied_after": 0.5,
        "since_request": 9.0,
        "episode": 1,
        "episode_time": 9.0,
        "ended": None,
        "endings": {},
    }
    return StyleReport(**values | changes)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, "**Request met**, first after 0.5 s: 100% of what was judged in the last 2.0 s."),
        ({"complying": 0.25}, "Request met first after 0.5 s, but only 25% of what was judged in the last 2.0 s."),
        ({"complying": None}, "Request met first after 0.5 s; nothing to judge in the last 2.0 s."),
        ({"complying": 0.0, "complied_after": None}, "Request not yet met, after 9.0 s."),
        (
            {"complying": None, "complied_after": None},
            "Request not judged yet, after 9.0 s: that takes a footstep.",
        ),
        ({"asks": False, "complied_after": None}, "Nothing is asked for: every weight is 0."),
    ],
)
def test_the_verdict_says_what_it_rests_on(changes, text):
    assert verdict(report(**changes)) == text


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
    def torn(share):
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


@pytest.mark.parametrize("aspect", [0.0, -1.0, 1e-9, 1e9, math.inf, math.nan])
def test_no_window_makes_a_picture_huge(aspect):
    picture = np.zeros((60, 80, 3), dtype=np.uint8)
    assert views.padded(picture, aspect).size <= 4 * 4 * picture.size


def test_in_a_narrow_window_the_picture_lies_above_the_panel(server, monkeypatch):
    """viser's panel covers the lower 60 % of such a window."""
    session, shown = echo_session(), []
    view = views.make_view(server, session)
    scene = SimpleNamespace(set_background_image=lambda picture, **_: shown.append(picture))
    client = SimpleNamespace(scene=scene, camera=SimpleNamespace(aspect=0.5, image_width=400))
    monkeypatch.setattr(server, "get_clients", lambda: {0: client})
    view.update()
    drawn = (shown[0] != views._BORDER).any(-1).any(-1)
    assert shown[0].shape[:2] == (1600, 800) and drawn[:600].all() and not drawn[600:].any()
    view.close()
    session.close()


def test_the_page_has_its_own_title_and_icon(server):
    request = urllib.request.Request(f"http://127.0.0.1:{server.get_port()}/", headers={"Accept-Encoding": "gzip"})
    with urllib.request.urlopen(request) as answer:
        assert answer.headers["Content-Encoding"] == "gzip" and "frame-ancestors 'none'" in str(answer.headers)
        packed = gzip.decompress(answer.read()).decode()
    plain = urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}/").read().decode()
    for text in (packed, plain):
        head = text[: text.index("</title>")]
        assert head.endswith("<title>coachable") and icon_link() in head and "Viser" not in head
        assert "prefers-color-scheme: dark" in text and ".gauges {" in text


@pytest.fixture
def walker(server):
    """A page with the humanoid, paused before its first step, and a browser that looks at it."""
    server.gui.reset()
    server.scene.reset()
    session = CoachSession.open("humanoid", seed=1)
    page = CoachPage(server, session)
    page.loop.paused = True
    page.start()
    yield page
    page.stop()
    session.close()


def test_a_push_reaches_the_agent_and_the_recording(walker):
    slider, buttons = walker.push_strength, walker.push_buttons
    assert (slider.min, slider.max, slider.value) == (10.0, 200.0, 100.0)
    slider.value = 150.0
    walker._press("Step")
    do(walker)
    buttons.value = "left"
    do(walker)
    assert walker.session.base_env.pushing[0] == pytest.approx([0.0, 150.0, 0.0])
    event = {"step": 1, "push": [0.0, 150.0]}
    assert walker.session.recording().events == [event]
    assert walker.loop.problem == ""


def test_the_camera_follows_turns_or_stays(server, monkeypatch):
    server.gui.reset()
    server.scene.reset()
    session = CoachSession.open("humanoid", seed=1)
    view = views.make_view(server, session)
    assert isinstance(view, scene_view.SceneView)
    view.update()
    assert view.frame is None, "nobody looks"
    monkeypatch.setattr(server, "get_clients", lambda: {0: None})
    session.run(0.5)
    view.update()
    position = session.base_env.simulation.positions[0, :2].copy()
    assert view._root.position[:2] == pytest.approx(-position)
    assert view._ground.position[:2] == pytest.approx(np.round(position)), "the pattern of the ground stays in place"
    assert "last steps" in view.overlay and '<div class="gauge">' in view.overlay

    view.mode.value = scene_view.TURN
    session.steer(course=90.0)
    session.step()
    view.update()
    x, y = session.base_env.simulation.positions[0, :2]
    assert view._root.position[:2] == pytest.approx([-y, x], abs=1e-5), "what lies ahead is ahead in the picture"

    before = view._root.position.copy()
    view.mode.value = scene_view.STAY
    session.run(0.5)
    view.update()
    assert view._root.position == pytest.approx(before)
    session.close()


def test_slow_control_steps_are_drawn_in_between(server, monkeypatch):
    """A fight has five states per second."""
    server.gui.reset()
    server.scene.reset()
    monkeypatch.setattr(server, "get_clients", lambda: {0: None})
    session = CoachSession.open("combat", seed=1)
    view = views.make_view(server, session)
    view.mode.value = scene_view.FOLLOW
    focus = []
    for _ in range(2):
        session.step()
        view.update()
        focus.append(np.asarray(view.frame.focus)[:2])
    view.update(0.25)
    between = focus[0] + 0.25 * (focus[1] - focus[0])
    assert -view._root.position[:2] == pytest.approx(between, abs=1e-5)
    assert view._moving.position[:2] == pytest.approx(between, abs=1e-5)
    view.update()
    placed = view._nodes["parts", "ball"].handle.batched_positions + view._moving.position
    balls = view.frame.parts.of("ball").positions
    assert placed[: len(balls)] == pytest.approx(balls, abs=1e-4), "relative to what the camera follows"
    session.close()


def test_a_node_has_room_for_more_primitives(server):
    server.scene.reset()
    node = scene_view._Node(server, "/balls", "ball")
    node.show(Parts())
    assert node.handle is None
    for count in (4, 6, 7, 2):
        parts = Parts()
        for index in range(count):
            parts.ball((index, 0.0, 0.0), (1.0, 1.0, 1.0), (255, 188, 0))
        node.show(parts)
        shown = node.handle.batched_positions[:, 2] > -1.0
        assert shown.sum() == count and len(shown) == (6 if count in (4, 6) else 11)
        assert node.handle.batched_positions[shown, 0].tolist() == list(range(count))
    assert node.handle.batched_colors[0].tolist() == [255, 128, 0], "linear, as viser wants them"


@pytest.mark.parametrize("make", [HumanoidStage, RacingStage, CombatStage])
def test_in_a_narrow_window_the_camera_shows_the_agent_above_the_panel(make):
    viewpoint = make.viewpoint
    position, target = scene_view.camera_of(viewpoint, narrow=True)
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    up = np.cross(right / np.linalg.norm(right), ahead)
    for height in (0.0, 2.0):  # from the soles to the hands
        seen = np.array([0.0, 0.0, height]) - position
        share = (seen @ up) / (seen @ ahead) / np.tan(np.deg2rad(45.0) / 2)  # -1 below, 1 above
        assert 0.2 < share < 1.0, "above the panel's 60 %"
    position, target = scene_view.camera_of(viewpoint)
    assert np.linalg.norm(target - position) == pytest.approx(viewpoint.distance) and target[2] == viewpoint.height
