"""The page for keys and gamepads in a real browser, driven through its debugging protocol: needs a Chromium."""

import json
import shutil
import subprocess
import time
import urllib.request

import pytest

viser = pytest.importorskip("viser")

import websockets.sync.client as websockets  # noqa: E402, viser brings it

from coachable.coach.page.coach_page import CoachPage  # noqa: E402
from coachable.coach.page.server import make_server  # noqa: E402
from tests.coach.echo_domain import echo_session  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
PATIENCE = 120.0  # [s]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed"),
]

# A gamepad as the browser reports it: axis 1 is half forward, and button 5 is pressed.
GAMEPAD = """
navigator.getGamepads = () => [null, {
  axes: [0, 0.5, 0, 0],
  buttons: [...Array(17).keys()].map((k) => ({ pressed: k === 5 })),
}];
"""


def wait_for(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.05)


@pytest.fixture
def page():
    page = CoachPage(make_server(port=18560), echo_session(seed=3))
    page.loop.pause_at_end = 0.0
    page.start()
    yield page
    page.stop()
    page.session.close()
    page.server.stop()


@pytest.fixture
def tab(page, tmp_path):
    """Function that sends a command to the browser that shows the pad."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0", "--remote-allow-origins=*"]
    address = f"http://127.0.0.1:{page.server.get_port()}/pad"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    browser = subprocess.Popen([CHROMIUM, *options, f"--user-data-dir={tmp_path}", address], **quiet)
    try:
        port = tmp_path / "DevToolsActivePort"
        wait_for(lambda: port.exists() and port.read_text().strip())
        url = f"http://127.0.0.1:{port.read_text().split()[0]}/json"
        with urllib.request.urlopen(url, timeout=PATIENCE) as answer:
            target = next(found for found in json.load(answer) if found["type"] == "page")
        with websockets.connect(target["webSocketDebuggerUrl"], max_size=None, open_timeout=PATIENCE) as connection:

            def command(method, **parameters):
                connection.send(json.dumps({"id": 1, "method": method, "params": parameters}))
                while (answer := json.loads(connection.recv(timeout=PATIENCE))).get("id") != 1:
                    pass
                return answer["result"]

            yield command
    finally:
        browser.terminate()
        browser.wait()


def test_keys_clicks_and_a_gamepad_steer(page, tab):
    def run(code):
        return tab("Runtime.evaluate", expression=code)["result"].get("value")

    def press(key):
        tab("Input.dispatchKeyEvent", type="keyDown", key=key, text=key)
        tab("Input.dispatchKeyEvent", type="keyUp", key=key)

    wait_for(lambda: run("document.querySelectorAll('#rows tr').length") == 3)
    rows = run("document.getElementById('rows').innerText")
    assert "target" in rows and "axis 0" in rows and "button 4, button 5" in rows
    page.loop.submit(lambda session: session.set(target=0.0, mood="calm", fire=0.0))
    press("w")
    wait_for(lambda: page.session.style["target"] == pytest.approx(0.16))
    wait_for(lambda: run("document.getElementById('value-target').textContent") == "0.16")
    run("document.querySelector('[aria-label=\"mood: more\"]').click()")
    wait_for(lambda: page.session.style["mood"] == "wild_card")
    run(GAMEPAD)
    wait_for(lambda: page.session.style["fire"] == pytest.approx(-0.5 + 0.75 * 2.5))
    wait_for(lambda: page.session.style["mood"] == "calm")
    assert page.session.style["target"] == pytest.approx(0.16), "an axis at rest leaves its parameter alone"
    assert "Press a key" in run("document.getElementById('status').textContent")
