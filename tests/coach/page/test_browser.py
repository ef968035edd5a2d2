"""The page in a real browser: needs Playwright and a Chromium (`apt-get install chromium`)."""

import shutil
import time
from pathlib import Path

import pytest

viser = pytest.importorskip("viser")
sync_api = pytest.importorskip("playwright.sync_api")

from coachable.coach.page.coach_page import CoachPage  # noqa: E402
from coachable.coach.page.scene_view import camera_of  # noqa: E402
from coachable.coach.page.server import make_server  # noqa: E402
from coachable.coach.session.session import CoachSession  # noqa: E402
from coachable.domains.humanoid.stage import HumanoidStage  # noqa: E402
from tests.coach.echo_domain import echo_session  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
PATIENCE = 240.0  # [s], for a condition: software rendering beside other work

pytestmark = [
    pytest.mark.slow,
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed"),
    pytest.mark.filterwarnings("ignore"),  # of the browser's driver
]


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@pytest.fixture
def visit(browser):
    """Opens the page in a browser of its own; requests to other machines are stopped, and fail the test."""
    outside = []

    def stop(route):
        outside.append(route.request.url)
        route.abort()

    def visit(page, width=900, scheme="light"):
        size = {"width": width, "height": 640}  # small, because drawing is slow
        context = browser.new_context(viewport=size, color_scheme=scheme)
        context.route(lambda url: not url.startswith(("http://127.0.0.1", "data:", "blob:")), stop)
        tab = context.new_page()
        tab.set_default_timeout(1000 * PATIENCE)
        tab.on("websocket", lambda socket: socket.url.startswith("ws://127.0.0.1") or outside.append(socket.url))
        tab.goto(f"http://127.0.0.1:{page.server.get_port()}")
        tab.get_by_text("Pause").wait_for()
        return tab

    yield visit
    for context in browser.contexts:
        context.close()
    assert outside == []


@pytest.fixture(params=["humanoid", "echo"])
def page(request):
    """In 3-D, and as a picture."""
    yield from serve(CoachSession.open("humanoid") if request.param == "humanoid" else echo_session())


@pytest.fixture
def echo_page():
    yield from serve(echo_session())


def serve(session):
    page = CoachPage(make_server(port=18180), session)
    page.start()
    yield page
    page.stop()
    session.close()
    page.server.stop()


def wait_for(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.05)


@pytest.mark.parametrize(("scheme", "filtered"), [("light", False), ("dark", True)])
def test_the_scene_is_dimmed_where_the_browser_is_dark(echo_page, visit, scheme, filtered):
    tab = visit(echo_page, scheme=scheme)
    assert ("darkMode" in tab.url) == filtered
    dimmed = "[...document.querySelectorAll('canvas')].filter(c => getComputedStyle(c).filter !== 'none')"
    assert tab.evaluate(f"{dimmed}.length > 0") == filtered
    assert not tab.evaluate(f"{dimmed}.some(canvas => canvas.closest('.u-wrap'))"), "charts keep their colours"


def slider(tab, label):
    """The slider whose label begins with a text."""
    row = tab.locator("label", has_text=label).first
    return tab.locator(f'[id="{row.get_attribute("for")}"] [role=slider]').last


def say(tab, phrase):
    box = tab.locator("form input").first
    box.fill(phrase)
    box.press("Enter")


def first(page, kind):
    return next(p for p in page.session.space.parameters if p.kind == kind)


def own_sockets():
    """TCP sockets of this process: (state, local address, remote address), as the kernel writes them."""
    own = {target for fd in Path("/proc/self/fd").iterdir() if (target := _target(fd)).startswith("socket:")}
    for table in ("tcp", "tcp6"):
        for line in Path("/proc/net", table).read_text().splitlines()[1:]:
            _, local, remote, state, *rest = line.split()
            if f"socket:[{rest[5]}]" in own:
                yield state, local.partition(":")[0], remote.partition(":")[0]


def _target(fd):
    try:
        return str(fd.readlink())
    except OSError:  # closed meanwhile
        return ""


def test_a_slider_and_the_phrase_box(visit, page):
    tab = visit(page)
    setpoint, choice = first(page, "setpoint"), first(page, "choice")
    label = setpoint.name.replace("_", " ")

    handle = slider(tab, label)
    handle.focus()
    handle.press("Home")
    wait_for(lambda: page.session.style[setpoint.name] == pytest.approx(setpoint.low))
    events = page.session.recording().events
    assert {setpoint.name: pytest.approx(setpoint.low)} in [event.get("style") for event in events]

    say(tab, f"{choice.options[-1]}, much more {label}, and whistle")
    wait_for(lambda: page.session.style[choice.name] == choice.options[-1])
    wait_for(lambda: page.session.style[setpoint.name] > setpoint.low)
    tab.get_by_text("not understood: 'whistle'").wait_for()
    tab.get_by_text("measured").first.wait_for()

    say(tab, f"{label} 7 m")  # beyond the trained range
    wait_for(lambda: page.session.style[setpoint.name] == pytest.approx(setpoint.high))
    tab.get_by_text("Outside the trained range:").wait_for()
    before = page.session.style
    say(tab, "whistle a tune")
    tab.get_by_text("(unknown: whistle, tune)").wait_for()
    assert page.session.style == before
    assert page.loop.problem == ""


def test_two_browsers_coach_one_agent_and_one_goes_away(visit, echo_page):
    page = echo_page
    one, other = visit(page), visit(page)
    handle = slider(one, "target")
    handle.focus()
    handle.press("End")
    wait_for(lambda: page.session.style["target"] == pytest.approx(0.8))
    wait_for(lambda: float(slider(other, "target").get_attribute("aria-valuenow")) == pytest.approx(0.8))

    handle.press("Home")
    one.context.close()  # while the agent acts, without a goodbye
    wait_for(lambda: len(page.server.get_clients()) == 1)
    steps = page.session.step_count
    wait_for(lambda: page.session.step_count > steps + 20)

    other.get_by_text("Pause").click()
    wait_for(lambda: page.loop.paused)
    steps = page.session.step_count
    other.get_by_text("Step", exact=True).click()
    wait_for(lambda: page.session.step_count == steps + 1)
    other.get_by_text("Resume").click()
    wait_for(lambda: page.session.step_count > steps + 2)
    assert page.loop.problem == ""


def test_this_machine_only(visit, echo_page):
    """The page asks nothing of other machines (`visit` sees to that), and the server neither calls nor hears them."""
    visit(echo_page)
    sockets = list(own_sockets())
    listening, connected, here = "0A", "01", "0100007F"  # 127.0.0.1, little endian
    assert [local for state, local, _ in sockets if state == listening] == [here]
    assert {remote for state, _, remote in sockets if state == connected} == {here}


CONNECT = """([address, protocol]) => new Promise(done => {
    const socket = new WebSocket(address, [protocol]);
    socket.onmessage = () => done("heard");
    socket.onclose = () => done("refused");
})"""


def test_a_foreign_page_in_the_same_browser_is_refused(visit, browser, echo_page):
    port = echo_page.server.get_port()
    arguments = [f"ws://127.0.0.1:{port}", f"viser-v{viser.__version__}"]
    own = visit(echo_page)
    assert own.evaluate(CONNECT, arguments) == "heard"
    context = browser.new_context()
    page = f'<p>elsewhere</p><iframe src="http://127.0.0.1:{port}"></iframe>'
    context.route("http://127.0.0.1:1/**", lambda route: route.fulfill(content_type="text/html", body=page))
    foreign = context.new_page()
    foreign.goto("http://127.0.0.1:1/")
    foreign.get_by_text("elsewhere").wait_for()
    assert foreign.evaluate(CONNECT, arguments) == "refused"
    assert foreign.evaluate(f"fetch('http://127.0.0.1:{port}/').then(() => 'read', () => 'refused')") == "refused"
    assert foreign.frames[-1].get_by_text("Pause").count() == 0


CHART = """() => Object.values(window.__viserTestpoints?.uplots ?? {}).map(({chart}) => {
    const {left, top, width, height} = chart.bbox;
    const pixels = chart.root.querySelector("canvas").getContext("2d").getImageData(left, top, width, height).data;
    let measured = 0;  // in vermilion
    for (let i = 0; i < pixels.length; i += 4) measured += pixels[i + 3] > 60 && pixels[i] > 150 && pixels[i + 2] < 110;
    return {from: chart.scales.x.min, to: chart.scales.x.max, measured};
})"""


def test_charts_are_not_blank(visit, echo_page):
    for _ in range(5):
        tab = visit(echo_page)
        wait_for(lambda tab=tab: any(chart["measured"] > 10 for chart in tab.evaluate(CHART)))
        assert [(chart["from"], chart["to"]) for chart in tab.evaluate(CHART)] == [(-30, 0)]
        tab.context.close()


@pytest.mark.parametrize("width", [400, 600, 720, 900])
def test_the_gauges_do_not_cover_the_panel(visit, page, width):
    if page.session.domain.name != "humanoid":
        pytest.skip("pictures have no gauges")
    tab = visit(page, width=width)
    tab.locator(".gauge").first.wait_for()
    place = "selector => document.querySelector(selector).getBoundingClientRect().toJSON()"
    gauges, panel = tab.evaluate(place, ".gauges"), tab.evaluate(place, "[role=tab]")
    assert gauges["right"] <= panel["left"] or gauges["bottom"] <= panel["top"]


def test_in_a_narrow_window_the_agent_is_above_the_panel(visit, page):
    if page.session.domain.name != "humanoid":
        pytest.skip("pictures are tested without a browser")
    visit(page, width=400)
    (client,) = page.server.get_clients().values()
    position, target = camera_of(HumanoidStage.viewpoint, narrow=True)
    assert target[2] < 0
    wait_for(lambda: client.camera.look_at == pytest.approx(target, abs=1e-3))
    assert client.camera.position == pytest.approx(position, abs=1e-3)
