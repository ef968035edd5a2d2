"""What the name of an agent means, to the command line and to `load_policy`."""

import subprocess
import sys

import pytest

from coachable.shipped import located, shipped_agents


def test_the_shipped_agents_are_found():
    assert {"humanoid", "combat", "racing_drift"} <= set(shipped_agents())
    for name in shipped_agents():
        assert located(name).parts[-3:] == ("pretrained", name, "weights.pt")
        assert located(name).is_file()


@pytest.mark.parametrize(
    ("made", "is_own"), [("notes.txt", False), ("checkpoints/", True), ("frames_8/", True), ("state.pt", True)]
)
def test_a_folder_goes_before_the_shipped_agent_of_its_name_only_if_it_holds_a_run(made, is_own, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    content = tmp_path / "humanoid" / made
    content.parent.mkdir(exist_ok=True)
    if made.endswith("/"):
        content.mkdir()
    else:
        content.touch()
    assert (located("humanoid").resolve() == tmp_path / "humanoid") == is_own


def test_a_file_goes_before_the_shipped_agent_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "humanoid").touch()
    assert located("humanoid").resolve() == tmp_path / "humanoid"


def test_other_names_are_paths(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert located("~/run") == tmp_path / "run"
    assert located(tmp_path / "humanoid") == tmp_path / "humanoid"


def test_the_rule_needs_no_torch():
    code = "import sys, coachable.shipped; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
