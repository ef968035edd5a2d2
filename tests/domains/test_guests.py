"""Domains that live outside of the library: trained, evaluated, reported, coached and exported like our own."""

import importlib
import json
import sys
import threading
from pathlib import Path

import pytest

from coachable.cli import main
from coachable.coach.session.session import CoachSession
from coachable.domain import domain_names, load_domain
from coachable.styles import Setpoint, StyleSpace

pytest.importorskip("gymnasium")

GUESTS = {"leaning_pendulum": "lean", "placed_cartpole": "place"}  # by name: the parameter of its style
TRAINING = "sac_training"
SOURCES = Path(__file__).parent / "guests"
DOCS = Path(__file__).resolve().parents[2] / "docs"


def install(site, *, package, domain):
    """Write what pip writes about a package that registers a domain of a module of the same name."""
    metadata = site / f"{package}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[coachable.domains]\n{domain} = {domain}:DOMAIN\n")


@pytest.fixture(scope="module", params=GUESTS)
def guest(request, tmp_path_factory):
    """Name of a domain of a package that is installed in a temporary folder."""
    name, site = request.param, tmp_path_factory.mktemp("site")
    for module in (name, TRAINING):
        (site / f"{module}.py").write_text((SOURCES / f"{module}.py").read_text())
    install(site, package=name, domain=name)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        yield name


@pytest.fixture(scope="module")
def run(guest, tmp_path_factory):
    """Folder of a short training."""
    folder = tmp_path_factory.mktemp("runs") / guest
    importlib.import_module(TRAINING).train(load_domain(guest), folder, frames=240)
    return str(folder)


def test_it_is_registered(guest):
    assert guest in domain_names()
    domain = load_domain(guest)
    assert domain.name == guest and domain.make_space().names == (GUESTS[guest],)


def test_what_it_leaves_out_has_a_default(guest):
    domain, parameter = load_domain(guest), GUESTS[guest]
    timing = {"leaning_pendulum": (0.05, 200), "placed_cartpole": (0.01, 1000)}
    assert (domain.control_step, domain.episode_steps) == pytest.approx(timing[guest])
    highest = domain.make_space()[parameter].high
    assert [cell[parameter] for cell in domain.cells()] == pytest.approx([highest * i / 2 for i in range(-2, 3)])


def test_evaluate(run, guest, tmp_path, capsys):
    options = ["--episodes", "1", "--switch-episodes", "1", "--steps", "8", "--out", str(tmp_path)]
    assert main(["evaluate", run, *options]) == 0
    assert f"measured_{GUESTS[guest]}" in capsys.readouterr().out
    assert {"grid.csv", "response.csv", "grid.png", "report.md"} <= {file.name for file in tmp_path.iterdir()}
    assert GUESTS[guest] in json.loads((tmp_path / "summary.json").read_text())["grid"]


def test_report(run, guest, tmp_path):
    options = ["--seeds", "1", "--episodes", "1", "--switch-episodes", "1", "--steps", "8"]
    assert main(["report", run, *options, "--out", str(tmp_path / "report")]) == 0
    page = (tmp_path / "report" / "report.html").read_text()
    assert guest in page and "Requested and measured" in page


def test_export(run, guest, tmp_path):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    file = tmp_path / "policy.onnx"
    assert main(["export", "onnx", run, "--out", str(file)]) == 0
    metadata = {entry.key: entry.value for entry in onnx.load(str(file)).metadata_props}
    assert metadata["domain"] == guest and float(metadata["control_step"]) in (0.05, 0.01)


def test_explain(run, guest, tmp_path):
    pytest.importorskip("captum")
    options = ["--episodes", "2", "--states", "4", "--steps", "8", "--out", str(tmp_path / "explained")]
    assert main(["explain", run, *options]) == 0
    assert f"style: {GUESTS[guest]}" in (tmp_path / "explained" / "explain.md").read_text()


def test_render(run, guest, tmp_path, capsys):
    code = main(["render", run, "--out", str(tmp_path / "sheet.png"), "--seconds", "0.1", "--size", "96x80"])
    assert code == 0 or "PendulumEnv draws no pictures: pygame is not installed" in capsys.readouterr().err


def test_coach(run, guest):
    pytest.importorskip("viser")
    from coachable.coach.page.coach_page import CoachPage
    from coachable.coach.page.server import make_server

    parameter = GUESTS[guest]
    server, session = make_server(port=18480), CoachSession.open(run, seed=1)
    page = CoachPage(server, session)
    page.loop.paused = True
    page.start()
    try:
        page.widgets[parameter].handle.value = 0.25
        page._press("Step")
        for _ in range(2):  # after the second, the read-outs of the step have been written
            done = threading.Event()
            page.loop.submit(lambda _, done=done: done.set())
            assert done.wait(20.0)
        assert session.style[parameter] == pytest.approx(0.25) and session.step_count == 1
        assert not page.loop.problem
        assert "measured" in page.measured[parameter].handle.content
        assert session.say(f"more {parameter}").changes
    finally:
        page.stop()
        session.close()
        server.stop()


def test_without_its_package_the_domain_is_named(run, guest, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if not (Path(folder) / f"{guest}.py").is_file()])
    assert main(["evaluate", run, "--out", str(tmp_path)]) == 2
    assert f"unknown domain '{guest}': expected one of ['combat'," in capsys.readouterr().err


@pytest.mark.parametrize("name", [*GUESTS, TRAINING])
def test_the_documentation_shows_the_files_as_they_are(name):
    source = (SOURCES / f"{name}.py").read_text()
    assert any(f"```python\n{source}```" in page.read_text() for page in DOCS.rglob("*.md"))
    assert source.count("\n") < 60


def test_a_sampler_that_the_package_of_a_domain_defines_is_found(monkeypatch, tmp_path):
    sampler = ("@dataclass(frozen=True)", "class OfTheGuest(PointMass):", "    pass", "DOMAIN = OfTheGuest([1.0])")
    imports = ("from dataclasses import dataclass", "from coachable.styles import PointMass")
    (tmp_path / "sampling_guest.py").write_text("\n".join((*imports, *sampler)))
    install(tmp_path, package="sampling_guest", domain="sampling_guest")
    description = {
        **StyleSpace([Setpoint("pace", 0.0, 2.0)]).to_dict(),
        "sampler": {"type": "OfTheGuest", "values": [1]},
    }
    with pytest.raises(ValueError, match="unknown sampler type 'OfTheGuest'"):
        StyleSpace.from_dict(description)
    monkeypatch.syspath_prepend(tmp_path)
    assert StyleSpace.from_dict(description).sample().tolist() == [1.0]


def test_two_packages_with_one_name_of_a_domain_are_refused(monkeypatch, tmp_path):
    for package in ("hill_walkers", "city_walkers"):
        install(tmp_path, package=package, domain="walker")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="the packages city_walkers and hill_walkers register a domain 'walker' each"):
        load_domain("walker")
