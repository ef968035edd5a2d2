"""The page in a real browser: needs Playwright and a Chromium (`apt-get install chromium`)."""

import shutil
import time

import pytest

pytest.importorskip("viser")
sync_api = pytest.importorskip("playwright.sync_api")

from coachable.coach.page import CoachPage  # noqa: E402
from coachable.coach.server import make_server  # noqa: E402
from coachable.coach.session import CoachSession  # noqa: E402
from tests.coach.echo_domain import echo_session  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
PATIENCE = 60_000  # [ms], software rendering beside other work

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed"),
    pytest.mark.filterwarnings("ignore"),  # of the browser's driver
]


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


@pytest.fixture(params=["humanoid", "echo"])
def page(request):
    """In 3-D, and as a picture."""
    server = make_server(port=18180)
    session = CoachSession.open("humanoid") if request.param == "humanoid" else echo_session()
    page = CoachPage(server, session)
    page.start()
    yield page
    page.stop()
    session.close()
    server.stop()


def visit(browser, page, outside):
    tab = browser.new_page(viewport={"width": 1280, "height": 900})
    tab.set_default_timeout(PATIENCE)
    tab.on("request", lambda request: outside.append(request.url) if is_outside(request.url) else None)
    tab.goto(f"http://127.0.0.1:{page.server.get_port()}")
    tab.get_by_text("Pause").wait_for(timeout=PATIENCE)
    return tab


def is_outside(url: str) -> bool:
    return not url.startswith(("http://127.0.0.1", "ws://127.0.0.1", "data:", "blob:"))


def wait_for(condition):
    end = time.monotonic() + PATIENCE / 1000
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.05)


def row_of(tab, text):
    """The slider whose label begins with a text."""
    label = tab.locator("label", has_text=text).first
    return tab.locator(f'[id="{label.get_attribute("for")}"] [role=slider]').last


def test_two_browsers_coach_one_agent(browser, page):
    outside = []
    first, second = visit(browser, page, outside), visit(browser, page, outside)
    name, low = next((p.name, p.low) for p in page.session.space.parameters if p.kind == "setpoint")
    label = name.replace("_", " ")

    slider = row_of(first, label)
    slider.focus()
    slider.press("Home")
    wait_for(lambda: page.session.style[name] == pytest.approx(low))
    second.get_by_text("Pause").wait_for()
    wait_for(lambda: float(row_of(second, label).get_attribute("aria-valuenow")) == pytest.approx(low))

    choice = next(p for p in page.session.space.parameters if p.kind == "choice")
    second.locator("form input").first.fill(f"{choice.options[-1]}, much more {label}, and whistle")
    second.locator("form input").first.press("Enter")
    wait_for(lambda: page.session.style[choice.name] == choice.options[-1])
    wait_for(lambda: page.session.style[name] > low)
    first.get_by_text("not understood: 'whistle'").wait_for(timeout=PATIENCE)

    first.close()  # a browser that goes away disturbs nobody
    steps = page.session.step_count
    wait_for(lambda: page.session.step_count > steps or page.loop.paused)
    assert not page.loop.paused, page.loop.problem
    second.get_by_text("Pause").click()
    wait_for(lambda: page.loop.paused)
    steps = page.session.step_count
    second.get_by_text("Step", exact=True).click()
    wait_for(lambda: page.session.step_count == steps + 1)
    second.get_by_text("Resume").click()
    wait_for(lambda: page.session.step_count > steps + 2)
    assert page.loop.problem == ""
    assert outside == [], "no request leaves the machine"
    second.close()
