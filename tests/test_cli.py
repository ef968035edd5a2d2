"""The `coachable` command and its doctor."""

import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from coachable import __version__, doctor
from coachable.cli import main
from coachable.files import CheckpointError
from coachable.training.weights import load_policy

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


@pytest.mark.parametrize("further", ["evaluate --track", "coach own.csv", "evaluate --track --other"])
def test_an_option_of_a_domain_has_a_value(further, capsys):
    command, *rest = further.split()
    with pytest.raises(SystemExit):
        main([command, "racing_resources", *rest])
    assert "unrecognized arguments" in capsys.readouterr().err


def test_an_option_that_the_domain_lacks_is_named(capsys, tmp_path):
    assert main(["evaluate", "humanoid", "--out", str(tmp_path / "out"), "--track=own.csv"]) == 2
    assert "humanoid has no option --track: expected no options of its own" in capsys.readouterr().err


def test_a_bad_circuit_is_one_sentence(capsys, tmp_path):
    (tmp_path / "own.csv").write_text("1, 2, 3, 4\n1, 2, x, 4\n")
    arguments = ["evaluate", "racing_resources", "--out", str(tmp_path / "out"), "--track", str(tmp_path / "own.csv")]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert "own.csv, line 2: got '1, 2, x, 4', expected x, y, w_right, w_left in metres" in error
    assert len(error.strip().splitlines()) == 1 and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "arguments", [["evaluate", "nowhere"], ["render", "nowhere", "--out", "x.gif"], ["weights", "nowhere", "w.pt"]]
)
def test_a_missing_agent_is_named_without_a_traceback(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert f"coachable {arguments[0]}: no checkpoint at nowhere" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("render x --style pose", "'pose': expected NAME=VALUE"),
        ("render x --style pose=up,pose=down", "'pose=up,pose=down' gives pose twice"),
        ("render x --size big", "'big': expected WIDTHxHEIGHT"),
        ("render x --seconds many", "invalid float value: 'many'"),
        ("evaluate x --episodes 0", "--episodes: '0': expected a whole number of at least 1"),
        ("evaluate x --switch-episodes -1", "--switch-episodes: '-1': expected a whole number of at least 0"),
        ("evaluate x --steps 0", "--steps: '0': expected a whole number of at least 1"),
        ("evaluate x --threads 0", "--threads: '0': expected a whole number of at least 1"),
        ("evaluate x --seed -1", "--seed: '-1': expected a whole number of at least 0"),
        ("evaluate x --seed 9999999999", "--seed: 9999999999 is too large"),
        ("evaluate x --episodes many", "'many': expected a whole number"),
        ("report x --seeds 0", "--seeds: '0': expected a whole number of at least 1"),
        ("report x --sweep-points 1", "--sweep-points: '1': expected a whole number of at least 2"),
        ("explain x --episodes 1", "--episodes: '1': expected a whole number of at least 2"),
        ("explain x --states 0", "--states: '0': expected a whole number of at least 1"),
        ("curves a=nowhere* --smooth 0", "--smooth: '0': expected a whole number of at least 1"),
        ("export humanoid", "invalid choice: 'humanoid' (choose from 'onnx', 'web')"),
        ("export web", "required: source"),
        ("dance", "invalid choice: 'dance'"),
        ("", "required: COMMAND"),
    ],
)
def test_wrong_arguments_are_named(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nowhere_1").mkdir()
    (tmp_path / "nowhere_1" / "metrics.csv").touch()
    with pytest.raises(SystemExit) as stop:
        main(arguments.split())
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("source", ["walker", "README.md", ""])
def test_no_page_is_served_for_what_is_no_agent(source, capsys, monkeypatch, tmp_path):
    def served(*_, **__):
        raise AssertionError("the page was served")

    monkeypatch.setattr("coachable.coach.page.command.serve", served)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "README.md").write_text("# Not an agent\n")
    assert main(["coach", source]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "humanoid" in error and (source or "there is no agent") in error


@pytest.mark.parametrize("source", ["humanoid", "."])
def test_the_page_is_opened_for_an_agent(source, monkeypatch, tmp_path):
    opened = []
    monkeypatch.setattr("coachable.coach.page.command.serve", lambda **settings: opened.append(settings["source"]))
    monkeypatch.chdir(tmp_path)
    assert main(["coach", source]) == 0
    assert opened == [source]


def test_a_shipped_agent_goes_before_a_folder_that_is_no_run(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "humanoid").mkdir()
    (tmp_path / "humanoid" / "notes.txt").write_text("of my own")
    assert Path(load_policy("humanoid").metadata["source"]).parts[-3:] == ("pretrained", "humanoid", "weights.pt")
    assert main(["export", "onnx", "humanoid", "--out", "humanoid.onnx"]) == 0
    (tmp_path / "humanoid" / "checkpoints").mkdir()  # a run goes before the shipped agent, even if it is not complete
    with pytest.raises(CheckpointError, match="humanoid"):
        load_policy("humanoid")
    assert main(["export", "onnx", "humanoid", "--out", "again.onnx"]) == 2
    assert "humanoid" in capsys.readouterr().err


def test_another_file_is_no_agent(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "README.md").write_text("# Not an agent\n")
    for command in (["export", "onnx", "README.md"], ["weights", "README.md", "w.pt"], ["report", "README.md"]):
        assert main(command) == 2
        error = capsys.readouterr().err
        assert "README.md" in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]


@pytest.mark.parametrize("command", ["evaluate", "report", "explain"])
def test_a_file_in_the_place_of_the_output_is_named(command, capsys, tmp_path):
    (tmp_path / "taken").write_text("mine")
    assert main([command, "humanoid", "--out", str(tmp_path / "taken")]) == 2
    assert "taken is a file: expected a folder" in capsys.readouterr().err
    assert (tmp_path / "taken").read_text() == "mine"


def test_an_interrupted_report_leaves_nothing_behind(capsys, monkeypatch, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("coachable.evaluation.report.evaluate_run", interrupted)
    assert main(["report", "humanoid", "--out", str(tmp_path / "report")]) == 130
    assert capsys.readouterr().err.endswith("coachable report: interrupted, nothing was written\n")
    assert list(tmp_path.iterdir()) == []


def test_interrupted_trainings_of_several_seeds_keep_their_checkpoints(capsys, monkeypatch, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("coachable.evaluation.many_seeds.train_seeds", interrupted)
    assert main(["train", "rare_targets", "seeds=0,1", f"run_dir={tmp_path}"]) == 130
    assert capsys.readouterr().err == "coachable train: interrupted, complete checkpoints are kept\n"


def test_a_machine_that_cannot_draw_is_told_what_to_install(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert main(["render", "humanoid", "--seconds", "0.1", "--out", str(tmp_path / "film.gif")]) == 2
    assert "no OpenGL library was found" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_agents_of_other_domains_are_not_evaluated_together(capsys, tmp_path):
    assert main(["evaluate", "humanoid", "racing_drift", "--out", str(tmp_path / "out")]) == 2
    assert "agents of humanoid and racing_drift given: expected agents of one domain" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_agents_of_other_domains_cannot_share_a_report(capsys, tmp_path):
    assert main(["report", "humanoid", "racing_drift", "--out", str(tmp_path / "report")]) == 2
    assert "the one belongs to racing_drift, the other to humanoid" in capsys.readouterr().err


def test_curves_are_drawn_as_pictures_only(capsys, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.csv").write_text("updates,episode/return\n1,2\n")
    assert main(["curves", f"a={tmp_path / 'run'}", "--out", str(tmp_path / "curves.txt")]) == 2
    assert "Format 'txt' is not supported (supported formats: " in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["run"]


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"coachable {__version__}\n"


def test_weights_of_a_weights_file(capsys, tmp_path):
    assert main(["weights", "humanoid", str(tmp_path / "weights.pt")]) == 2
    assert "is a small weights file already: expected a run's folder or a checkpoint" in capsys.readouterr().err


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
    assert "set by you" not in text, "which cannot be told: the package has set MUJOCO_GL by then"


@pytest.mark.parametrize(
    "versions, message",
    [
        ({"mujoco": "3.17.0", "mujoco-core": "4.0.0"}, "mujoco-core 4.0.0 lies beside mujoco 3.17.0"),
        ({"mujoco": "4.0.0"}, "4.0.0 breaks dm_control: make a new virtual environment with 'mujoco>=3.17,<4'"),
    ],
)
def test_the_doctor_finds_a_broken_mujoco(monkeypatch, capsys, versions, message):
    real = doctor.installed
    monkeypatch.setattr(doctor, "installed", lambda name: versions.get(name, real(name)))
    assert main(["doctor"]) == 1
    assert re.search(rf"^problem .*{re.escape(message)}", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.parametrize("version, verdict", [("2.60.0", "ok"), ("2.49.1", "problem"), ("3.0.0", "problem")])
def test_the_doctor_checks_ray_and_its_ports(monkeypatch, version, verdict):
    real = doctor.installed
    monkeypatch.setattr(doctor, "installed", lambda name: version if name == "ray" else real(name))
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = {}
        monkeypatch.setattr(doctor, "_RAY_PORTS", free)
        assert [check.verdict for check in doctor._ray()] == [verdict]
        port = server.getsockname()[1]
        free[port] = "cluster"
        (check,) = doctor._ray()
        assert check.verdict == ("note" if verdict == "ok" else verdict)
        assert verdict != "ok" or f"a program listens at {port} (cluster)" in check.finding


def test_the_doctor_finds_what_is_missing(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "installed", lambda name: None)
    assert main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert re.search(r"^problem\s+torch\s+missing", text, re.MULTILINE)
    assert "pip install 'coachable[ui]' (in a clone: pip install -e '.[ui]')" in text


@pytest.mark.parametrize("version, reason", [((3, 10), ""), ((3, 13), "labmaze, which dm-control needs")])
def test_the_doctor_finds_a_python_that_dependencies_do_not_support(monkeypatch, capsys, version, reason):
    monkeypatch.setattr(doctor, "python_version", lambda: version)
    assert main(["doctor"]) == 1
    assert re.search(
        rf"^problem python .*expected Python 3.11 or 3.12.*{reason}", capsys.readouterr().out, re.MULTILINE
    )


def test_the_readme_has_the_two_set_up_commands():
    """`.ci/run` takes the second one from here, so neither can drift."""
    lines = (REPOSITORY / "README.md").read_text().splitlines()
    commands = [line for line in lines if line.startswith("python3 -m venv ") and line.count("&&") == 2]
    assert [command.rsplit("&& ", 1)[1] for command in commands] == [
        ".venv/bin/python recipes/humanoid_sac.py",
        ".venv/bin/python -m pytest",
    ]


def test_train_runs_the_recipe_of_that_name(tmp_path, monkeypatch):
    """In another folder, where nothing but the command knows where recipes are."""
    monkeypatch.chdir(tmp_path)
    recipes = REPOSITORY / "recipes"
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder and Path(folder).resolve() != recipes])
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith(str(recipes)):
            monkeypatch.delitem(sys.modules, name)
    threads = torch.get_num_threads()
    arguments = ["preset=smoke", "train.total_frames=120", "train.eval_interval=0", f"run_dir={tmp_path / 'run'}"]
    for resolver in ("groups", "domain_of_family"):  # the recipe's own, which another test may have registered
        OmegaConf.clear_resolver(resolver)
    try:
        assert main(["train", "rare_targets", *arguments, "threads.simulator=1", "threads.learner=1"]) == 0
    finally:
        torch.set_num_threads(threads)
    assert (tmp_path / "run" / "metrics.csv").exists()


def test_train_names_the_recipes(capsys):
    with pytest.raises(SystemExit):
        main(["train", "humanoid"])
    assert "cheetah_speed" in capsys.readouterr().err
