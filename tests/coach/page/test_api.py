"""Other programs coach through the page's port: they read, set, subscribe, reset and push; two at once get along."""

import json
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

viser = pytest.importorskip("viser")

import websockets.sync.client as websockets  # noqa: E402, viser brings it
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

from coachable.coach.page.api import PROTOCOL  # noqa: E402
from coachable.coach.page.coach_page import CoachPage  # noqa: E402
from coachable.coach.page.server import make_server  # noqa: E402
from coachable.coach.session.session import CoachSession  # noqa: E402
from tests.coach.echo_domain import echo_session  # noqa: E402
from tests.coach.page.driving import do  # noqa: E402


def make_page(session, port):
    page = CoachPage(make_server(port=port), session)
    page.loop.pause_at_end = 0.0
    page.start()
    return page


def end(page):
    page.stop()
    page.session.close()
    page.server.stop()


@pytest.fixture(scope="module")
def echo():
    page = make_page(echo_session(seed=3), 18480)
    yield page
    end(page)


@pytest.fixture(scope="module")
def humanoid():
    page = make_page(CoachSession.open("humanoid"), 18490)
    yield page
    end(page)


def address(page):
    return f"127.0.0.1:{page.server.get_port()}"


def get(page, path, **headers):
    lines = [f"GET {path} HTTP/1.1", *(f"{k}: {v}" for k, v in ({"Host": address(page)} | headers).items()), "", ""]
    with socket.create_connection(("127.0.0.1", page.server.get_port()), timeout=20) as connection:
        connection.sendall("\r\n".join(lines).encode())
        received = b""
        while piece := connection.recv(1 << 16):
            received += piece
    head, _, body = received.partition(b"\r\n\r\n")
    return head.decode(), body


def connect(page, origin=None, protocol=PROTOCOL):
    origin = origin or f"http://{address(page)}"
    return websockets.connect(f"ws://{address(page)}/api", subprotocols=[protocol], origin=origin)


def ask(connection, **request):
    """The answer to a request; states that arrive in between are left out."""
    connection.send(json.dumps(request))
    while True:
        answer = json.loads(connection.recv(timeout=20))
        if "state" not in answer or request.get("do") == "read":
            return answer


def state_that(connection, holds):
    """The first state that a subscriber is sent for which something holds."""
    limit = time.monotonic() + 20
    while time.monotonic() < limit:
        state = json.loads(connection.recv(timeout=20)).get("state")
        if state and holds(state):
            return state
    raise AssertionError("timed out")


def test_the_space_over_http(humanoid):
    head, body = get(humanoid, "/api/space")
    assert head.startswith("HTTP/1.1 200") and "application/json" in head
    assert "Cross-Origin-Resource-Policy: same-origin" in head
    space = json.loads(body)
    assert space["domain"] == "humanoid" and space["control_step"] == 0.025
    pose, step_length = space["parameters"]
    assert pose["options"] == ["arms_in_front", "arms_up", "t_pose"]
    assert (step_length["low"], step_length["high"], step_length["unit"]) == (0.3, 0.65, "m")
    assert space["controls"][0]["name"] == "course" and space["controls"][0]["circular"]
    assert space["push"] == {"largest": 200.0, "unit": "N"}
    assert [b["name"] for b in space["bindings"]] == ["course", "pose", "step_length"]


def test_the_state_over_http(echo):
    limit = time.monotonic() + 20
    while not (state := json.loads(get(echo, "/api/state")[1])) or not state["measured"]:
        assert time.monotonic() < limit
        time.sleep(0.05)
    assert state["requested"] == echo.session.style
    assert set(state) >= {"step", "time", "measured", "outside", "paused", "episode", "ended", "controls"}
    assert get(echo, "/api/nothing")[0].startswith("HTTP/1.1 404")


def test_set_is_clamped_as_the_session_does(echo):
    with connect(echo) as connection:
        answer = ask(connection, do="set", style={"target": 0.5, "mood": "wild_card"}, id=7)
        assert answer["id"] == 7 and answer["outside"] == {}
        assert answer["style"] == {"target": 0.5, "mood": "wild_card", "fire": 0.0} == echo.session.style
        answer = ask(connection, do="set", style={"target": 9})
        assert answer["style"]["target"] == pytest.approx(0.8) and answer["outside"] == {"target": 9.0}
        echo.session.strict = True
        try:
            assert "lies outside" in ask(connection, do="set", style={"target": 9})["error"]
        finally:
            echo.session.strict = False
        assert ask(connection, do="set", style={"target": 0, "mood": "calm"})["outside"] == {}


def test_a_state_that_is_read_after_the_answer_has_the_change(echo):
    with connect(echo) as connection:
        for target in (0.1, 0.2, 0.3, 0.4, 0.5):
            style = ask(connection, do="set", style={"target": target})["style"]
            assert ask(connection, do="read")["state"]["requested"] == style


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ("nonsense", "the message is not valid JSON"),
        ("[1]", "the message is a list: expected an object with the entry 'do'"),
        ('{"do": "set", "style": {"target": NaN}}', "the message is not valid JSON"),
        ('{"do": "set", "style": {"target": 1' + "0" * 400 + "}}", "expected a number"),
        ('{"do": "set", "style": {"target": true}}', "target = True: expected a number"),
        ('{"do": "set", "style": {"mood": "merry"}}', "mood = 'merry' is not an option: expected one of"),
        ('{"do": "set", "style": {"self": 1}}', "nothing is named 'self': expected some of ['target', 'mood', 'fire']"),
        ('{"do": "set", "style": {"strict": 1}}', "nothing is named 'strict'"),
        ('{"do": "set"}', "style is missing: expected values by name"),
        ('{"do": "steer", "controls": {"course": 1}}', "nothing is named 'course'"),
        ('{"do": "push", "forward": 1}', "echo has no push"),
        ('{"do": "push", "left": "far"}', "left = far: expected a number"),
        ('{"do": "reset", "seed": -1}', "seed = -1: expected a whole number"),
        ('{"do": "reset", "seed": 1.5}', "seed = 1.5: expected a whole number"),
        ('{"do": "subscribe", "rate": 1000}', "rate = 1000: expected 0, or 0.1 to 50 per second"),
        ('{"do": "press", "key": "F1"}', "nothing is bound to 'F1'"),
        ('{"do": "press"}', "nothing is bound to 'None'"),
        ('{"do": "press", "button": true}', "nothing is bound to 'True'"),
        ('{"do": "move", "axis": 9, "position": 0}', "nothing is bound to axis 9"),
        ('{"do": "move", "axis": 0, "position": "left"}', "position = left: expected a number"),
        ('{"do": "fly"}', "do = 'fly': expected 'space', 'read', "),
        ('{"id": [1]}', "the id of the message is neither"),
        ('"' + "x" * (1 << 16) + '"', "characters: expected at most 65,536"),
        ("[" * 60_000, "the message is not valid JSON"),
    ],
)
def test_bad_messages_change_nothing_and_are_answered(message, error, echo):
    style = echo.session.style
    with connect(echo) as connection:
        connection.send(message)
        assert error in json.loads(connection.recv(timeout=20))["error"]
        assert "state" in ask(connection, do="read"), "the connection goes on"
    assert echo.session.style == style


def test_two_programs_at_once(echo):
    with connect(echo) as first, connect(echo) as second:
        assert ask(first, do="subscribe", rate=20) == {"rate": 20.0}
        assert ask(second, do="subscribe", rate=10) == {"rate": 10.0}
        ask(first, do="set", style={"target": 0.25})
        assert state_that(second, lambda s: s["requested"]["target"] == 0.25)["measured"] is not None
        ask(second, do="set", style={"fire": 1.5})
        seen = state_that(first, lambda s: s["requested"]["fire"] == 1.5)
        assert seen["requested"]["target"] == 0.25, "neither overwrites what the other one set"
        first.close()
        step = echo.session.step_count
        assert state_that(second, lambda s: s["step"] > step + 3), "one goes away, the other one goes on"
        assert ask(second, do="subscribe", rate=0) == {"rate": 0.0}
        with pytest.raises(TimeoutError):
            for _ in range(50):
                second.recv(timeout=1.0)


def test_many_requests_of_two_programs_are_all_answered(echo):
    answers = {}

    def coach(name, parameter):
        with connect(echo) as connection:
            for k in range(40):
                answers[name, k] = ask(connection, do="set", style={parameter: k / 100}, id=k)

    threads = [threading.Thread(target=coach, args=pair) for pair in (("a", "target"), ("b", "fire"))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(answers[name, k]["id"] == k and "style" in answers[name, k] for name in "ab" for k in range(40))
    style = echo.session.style
    assert (style["target"], style["fire"]) == (pytest.approx(0.39), pytest.approx(0.39))


def test_reset_and_seed(echo):
    with connect(echo) as connection:
        episode = echo.session.report().episode
        ask(connection, do="reset")
        assert echo.session.report().episode > episode
        ask(connection, do="reset", seed=11)
        assert echo.session.recording().seed == 11


def test_keys_buttons_and_axes_are_forwarded(echo):
    with connect(echo) as connection:
        target, mood, fire = ask(connection, do="space")["space"]["bindings"]
        ask(connection, do="set", style={"target": 0.0, "mood": "calm", "fire": 0.0})
        assert ask(connection, do="press", key=target["keys"][1])["style"]["target"] == pytest.approx(0.16)
        assert ask(connection, do="press", key=target["keys"][0])["style"]["target"] == pytest.approx(0.0, abs=1e-6)
        assert ask(connection, do="move", axis=target["axis"], position=-1)["style"]["target"] == pytest.approx(-0.8)
        assert ask(connection, do="press", button=mood["buttons"][1])["style"]["mood"] == "wild_card"
        assert ask(connection, do="press", key=mood["keys"][1])["style"]["mood"] == "calm"
        assert ask(connection, do="move", axis=fire["axis"], position=1)["style"]["fire"] == pytest.approx(2.0)
        assert ask(connection, do="press", key=fire["keys"][1])["outside"] == {}, "keys stay within the range"


def test_steer_and_push(humanoid):
    with connect(humanoid) as connection:
        assert ask(connection, do="steer", controls={"course": 190})["controls"] == {"course": -170.0}
        ask(connection, do="steer", controls={"course": 90})
        do(humanoid, lambda session: session.run(2.1))  # until it has turned
        ask(connection, do="push", forward=600, left=0)
        (event,) = [event for event in humanoid.session.recording().events if "push" in event]
        assert event["push"] == [200.0, 0.0]
        assert humanoid.session.base_env.push[0].tolist() == pytest.approx([0.0, 200.0, 0.0], abs=1e-9)
        assert "expected a number" in ask(connection, do="push", forward="hard")["error"]


@pytest.mark.parametrize("origin", ["http://evil.example", "http://localhost:3000", "null"])
def test_foreign_pages_are_refused(origin, echo):
    with pytest.raises(InvalidStatus, match="403"), connect(echo, origin=origin):
        pass
    head, _ = get(echo, "/api/space", Host="evil.example")
    assert head.startswith("HTTP/1.1 403")


def test_the_protocol_is_asked_for(echo):
    with pytest.raises(InvalidStatus, match="403"), connect(echo, protocol="other"):
        pass
    with pytest.raises(InvalidStatus, match="403"), connect(echo, protocol=f"viser-v{viser.__version__}"):
        pass


def test_before_the_agent_is_there():
    server = make_server(port=18470)
    page = type("Page", (), {"server": server})
    assert get(page, "/api/space")[0].startswith("HTTP/1.1 503")
    with connect(page) as connection, pytest.raises(ConnectionClosed, match="the agent is being loaded"):
        connection.recv(timeout=20)
    server.stop()


GUIDE = (Path(__file__).resolve().parents[3] / "docs" / "guides" / "coach_from_code.md").read_text()


def example(language):
    (program,) = re.findall(rf"```{language}\n(.*?)```", GUIDE, re.DOTALL)
    return program


def test_the_documented_python_program(echo):
    program = [sys.executable, "-W", "error", "-c", example("python"), f"http://{address(echo)}"]
    done = subprocess.run(program, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "asked for {'target': 0.8" in done.stdout and done.stdout.count(" s: measured {") == 5
    assert echo.session.style["fire"] == 2.0


def node():
    """The command of a Node with WebSockets, None if there is none."""
    for options in ([], ["--experimental-websocket"]):
        command = ["node", *options]
        if shutil.which("node"):
            test = [*command, "-e", "process.exit(typeof WebSocket === 'function' ? 0 : 1)"]
            if subprocess.run(test, capture_output=True).returncode == 0:
                return command
    return None


@pytest.mark.skipif(node() is None, reason="no Node with WebSocket is installed")
def test_the_documented_javascript_program(echo, tmp_path):
    file = tmp_path / "coach.mjs"
    file.write_text(example("javascript"))
    done = subprocess.run([*node(), str(file), f"http://{address(echo)}"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert 'asked for {"target":-0.8' in done.stdout and done.stdout.count(" s: measured {") == 5
    assert echo.session.style["fire"] == -0.5


def test_a_live_session_replays_to_the_same_actions(humanoid):
    """What several programs asked for while the agent acted, in real time, is repeated bit for bit."""
    session, actions = humanoid.session, []
    step = type(session).step

    def noted():
        transition = step(session)
        actions.append(transition["action"].clone())
        return transition

    def start(session):
        session.reset(5)
        actions.clear()
        session.step = noted

    with connect(humanoid) as first, connect(humanoid) as second:
        humanoid.loop.submit(start)
        ask(first, do="subscribe", rate=20)
        ask(first, do="set", style={"pose": "t_pose", "step_length": 0.4})
        ask(second, do="steer", controls={"course": 20})
        state_that(first, lambda s: s["step"] >= 20)
        ask(second, do="push", forward=30, left=-20)
        ask(first, do="set", style={"pose": "arms_up"})
        state_that(first, lambda s: s["step"] >= 50)
        ask(second, do="reset")
        state_that(first, lambda s: s["step"] >= 60)
    humanoid.loop.paused = True
    done = threading.Event()
    kept = {}

    def keep(session):
        kept.update(recording=session.recording(), actions=list(actions))
        del session.step
        done.set()

    humanoid.loop.submit(keep)
    assert done.wait(20)
    humanoid.loop.paused = False
    recording = kept["recording"]
    assert recording.steps == len(kept["actions"]) >= 60
    assert {name for event in recording.events for name in event} == {"step", "style", "controls", "push", "reset"}
    replica = session.replica()
    replica.replay(recording)
    for action in kept["actions"]:
        assert replica.step()["action"].equal(action)
    replica.close()
