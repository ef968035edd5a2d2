"""Pages, written once for all tests of this folder."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from coachable.training.weights import domain_of, load_policy

HERE = Path(__file__).parent


def exported(name, folder, *needed):
    """Folder with the page of a shipped agent, which acts in the browser."""
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    from coachable.export.web.pinned_files import provide
    from coachable.export.web.simulated_page import export_page

    try:
        provide(None, *needed)
    except OSError as error:
        pytest.skip(str(error))
    agent = load_policy(name)
    export_page(agent, domain_of(agent), folder, home="../index.html")
    return folder


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    return exported("humanoid", tmp_path_factory.mktemp("page") / "site")


@pytest.fixture(scope="session")
def stepped_site(tmp_path_factory):
    """A page whose simulation is a graph."""
    return exported("racing_drift", tmp_path_factory.mktemp("stepped") / "site", "onnxruntime-web", "three")


@pytest.fixture(scope="session")
def recorded_site(tmp_path_factory):
    """A page with three short recordings."""
    from coachable.evaluation.recorded_page import export_recordings
    from coachable.export.web.pinned_files import provide

    try:
        provide(None, "three")
    except OSError as error:
        pytest.skip(str(error))
    agent = load_policy("racing_resources")
    domain = domain_of(agent)
    grid = {"overtake": (1.0,), "defend": (1.0,), "tire": (0.0,), "fuel": (0.0, 52.0, 105.0)}
    short = replace(domain, recorded=replace(domain.recorded, grid=grid, seconds=1.0))
    folder = tmp_path_factory.mktemp("recorded") / "site"
    export_recordings(agent, short, folder)
    return folder


def driven(site, script):
    """Function that runs a task of a script with the code of a page."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")

    def run(name, **task):
        text = json.dumps({"name": name, **task})
        command = [node, str(HERE / script), str(site)]
        done = subprocess.run(command, input=text, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr[-2000:]
        return json.loads(done.stdout)

    return run


@pytest.fixture(scope="session")
def drive(site):
    """Run a task of drive.mjs with the page's code."""
    return driven(site, "drive.mjs")


@pytest.fixture(scope="session")
def drive_steps(stepped_site):
    """Run a task of drive_steps.mjs with the page's code."""
    return driven(stepped_site, "drive_steps.mjs")
