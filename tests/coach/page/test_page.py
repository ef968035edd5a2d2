"""The page through viser, without a browser: widgets reach the session, and follow it."""

import gzip
import socket
import threading
import urllib.request

import pytest

viser = pytest.importorskip("viser")


from coachable.coach.page import film as film_module  # noqa: E402
from coachable.coach.page.server import make_server  # noqa: E402
from coachable.scene.look import FONT, icon_link  # noqa: E402
from tests.coach.page.driving import do, say, wait_for  # noqa: E402


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


def test_a_value_that_is_shown_rounded_is_no_request(page):
    """viser calls the slider's callback when the page sets its value."""
    do(page, lambda session: session.set(fire=1.2345743))
    do(page)
    assert page.widgets["fire"].handle.value == 1.23457
    assert page.session.style["fire"] == pytest.approx(1.2345743, abs=1e-7)
    assert sum("style" in event for event in page.session.recording().events) == 1


def test_the_phrase_box_says_what_it_understood(page):
    say(page, "wild card, target 0.4 m, sing")
    assert page.session.style["target"] == pytest.approx(0.4)
    assert page.widgets["target"].handle.value == pytest.approx(0.4)
    answer = page.answer.content.replace("\\", "")
    assert "target 0 → 0.4 m" in answer and "not understood: 'sing' (unknown: sing)" in answer


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


def test_presets_do_not_pile_up_or_replace_those_of_the_agent(page):
    page.preset_name.value = "x" * 100
    page.loop.submit(page._save_preset)
    wait_for(lambda: "at most 40 characters" in page.status.content)
    page.preset_name.value = "Default"
    page.loop.submit(page._save_preset)
    wait_for(lambda: "'Default' came with the agent" in page.status.content)
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
    wait_for(lambda: "is not of the form SECONDS: PHRASE" in page.status.content)


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
        assert ".dark:not(.lit) canvas:not(.u-wrap *) {" in text and 'text(button) === "dark"' in text
        assert f"body {{ font-family: {FONT} !important; }}" in text


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
