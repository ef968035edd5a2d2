"""The page that plays recordings: what is in its folder, and that its numbers are those of the evaluation."""

import gzip
import json
from dataclasses import replace

import pytest
import torch

from coachable.cli import main
from coachable.domain import Recorded
from coachable.evaluation import recorded_page
from coachable.evaluation.episode_records import record_styles
from coachable.evaluation.recorded_page import MOST, export_recordings
from coachable.training import weights
from coachable.training.weights import domain_of, load_policy

NAME, STEPS = "racing_resources", 6
GRID = {"overtake": (1.0,), "defend": (1.0,), "tire": (0.0, 12000.0), "fuel": (0.0, 105.0)}


@pytest.fixture
def changed(monkeypatch, tmp_path):
    """Returns a function that returns the agent and its changed domain, whose page is written without three."""
    code = tmp_path / "three.js"
    code.write_text("export {};")
    monkeypatch.setattr(recorded_page, "provide", lambda *_: {"three/three.js": code})

    def change(**fields):
        agent = load_policy(NAME)
        domain = replace(domain_of(agent), **fields)
        monkeypatch.setattr(weights, "domain_of", lambda _: domain)  # for the command line
        return agent, domain

    return change


def test_the_page_tells_what_the_evaluation_measures(changed, tmp_path):
    told = domain_of(load_policy(NAME)).recorded
    agent, domain = changed(recorded=replace(told, grid=GRID, seconds=STEPS * 0.1))
    out = tmp_path / "site"
    size = export_recordings(agent, domain, out)
    written = [file for file in out.rglob("*") if file.is_file()]
    assert size == sum(file.stat().st_size for file in written) < 1e6
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["kind"] == "recorded" and manifest["domain"] == NAME
    assert [row["style"] for row in manifest["recordings"]] == domain.recorded_cells()
    for download in manifest["downloads"]:
        assert (out / download["file"]).stat().st_size == download["bytes"]
    assert [package["name"] for package in manifest["packages"]] == ["three"]
    theta = torch.stack([agent.space.make(**cell) for cell in domain.recorded_cells()])
    record = record_styles(
        domain, agent.actor, agent.space, theta, "", steps=STEPS, seed=0, progress=False, copies=4, controlled=1
    )
    expected = domain.measures.summarise(record.measures, record.alive)
    assert {measure["name"]: measure["parameter"] for measure in manifest["measures"]}["fuel_per_km"] == "fuel"
    assert manifest["opens"] == 3, "the page opens with the strongest request"
    assert {parameter["text"] for parameter in manifest["parameters"]} >= {"tyres", "fuel"}
    for name in ("pace", "wear_per_km", "fuel_per_km"):
        values = [row["measured"][name] for row in manifest["recordings"]]
        assert values == pytest.approx(expected[name].tolist())
    for row in manifest["recordings"]:
        plain = gzip.decompress((out / row["file"]).read_bytes())
        header = json.loads(plain[4 : 4 + int.from_bytes(plain[:4], "little")])
        assert header["frames"] == STEPS + 1 and len(header["gauges"]) == STEPS + 1
        focus = next(array for array in header["arrays"] if array["name"] == "focus")
        assert focus["shape"] == [STEPS + 1, 3]


def test_all_recordings_of_a_race_begin_at_the_same_place(changed, tmp_path):
    agent, domain = changed(recorded=replace(domain_of(load_policy(NAME)).recorded, grid=GRID))
    recordings = recorded_page.record(agent, domain, domain.recorded_cells(), steps=1)
    assert len({tuple(recording.frames[0].focus) for recording in recordings}) == 1
    assert len({next(iter(recording.backdrops.values())) for recording in recordings}) == 1


def test_a_domain_without_scene_or_simulation_for_the_browser_says_so(changed, tmp_path, capsys):
    changed(make_stage=None, make_web=None)
    assert main(["export", "web", "racing_traffic", "--out", str(tmp_path / "site")]) == 2
    error = capsys.readouterr().err
    assert "neither a simulation for the browser nor a scene" in error and error.count("\n") == 1
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize("count", [0, MOST + 1])
def test_too_many_styles_are_refused(changed, tmp_path, count):
    page = changed(recorded=Recorded(grid=[{"fuel": float(i)} for i in range(count)]))
    with pytest.raises(ValueError, match=f"has {count} styles to record: expected 1 to {MOST}"):
        export_recordings(*page, tmp_path / "site")


def test_a_style_outside_of_the_trained_range_is_refused(changed, tmp_path):
    page = changed(recorded=Recorded(grid=[{"fuel": 1e6}]))
    with pytest.raises(ValueError, match="fuel"):
        export_recordings(*page, tmp_path / "site")
    assert not (tmp_path / "site").exists()


def test_an_unknown_measure_is_refused(changed, tmp_path):
    page = changed(recorded=Recorded(grid=[{"fuel": 0.0}], seconds=0.1, columns={"pace": ".1f", "grace": ".1f"}))
    with pytest.raises(ValueError, match=r"shows grace: expected some of .*pace"):
        export_recordings(*page, tmp_path / "site")
    assert not (tmp_path / "site").exists()


def test_a_file_in_place_of_the_folder_is_refused(changed, tmp_path):
    page = changed(recorded=Recorded(grid=[{"fuel": 0.0}], seconds=0.1))
    (tmp_path / "site").write_text("something else")
    with pytest.raises(NotADirectoryError, match="is a file: expected a folder"):
        export_recordings(*page, tmp_path / "site")
