"""Make the pictures of the static and of the live page in `docs/images/`: `python docs/page_pictures.py`.

It needs playwright, Chromium (`apt-get install chromium`) and what `coachable export web` needs.
"""

import functools
import http.server
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

from coachable.coach.page.coach_page import CoachPage
from coachable.coach.page.server import make_server, page_address
from coachable.coach.session.session import CoachSession
from coachable.export.web.simulated_page import export_page
from coachable.training.weights import domain_of, load_policy

IMAGES = Path(__file__).resolve().parent / "images"
REQUEST = "#pose=t_pose&step_length=0.50"
WALKED = 7.0  # [s] on the page's clock: ten steps
PATIENCE = 900_000  # [ms], on a computer that is busy with other work

# Both pages tell a browser without a graphics card by the card's name; the static one then draws no shadows.
UNNAMED = """
const known = WebGL2RenderingContext.prototype.getExtension;
WebGL2RenderingContext.prototype.getExtension = function (name) {
  return name === "WEBGL_debug_renderer_info" ? null : known.call(this, name);
};
"""
# The static page draws less detail if it is slow. Its clock is, and its window is small until the walker has walked.
SLOW_CLOCK = "const now = performance.now.bind(performance); performance.now = () => now() / 20;"


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Server of a folder that prints nothing."""

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@contextmanager
def static_page() -> Iterator[str]:
    """Address of the walker's static page."""
    with tempfile.TemporaryDirectory() as folder:
        agent = load_policy("humanoid")
        export_page(agent, domain_of(agent), Path(folder))
        handler = functools.partial(Quiet, directory=folder)
        with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            yield f"http://127.0.0.1:{server.server_port}/{REQUEST}"
            server.shutdown()


@contextmanager
def live_page() -> Iterator[tuple[str, CoachPage]]:
    """Address of the walker's live page, and the page."""
    server = make_server()
    session = CoachSession.open("humanoid")
    page = CoachPage(server, session)
    page.start()
    try:
        yield page_address("127.0.0.1", server.get_port()), page
    finally:
        page.stop()
        session.close()
        server.stop()


def main() -> None:
    """Make both pictures."""
    with sync_playwright() as playwright:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        with static_page() as address:
            tab = opened(browser, address, (240, 240), UNNAMED + SLOW_CLOCK)
            tab.wait_for_function(f"parseFloat(document.getElementById('clock').textContent) > {WALKED}")
            tab.evaluate("document.getElementById('pause').click()")
            tab.set_viewport_size({"width": 1280, "height": 720})
            take(tab, "walker_page.png")
            tab.close()
        with live_page() as (address, page):
            tab = opened(browser, address, (1280, 800), UNNAMED)
            tab.get_by_text("Pause").wait_for()
            tab.wait_for_timeout(1000 * WALKED)
            page.loop.paused = True
            take(tab, "coach_live.png")


def opened(browser: Browser, address: str, size: tuple[int, int], script: str) -> Page:
    """Open a page in a window of some width and height [pixels], in which a script runs first."""
    tab = browser.new_page(viewport={"width": size[0], "height": size[1]})
    tab.set_default_timeout(PATIENCE)
    tab.add_init_script(script)
    tab.goto(address)
    return tab


def take(tab: Page, name: str) -> None:
    """Write the picture of a page that is paused."""
    tab.wait_for_timeout(2000 * WALKED)  # until it is drawn
    tab.screenshot(path=IMAGES / name, timeout=PATIENCE)


if __name__ == "__main__":
    main()
