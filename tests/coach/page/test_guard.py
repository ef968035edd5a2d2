"""The page's server against strangers: foreign pages, random bytes, floods, silence. The agent goes on acting."""

import json
import random
import socket
import threading
import time

import pytest

viser = pytest.importorskip("viser")

import msgspec  # noqa: E402, viser brings it
import websockets.sync.client as websockets  # noqa: E402, viser brings it
from websockets import Headers  # noqa: E402
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402
from websockets.http11 import Request  # noqa: E402

from coachable.coach.page import guard  # noqa: E402
from coachable.coach.page.coach_page import CoachPage  # noqa: E402
from coachable.coach.page.guard import Guard  # noqa: E402
from coachable.coach.page.server import make_server  # noqa: E402
from tests.coach.echo_domain import echo_session  # noqa: E402

PROTOCOL = f"viser-v{viser.__version__}"
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 1.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 10.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


@pytest.fixture(scope="module")
def page():
    """An agent that acts, fast, on a page that anybody may try to break."""
    page = CoachPage(make_server(port=18380), echo_session(seed=3))
    page.loop.pause_at_end, page.loop.speed = 0.0, 4.0
    page.start()
    yield page
    page.stop()
    page.session.close()
    page.server.stop()


@pytest.fixture(autouse=True)
def the_agent_goes_on(page, capfd):
    """After every test the agent acts, its page is served, no traceback was printed, and its style is as before."""
    style = page.session.style
    yield
    count = page.session.step_count
    wait_for(lambda: page.session.step_count > count + 3)
    assert not page.loop.paused
    assert page.session.style == style
    assert get(page).startswith(b"HTTP/1.1 200")
    assert "Traceback" not in capfd.readouterr().err


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.01)


def own(page):
    return f"127.0.0.1:{page.server.get_port()}"


def get(page, path="/", **headers):
    """The beginning of the answer to a request."""
    lines = [f"GET {path} HTTP/1.1", *(f"{k}: {v}" for k, v in ({"Host": own(page)} | headers).items() if v), "", ""]
    with socket.create_connection(("127.0.0.1", page.server.get_port()), timeout=20) as connection:
        connection.sendall("\r\n".join(lines).encode())
        return connection.recv(4096)


def connect(page, *, host=None, origin="own", protocol=PROTOCOL):
    """A browser's connection, as a page of some origin opens it under some name of this machine."""
    host = host or own(page)
    origin = f"http://{host}" if origin == "own" else origin
    tcp = socket.create_connection(("127.0.0.1", page.server.get_port()))
    tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return websockets.connect(f"ws://{host}", sock=tcp, subprotocols=[protocol], origin=origin, max_size=None)


def send(connection, **message):
    connection.send(msgspec.msgpack.encode(message))


def enter(page, connection):
    """Has a connection heard, as a browser does by its first message."""
    known = set(page.server.get_clients())
    send(connection, **CAMERA)
    wait_for(lambda: set(page.server.get_clients()) - known)


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        (None, "http://evil.example"),
        (None, "http://localhost:3000"),
        (None, "https://127.0.0.1:18380"),
        (None, "null"),
        (None, None),
        ("evil.example:18380", "own"),
        ("127.0.0.1.evil.example", "own"),
        ("localhost.evil.example:18380", "http://127.0.0.1:18380"),
    ],
)
def test_a_foreign_page_neither_steers_nor_reads(page, host, origin):
    with pytest.raises(InvalidStatus, match="403"), connect(page, host=host, origin=origin):
        pass


@pytest.mark.parametrize("host", ["localhost:1234", "127.0.0.1", "[::1]:8080", "LOCALHOST"])
def test_the_own_page_is_connected_through_any_port(page, host):
    with connect(page, host=host) as connection:
        assert connection.recv(timeout=20)


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/", {"Host": "evil.example"}),
        ("/", {"Host": ""}),
        ("/", {"Host": "evil.example@127.0.0.1"}),
        ("/", {"Origin": "http://evil.example"}),
        ("/?websocket=ws://evil.example", {}),
        ("/?a=1&playbackPath=http%3A//evil.example/x.viser", {}),
    ],
)
def test_foreign_requests_are_refused(page, path, headers):
    assert get(page, path, **headers).startswith(b"HTTP/1.1 403")


def test_the_page_is_shown_in_no_foreign_frame_and_asks_no_other_server(page):
    answer = get(page).split(b"\r\n\r\n")[0].decode()
    assert "X-Frame-Options: DENY" in answer and "frame-ancestors 'none'" in answer
    assert f"connect-src 'self' ws://{own(page)} data: blob:;" in answer


def refusal(guard, host, **headers):
    return guard.refusal(Request("/", Headers({"Host": host} | headers)))


def test_names_of_a_server_that_others_may_reach(monkeypatch):
    monkeypatch.setattr(guard.socket, "gethostname", lambda: "Workshop")
    here, there, everywhere = Guard("127.0.0.1"), Guard("coach.lan"), Guard("0.0.0.0")
    assert refusal(here, "192.168.0.7:8080") and refusal(here, "workshop") and not refusal(here, "localhost")
    assert not refusal(there, "coach.lan:8080") and refusal(there, "workshop:8080")
    for name in ("workshop:8080", "192.168.0.7:8080", "[fe80::1]:8080", "localhost"):
        assert not refusal(everywhere, name)
    assert refusal(everywhere, "evil.example") and refusal(everywhere, "workshop.evil.example")


def test_a_viser_that_starts_otherwise_is_not_served_unguarded(monkeypatch):
    from contextlib import nullcontext

    monkeypatch.setattr(Guard, "around", lambda self: nullcontext())
    with pytest.raises(ImportError, match="in a way that the page cannot guard"):
        make_server(port=18480)


NONSENSE = [
    b"",
    b"\x00" * 64,
    random.Random(0).randbytes(4000),
    b"\x91" * 5000,  # nested lists
    b"\xdd\xff\xff\xff\xff",  # four billion entries to come
    msgspec.msgpack.encode([1, 2, 3]),
    msgspec.msgpack.encode({"type": 7}),
    "a text",
]


@pytest.mark.parametrize("nonsense", NONSENSE, ids=range(len(NONSENSE)))
def test_nonsense_ends_the_connection(page, nonsense):
    with connect(page) as connection:
        connection.send(nonsense)
        with pytest.raises(ConnectionClosed):
            while True:
                connection.recv(timeout=20)
        assert connection.close_code == 1007


def test_messages_that_no_browser_sends_change_nothing(page):
    slider, dropdown = page.widgets["target"].handle, page.widgets["mood"].handle
    with connect(page) as connection:
        enter(page, connection)
        for updates in (
            {"update_cb": "x"},
            {"removed": True},
            {"value": [1]},
            {"value": None},
            {"value": 0.5, "x": 1},
            7,
        ):
            send(connection, type="GuiUpdateMessage", uuid=slider._impl.uuid, updates=updates)
        for kind in ("RunJavascriptMessage", "ShareUrlRequest", "SceneNodeUpdateMessage", "Unheard"):
            send(connection, type=kind, source="alert()")
        for size in (0, -1, 1 << 40, "wide"):
            send(connection, **CAMERA | {"image_height": size})
        send(connection, **CAMERA | {"fov": float("nan")})
        send(connection, type="GuiUpdateMessage", uuid=slider._impl.uuid, updates={"value": "much"})
        send(connection, type="GuiUpdateMessage", uuid=dropdown._impl.uuid, updates={"value": "angry"})
        wait_for(lambda: "is not an option" in page.loop.problem)
        wait_for(lambda: dropdown.value == "calm")
    assert page.server.scene is not None and not slider._impl.removed
    assert slider.value == page.session.style["target"]


def test_random_bytes_instead_of_http(page):
    chance = random.Random(1)
    for _ in range(10):
        with socket.create_connection(("127.0.0.1", page.server.get_port()), timeout=20) as connection:
            connection.sendall(chance.randbytes(300) + b"\r\n\r\n")
            assert b"200" not in connection.recv(100)


def test_an_oversized_message_ends_the_connection(page):
    with connect(page) as connection:
        with pytest.raises(ConnectionClosed):
            connection.send(bytes(3 << 20))
            while True:
                connection.recv(timeout=20)
        assert connection.close_code == 1009


def test_uploads_end(page, monkeypatch):
    monkeypatch.setattr(guard, "_UPLOADED", 1000)
    with connect(page) as connection:
        enter(page, connection)
        part = {"source_component_uuid": "x", "transfer_uuid": "y", "content": bytes(400)}
        with pytest.raises(ConnectionClosed):
            for index in range(100):
                send(connection, type="FileTransferPart", part_index=index, **part)
                connection.recv(timeout=20)
            while True:
                connection.recv(timeout=20)
        assert connection.close_code == 1009


def test_an_uploaded_recording_with_an_unknown_control_is_refused(page):
    recording = page.session.recording()
    recording.events.append({"step": recording.steps, "controls": {"altitude": 1.0}})
    content = recording.to_json().encode()
    names = {"source_component_uuid": page.upload._impl.uuid, "transfer_uuid": "t"}
    with connect(page) as connection:
        enter(page, connection)
        about = {"filename": "x.json", "mime_type": "application/json", "part_count": 1, "size_bytes": len(content)}
        send(connection, type="FileTransferStartUpload", **names, **about)
        send(connection, type="FileTransferPart", part_index=0, content=content, **names)
        wait_for(lambda: "no live control named" in page.loop.problem)
    page.loop.submit(lambda _: None)


def test_fifty_connections_are_opened_and_dropped(page):
    connections = [connect(page) for _ in range(50)]
    wait_for(lambda: len(page.server._websock_server._live_connections) >= 50)
    for connection in connections[:25]:
        connection.socket.shutdown(socket.SHUT_RDWR)  # no goodbye
    for connection in connections[25:]:
        connection.close()
    wait_for(lambda: not page.server._websock_server._live_connections)


def test_further_browsers_wait_their_turn(page, monkeypatch):
    monkeypatch.setattr(guard, "_CONNECTIONS", 1)
    with connect(page), pytest.raises(InvalidStatus, match="503"), connect(page):
        pass


def deaf(page):
    """A browser that is heard and reads nothing more, not even a goodbye."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    connection.connect(("127.0.0.1", page.server.get_port()))
    lines = (
        *("GET / HTTP/1.1", f"Host: {own(page)}", f"Origin: http://{own(page)}", "Connection: Upgrade"),
        *("Upgrade: websocket", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Protocol: {PROTOCOL}"),
        *("Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "", ""),
    )
    connection.sendall("\r\n".join(lines).encode())
    assert connection.recv(12) == b"HTTP/1.1 101"
    content = msgspec.msgpack.encode(CAMERA)
    connection.sendall(bytes([0x82, 0xFE]) + len(content).to_bytes(2, "big") + bytes(4) + content)
    return connection


def test_a_client_that_stops_reading(page):
    """Neither the agent nor the other browsers wait for it, and what it has not read does not pile up."""
    server = page.server._websock_server
    with connect(page) as other:
        enter(page, other)
        known = set(page.server.get_clients())
        with deaf(page):
            wait_for(lambda: set(page.server.get_clients()) - known)
            count, chance = page.session.step_count, random.Random(2)
            for _ in range(30):
                page.film_note.content = chance.randbytes(100_000).hex()
                other.recv(timeout=20)
            page.film_note.content = ""
            other.recv(timeout=20)
            wait_for(lambda: page.session.step_count > count + 3)
            buffers = [state.message_buffer for state in server._client_state_from_id.values()]
            assert all(len(b.message_from_id) < 1000 for b in (server._broadcast_buffer, *buffers))
        wait_for(lambda: set(page.server.get_clients()) == known)


def test_a_flood_is_slowed_down(page, monkeypatch):
    monkeypatch.setattr(guard, "_MESSAGES_PER_SECOND", 50.0)
    handle = page.seed
    with connect(page) as connection:
        enter(page, connection)
        start, steps = time.monotonic(), page.session.step_count
        for value in range(100):
            send(connection, type="GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": value})
        wait_for(lambda: handle.value == 99)
        assert time.monotonic() - start > 0.8, "50 at once, then 50 in a second"
        assert page.session.step_count > steps + 10


def test_a_download_goes_to_the_browser_that_asked_and_holds_no_path(page):
    page.session.source, recorded = "/home/someone/runs/secret", page.session._timeline._recording
    recorded.source = page.session.source
    got, done = [], threading.Event()

    class Client:
        def send_file_download(self, name, content):
            got.append((name, content))
            done.set()

    with connect(page) as stranger:
        enter(page, stranger)
        page.loop.submit(lambda session: page._send_recording(session, Client()))
        assert done.wait(20)
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            assert b"secret" not in stranger.recv(timeout=20)
    name, content = got[0]
    assert name == "echo.json" and json.loads(content)["source"] == "secret" and b"/home" not in content
