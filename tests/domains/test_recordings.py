"""Every shipped agent without a page of its own can be recorded for one."""

from dataclasses import replace
from pathlib import Path

import pytest

import coachable
from coachable.evaluation import recorded_page
from coachable.training.weights import domain_of, load_policy

SHIPPED = sorted(file.parent.name for file in (Path(coachable.__file__).parent / "pretrained").glob("*/weights.pt"))


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_agent_is_exported_as_a_page(name, tmp_path, monkeypatch):
    agent = load_policy(name)
    domain = domain_of(agent)
    if domain.make_web is not None:
        assert domain.make_web(agent.space).measures
        return
    code = tmp_path / "three.js"
    code.write_text("export {};")
    monkeypatch.setattr(recorded_page, "provide", lambda *_: {"three/three.js": code})
    short = replace(domain, recorded=replace(domain.recorded, seconds=domain.control_step))
    recorded_page.export_recordings(agent, short, tmp_path / "site")
    files = sorted(file.name for file in (tmp_path / "site" / "recordings").iterdir())
    assert f"{len(short.recorded_cells()) - 1}.bin" in files
