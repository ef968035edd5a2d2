"""What coaching costs: opening the page, acting while a browser looks on, a call of the exported policy.

    python benchmarks/coaching.py                       the shipped humanoid
    python benchmarks/coaching.py runs/mine --seconds 60

Needs the extras `ui` and `export`, Playwright and a Chromium. The browser is started before the clock. Wall times tell
little on a busy machine, so that CPU times and the load are printed as well.
"""

import argparse
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

from contest import cpu_seconds

CALLS = 5000
WARMUP_SECONDS = 5.0


def main(source: str, seconds: float) -> None:
    cores = len(os.sched_getaffinity(0))
    print(f"{cores} cores of {os.cpu_count()}; load {os.getloadavg()[0]:.1f}")
    open_page(source)
    act(source, seconds)
    call_export(source)
    print(f"load {os.getloadavg()[0]:.1f} at the end")


def open_page(source: str) -> None:
    """From the command to the address, and to an agent that acts on the page."""
    with browser_tab() as tab:
        start = time.perf_counter()
        command = [sys.executable, "-m", "coachable.cli", "coach", source, "--port", "18380"]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            address = re.search(r"http://\S+\d", server.stdout.readline()).group()
            moments = {"address": time.perf_counter() - start}
            tab.goto(address)
            tab.get_by_text("Pause").wait_for()
            tab.get_by_text(re.compile("of real time")).wait_for()
            moments["agent acts"] = time.perf_counter() - start
            used = cpu_seconds(server.pid)
        finally:
            server.terminate()
            server.wait()
    shown = ", ".join(f"{name} {moment:.1f} s" for name, moment in moments.items())
    print(f"opening: {shown}; CPU of the command until then {used:.1f} s")


def act(source: str, seconds: float) -> None:
    """Control steps per second and the delay of slider changes, while a browser shows the page and moves a slider."""
    from coachable.coach.page.coach_page import CoachPage
    from coachable.coach.page.server import make_server
    from coachable.coach.session.session import CoachSession

    page = CoachPage(make_server(port=18380), CoachSession.open(source))
    delays: list[int] = []
    submit = page.loop.submit

    def timed_submit(change):
        arrived = page.session.step_count

        def carried_out(session):
            change(session)
            delays.append(session.step_count - arrived)

        submit(carried_out)

    page.loop.submit = timed_submit
    page.start()
    slider = next(p for p in page.session.space.parameters if p.kind != "choice").name.replace("_", " ")
    address = f"http://127.0.0.1:{page.server.get_port()}"
    visitor = subprocess.Popen(
        [sys.executable, __file__, "--visit", address, "--slider", slider], stdout=subprocess.PIPE, text=True
    )
    try:
        assert visitor.stdout.readline() == "there\n"
        time.sleep(WARMUP_SECONDS)
        steps, wall, cpu = page.session.step_count, time.perf_counter(), time.process_time()
        time.sleep(seconds)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        steps = page.session.step_count - steps
    finally:
        visitor.terminate()
        visitor.wait()
        page.stop()
        page.server.stop()
    wanted = 1 / page.session.domain.control_step
    print(
        f"acting, a browser attached: {steps / wall:.1f} control steps/s of {wanted:.1f}, "
        f"{1000 * cpu / steps:.1f} ms CPU per step for agent and page"
    )
    print(
        f"slider: {len(delays)} changes, each before the next control step; "
        f"{sum(delay > 0 for delay in delays)} came during a step, most steps in between: {max(delays, default=0)}"
    )


def call_export(source: str) -> None:
    """Largest difference from torch, and the duration of a call on one core."""
    import numpy as np
    import onnxruntime

    from coachable.export.onnx import export

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "policy.onnx"
        difference = export(source, file)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        policy = onnxruntime.InferenceSession(str(file), options)
    random = np.random.default_rng(0)
    inputs = {i.name: random.normal(size=(1, i.shape[1])).astype(np.float32) for i in policy.get_inputs()}
    durations = []
    cpu = time.process_time()
    for _ in range(CALLS):
        start = time.perf_counter()
        policy.run(None, inputs)
        durations.append(time.perf_counter() - start)
    cpu = (time.process_time() - cpu) / CALLS
    print(
        f"export: at most {difference:.1e} from torch; a call {1000 * statistics.median(durations):.3f} ms (median), "
        f"{1000 * cpu:.3f} ms CPU (mean)"
    )


@contextmanager
def browser_tab():
    """An empty tab of a headless Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        tab = browser.new_page(viewport={"width": 1280, "height": 800})
        tab.set_default_timeout(240_000)
        yield tab
        browser.close()


def visit(address: str, slider: str) -> None:
    """A browser that moves a slider once a second until it is ended."""
    with browser_tab() as tab:
        tab.goto(address)
        tab.get_by_text("Pause").wait_for()
        label = tab.locator("label", has_text=slider).first.get_attribute("for")
        handle = tab.locator(f'[id="{label}"] [role=slider]').last
        handle.focus()
        print("there", flush=True)
        while True:
            for key in ("ArrowRight", "ArrowLeft"):
                handle.press(key)
                time.sleep(1.0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default="humanoid")
    parser.add_argument("--seconds", type=float, default=30.0, help="of acting (default: %(default)s)")
    parser.add_argument("--visit", help=argparse.SUPPRESS)
    parser.add_argument("--slider", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.visit:
        visit(options.visit, options.slider)
    else:
        main(options.source, options.seconds)
