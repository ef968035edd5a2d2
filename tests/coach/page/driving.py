"""What tests do with a page through viser, without a browser."""

import threading
import time
from contextlib import contextmanager

import pytest

viser = pytest.importorskip("viser")

import msgspec  # noqa: E402, viser brings it
import websockets.sync.client as websockets  # noqa: E402, viser brings it


def wait_for(condition, seconds=20.0):
    """Until the loop's thread has got there."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.01)


def do(page, action=lambda session: None):
    """Carries something out in the loop's thread, after all that was submitted before."""
    done = threading.Event()
    page.loop.submit(action)
    page.loop.submit(lambda _: done.set())
    assert done.wait(20.0)
    rounds = threading.Event()
    page.loop.submit(lambda _: rounds.set())  # the read-outs of the round before have been written
    assert rounds.wait(20.0)


def say(page, phrase):
    page.phrase.value = phrase
    page.say.value = True  # a click
    wait_for(lambda: not page.loop._changes.qsize())
    do(page)


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
