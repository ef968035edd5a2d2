"""The `coachable` command and its doctor."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from coachable import doctor
from coachable.cli import main

REPOSITORY = Path(__file__).resolve().parent.parent


def test_help_names_the_commands(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for command in ("evaluate", "report", "render", "curves", "explain", "coach", "export", "weights", "doctor"):
        assert re.search(rf"^\s+{command}\s", text, re.MULTILINE)


def test_the_command_starts_without_loading_torch():
    code = (
        "import sys, coachable.cli as c; c._parser(); assert 'torch' not in sys.modules and 'mujoco' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY)


@pytest.mark.parametrize(
    "arguments", [["evaluate", "nowhere"], ["render", "nowhere", "--out", "x.gif"], ["weights", "nowhere", "w.pt"]]
)
def test_a_missing_agent_is_named_without_a_traceback(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert f"coachable {arguments[0]}: no checkpoint at nowhere" in capsys.readouterr().err


def test_wrong_arguments_are_named(capsys):
    for arguments, message in [
        (["render", "x", "--style", "pose"], "'pose' is no NAME=VALUE"),
        (["render", "x", "--size", "big"], "'big' is no WIDTHxHEIGHT"),
        (["dance"], "invalid choice: 'dance'"),
    ]:
        with pytest.raises(SystemExit):
            main(arguments)
        assert message in capsys.readouterr().err


def test_weights_of_a_run(make_train, tmp_path, capsys):
    make_train(total_frames=80).run()
    assert main(["weights", str(tmp_path / "run"), str(tmp_path / "weights.pt")]) == 0
    assert "wrote" in capsys.readouterr().out
    assert (tmp_path / "weights.pt").is_file()


def test_the_doctor_approves_of_this_installation(capsys):
    status = main(["doctor"])
    text = capsys.readouterr().out
    assert status == 0, text
    for name in ("python", "torch", "mujoco", "rendering", "hardware", "threads", "preset"):
        assert re.search(rf"^(ok|note)\s+{name}\s", text, re.MULTILINE), name


@pytest.mark.parametrize(
    "versions, message",
    [
        ({"mujoco": "3.17.0", "mujoco-core": "4.0.0"}, "mujoco-core 4.0.0 lies beside mujoco 3.17.0"),
        ({"mujoco": "4.0.0"}, "4.0.0 breaks dm_control"),
    ],
)
def test_the_doctor_finds_a_broken_mujoco(monkeypatch, capsys, versions, message):
    real = doctor.installed
    monkeypatch.setattr(doctor, "installed", lambda name: versions.get(name, real(name)))
    assert main(["doctor"]) == 1
    assert re.search(rf"^problem .*{re.escape(message)}", capsys.readouterr().out, re.MULTILINE)


def test_the_doctor_finds_what_is_missing(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "installed", lambda name: None)
    assert main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert re.search(r"^problem\s+torch\s+missing", text, re.MULTILINE)
    assert "pip install -e '.[ui]'" in text


def test_the_readme_has_the_two_set_up_commands():
    """`.ci/run` takes the second one from here, so neither can drift."""
    lines = (REPOSITORY / "README.md").read_text().splitlines()
    commands = [line for line in lines if line.startswith("python3 -m venv ") and line.count("&&") == 2]
    assert [command.rsplit("&& ", 1)[1] for command in commands] == [
        ".venv/bin/python recipes/humanoid_sac.py",
        ".venv/bin/python -m pytest",
    ]
