"""The page in headless Chromium: it starts, follows its sliders, and asks no other site for anything."""

import contextlib
import functools
import http.server
import json
import os
import shutil
import subprocess
import threading
import time

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.browser]  # a browser without a graphics card draws for a minute

LENGTHS = (0.30, 0.475, 0.65)
CORNERS = 24  # [s] in which what is measured is read
SLIDES = 1.5  # times as far as without a request a car slides at least if it is asked to
OFFSET = 0.03  # [m], by which the shipped agent misses a request at most, see docs/domains/humanoid.md

SMALL = (
    "[...document.querySelectorAll('button, .options label, input[type=range]')]"
    ".filter(e => e.checkVisibility() && e.getBoundingClientRect().height < 44).map(e => e.id)"
)  # controls that are too small for a finger


class Browser:
    """Chromium with one page, driven by its DevTools protocol."""

    def __init__(self, folder, size):
        client = pytest.importorskip("websockets.sync.client")
        chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
        if chromium is None:
            pytest.skip("chromium is not installed")
        flags = ["--headless=new", "--no-sandbox", "--remote-debugging-port=0", f"--user-data-dir={folder}"]
        flags += ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        flags += ["--disable-background-networking", f"--window-size={size[0]},{size[1]}"]
        self.process = subprocess.Popen([chromium, *flags, "about:blank"], stderr=subprocess.DEVNULL)
        port_file = folder / "DevToolsActivePort"
        wait_for(lambda: port_file.is_file() and "\n" in port_file.read_text(), 60)
        port, path = port_file.read_text().split()[:2]
        self.connection = client.connect(f"ws://127.0.0.1:{port}{path}", max_size=None)
        self.socket = self.connection.__enter__()  # newer versions connect only as a context manager
        self.number, self.events, self.session = 0, [], None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Network", "Page", "Runtime"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        self.socket.send(json.dumps(message | ({"sessionId": self.session} if self.session else {})))
        while True:
            answer = json.loads(self.socket.recv(timeout=120))
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def evaluate(self, expression):
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def close(self):
        self.connection.__exit__(None, None, None)
        self.process.terminate()
        self.process.wait(30)


def wait_for(condition, seconds):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.2)


@pytest.fixture
def address(site):
    with served(site) as address:
        yield address


@contextlib.contextmanager
def served(site):
    """Address of a folder on this computer."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(site)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture
def browser(tmp_path):
    browser = Browser(tmp_path, (480, 640))
    yield browser
    browser.close()


def test_the_page_follows_its_sliders_and_asks_no_other_site(browser, address):
    begin = time.monotonic()
    browser.call("Page.navigate", url=f"{address}#pose=t_pose&step_length={LENGTHS[0]}")
    wait_for(lambda: browser.evaluate("document.getElementById('loading')?.hidden === true"), 120)
    wait_for(lambda: seconds(browser) > 0, 120)
    print(f"acts after {time.monotonic() - begin:.1f} s, at a load of {os.getloadavg()[0]:.1f}")  # shown by pytest -s
    assert browser.evaluate("document.querySelector('input[value=t_pose]').checked")
    home = "(a => a.checkVisibility() && a.textContent + ' ' + a.getAttribute('href'))"
    assert browser.evaluate(f"{home}(document.getElementById('documentation'))") == "Documentation ../index.html"
    measured = []
    for length in LENGTHS:
        # One expression, so that no step is taken between the request and the look at the measure.
        found = browser.evaluate(
            f"(() => {{ const slider = document.getElementById('request-step_length'); slider.value = {length};"
            " slider.dispatchEvent(new Event('input'));"
            " return document.getElementById('measured-step_length').dataset.value; })()"
        )
        assert found == ""
        begin = seconds(browser)
        wait_for(lambda begin=begin: seconds(browser) > begin + 8 or seconds(browser) < begin, 240)
        assert seconds(browser) > begin, "the walker fell"
        measured.append(float(browser.evaluate("document.getElementById('measured-step_length').dataset.value")))
    for length, value in zip(LENGTHS, measured, strict=True):
        assert abs(value - length) < OFFSET
    assert measured[1] - measured[0] == pytest.approx(LENGTHS[1] - LENGTHS[0], abs=0.05)
    assert float(browser.evaluate("document.getElementById('measured-pose_held').dataset.value")) > 0.8
    assert f"step_length={LENGTHS[-1]:.2f}" in browser.evaluate("location.hash")
    browser.evaluate("document.getElementById('pause').click()")
    browser.call("Emulation.setDeviceMetricsOverride", width=360, height=640, deviceScaleFactor=1, mobile=False)
    widths = "(svg => [Number(svg.lastChild.getAttribute('x2')), svg.clientWidth])(document.querySelector('svg.steps'))"
    wait_for(lambda: len(set(browser.evaluate(widths))) == 1, 60)
    sent = [e["params"]["request"]["url"] for e in browser.events if e.get("method") == "Network.requestWillBeSent"]
    foreign = [url for url in sent if not url.startswith((address, "data:", "blob:", "about:"))]
    assert len(sent) > 10 and foreign == []
    assert not [e for e in browser.events if e.get("method") == "Runtime.exceptionThrown"]


def seconds(browser):
    """Time on the page's clock."""
    return float(browser.evaluate("parseFloat(document.getElementById('clock').textContent)"))


@pytest.mark.parametrize("width", [360, 1920])
def test_nothing_is_wider_than_the_window_and_everything_has_a_name(browser, address, width):
    metrics = {"width": width, "height": 740, "deviceScaleFactor": 1, "mobile": width == 360}
    browser.call("Emulation.setDeviceMetricsOverride", **metrics)
    preference = [{"name": "prefers-reduced-motion", "value": "reduce"}]
    browser.call("Emulation.setEmulatedMedia", features=preference)
    browser.call("Page.navigate", url=address)
    wait_for(lambda: browser.evaluate("document.getElementById('loading')?.hidden === true"), 120)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    unnamed = (
        "[...document.querySelectorAll('input, button, output')]"
        ".filter(e => !(e.labels?.length || e.textContent.trim() || e.ariaLabel)).length"
    )
    assert browser.evaluate(unnamed) == 0
    assert browser.evaluate(SMALL) == []
    assert browser.evaluate("document.getElementById('pause').textContent") == "Resume"  # it waits to be started
    assert seconds(browser) == 0


def test_a_car_follows_its_sliders_and_asks_no_other_site(browser, stepped_site, tmp_path):
    """Gripping first, then sliding."""
    site = shutil.copytree(stepped_site, tmp_path / "site")
    manifest = json.loads((site / "manifest.json").read_text())
    told = {"idle": ["slip_ratio_front"], "idle_note": "The front wheels are not driven."}
    (site / "manifest.json").write_text(json.dumps(manifest | told))
    browser.call("Emulation.setDeviceMetricsOverride", width=240, height=320, deviceScaleFactor=1, mobile=False)
    with served(site) as address:
        browser.call("Page.navigate", url=f"{address}#slip_angle_rear=0&slip_ratio_rear=0")
        wait_for(lambda: browser.evaluate("document.getElementById('loading')?.hidden === true"), 120)
        wait_for(lambda: seconds(browser) > 0, 120)
        assert browser.evaluate("document.getElementById('request-slip_angle_rear').value") == "0"
        assert browser.evaluate("document.getElementById('request-slip_ratio_front')") is None
        assert told["idle_note"] in browser.evaluate("document.getElementById('requests').innerText")
        assert browser.evaluate("document.querySelector('.asked').textContent").startswith("weight 0")
        angles = []
        for weight in (0.0, 5.0):
            # One expression, so that the car cannot enter a corner between the request and the look at the measure.
            measured = browser.evaluate(
                "(() => { for (const name of ['slip_angle_rear', 'slip_ratio_rear']) {"
                " const slider = document.getElementById(`request-${name}`);"
                f" slider.value = {weight}; slider.dispatchEvent(new Event('input')); }}"
                " return document.getElementById('measured-sideslip_corners').dataset.value; })()"
            )
            assert measured == ""
            angles.append(sideslip_in_corners(browser, CORNERS))
        assert "slip_angle_rear=5" in browser.evaluate("location.hash")
        assert angles[1] > SLIDES * angles[0], angles
        assert browser.evaluate("document.getElementById('gauges').textContent").startswith("speed")
        assert browser.evaluate("document.getElementById('map').checkVisibility()")
        assert browser.evaluate("document.getElementById('push').checkVisibility()") is False
        sent = [e["params"]["request"]["url"] for e in browser.events if e.get("method") == "Network.requestWillBeSent"]
        assert len(sent) > 10
        assert [url for url in sent if not url.startswith((address, "data:", "blob:", "about:"))] == []
    assert not [e for e in browser.events if e.get("method") == "Runtime.exceptionThrown"]


def sideslip_in_corners(browser, samples):
    """Mean of what the page shows, read once per second on its clock [deg]."""
    values, last = [], seconds(browser)
    end = time.monotonic() + 480
    while len(values) < samples:
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.2)
        now = seconds(browser)
        shown = browser.evaluate("document.getElementById('measured-sideslip_corners').dataset.value")
        if shown and abs(now - last) >= 1.0:  # the clock begins anew where the car retires
            values.append(float(shown))
            last = now
    return sum(values[samples // 3 :]) / len(values[samples // 3 :])


def test_recordings_follow_their_sliders_and_ask_no_other_site(browser, recorded_site):
    manifest = json.loads((recorded_site / "manifest.json").read_text())
    metrics = {"width": 360, "height": 740, "deviceScaleFactor": 1, "mobile": True}
    browser.call("Emulation.setDeviceMetricsOverride", **metrics)
    with served(recorded_site) as address:
        browser.call("Page.navigate", url=f"{address}#fuel=105")
        wait_for(lambda: browser.evaluate("document.getElementById('loading')?.hidden === true"), 120)
        notice = browser.evaluate("document.getElementById('notice').textContent")
        assert notice.startswith("Recording: this page plays 3 recorded episodes of the agent")
        assert browser.evaluate("document.getElementById('request-fuel').value") == "2"
        for index, recording in enumerate(manifest["recordings"]):
            browser.evaluate(
                f"(() => {{ const slider = document.getElementById('request-fuel'); slider.value = {index};"
                " slider.dispatchEvent(new Event('input')); })()"
            )
            shown = "Number(document.getElementById('measured-fuel_per_km').dataset.value)"
            assert browser.evaluate(shown) == recording["measured"]["fuel_per_km"]
            weight = browser.evaluate("document.querySelector('output[for=request-fuel]').textContent")
            assert weight == f"weight {recording['style']['fuel']:g}"
            asked = f"Requested: Fuel {recording['style']['fuel']:g}."
            announced = f"document.getElementById('announcement').textContent.startsWith('{asked}')"
            wait_for(lambda announced=announced: browser.evaluate(announced), 60)
        assert "fuel=105" in browser.evaluate("location.hash")
        shown = "[...document.querySelectorAll('#gauges div')].filter(gauge => gauge.offsetHeight > 10).length"
        wait_for(lambda: browser.evaluate(shown) == 6, 60)  # the first picture may take long
        edges = "['scene', 'gauges'].map(id => document.getElementById(id).getBoundingClientRect())"
        assert browser.evaluate(f"(([scene, gauges]) => scene.bottom <= gauges.top)({edges})")
        browser.evaluate(
            "(() => { document.getElementById('pause').click(); const slider = document.getElementById('moment');"
            " slider.value = 0.5; slider.dispatchEvent(new Event('input')); })()"
        )
        wait_for(lambda: seconds(browser) == 0.5, 60)
        assert browser.evaluate("document.querySelector('.brand').innerText") == "coachable"  # no address is known
        assert browser.evaluate("document.documentElement.scrollWidth") <= 360
        assert browser.evaluate(SMALL) == []
        sent = [e["params"]["request"]["url"] for e in browser.events if e.get("method") == "Network.requestWillBeSent"]
        assert len(sent) > 10
        assert [url for url in sent if not url.startswith((address, "data:", "blob:", "about:"))] == []
    assert not [e for e in browser.events if e.get("method") == "Runtime.exceptionThrown"]
