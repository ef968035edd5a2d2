"""Several trainings with different seeds: side by side, continued where they were interrupted, one table."""

import os
import re
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import pytest
from recipe_config import compose_config

from coachable.cli import main
from coachable.evaluation import many_seeds
from coachable.evaluation.many_seeds import parse_seeds, seed_table, train_seeds
from coachable.training.checkpoint import find_checkpoint, read_state
from coachable.training.hardware import Hardware
from coachable.training.logging import MetricsLog
from tests.cluster.test_faults import wait_for_end

TINY = ["preset=smoke", "train.total_frames=200", "threads.simulator=1", "threads.learner=1"]
ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("text", ["", "1,", "1,1", "-1", "0.5", "1 2"])
def test_seeds_that_are_no_list_of_seeds(text, capsys):
    assert main(["train", "rare_targets", f"seeds={text}"]) == 2
    assert f"seeds={text}: expected different whole numbers" in capsys.readouterr().err


def test_seeds_are_not_given_twice(capsys):
    assert parse_seeds("2,0") == [2, 0]
    assert main(["train", "rare_targets", "seed=3", "seeds=0,1"]) == 2
    assert "seeds=0,1 with seed=...: expected one of them" in capsys.readouterr().err
    for flag in ("--help", "-m", "--cfg"):
        assert main(["train", "rare_targets", "seeds=0,1", flag]) == 2
        assert f"seeds=0,1 with {flag}: expected KEY=VALUE only" in capsys.readouterr().err


def test_finished_trainings_are_shown_and_not_repeated(tmp_path, capsys):
    for seed in (0, 1):
        arguments = [*TINY, f"seed={seed}", f"run_dir={tmp_path / f'seed_{seed}'}"]
        import_module("rare_targets").build(compose_config("rare_targets", arguments)).run()
    before = [(tmp_path / f"seed_{seed}" / "metrics.csv").read_text() for seed in (0, 1)]
    capsys.readouterr()
    assert main(["train", "rare_targets", *TINY, "seeds=0,1", f"run_dir={tmp_path}"]) == 0
    table = capsys.readouterr().out
    heading, _, *lines = [line.strip("| ").split(" | ") for line in table.splitlines()[1:]]
    assert heading == ["quantity", "seed 0", "seed 1", "mean", "std"]
    rows = {name: [float(cell) for cell in cells] for name, *cells in lines}
    assert rows["frames"] == [200, 200, 200, 0] and "episode/return" in rows
    for zero, one, mean, _ in rows.values():
        assert mean == pytest.approx((zero + one) / 2, rel=1e-3)
    assert not list(tmp_path.glob("*.log"))
    assert main(["train", "rare_targets", *TINY, "loss=qr_sac", "seeds=0,1", f"run_dir={tmp_path}"]) == 2
    assert re.search(r"holds trainings with .*: expected the same settings", capsys.readouterr().err)
    assert [(tmp_path / f"seed_{seed}" / "metrics.csv").read_text() for seed in (0, 1)] == before


def test_the_table_counts_all_stages(tmp_path):
    for stage, frames in (("1_first", 24), ("2_second", 40)):
        log = MetricsLog(tmp_path / "seed_0" / "stages" / stage)
        log.write({"frames": frames, "updates": frames // 4, "minutes": 1.5, "eval/return": frames})
    cells = [line.strip("| ").split(" | ") for line in seed_table(tmp_path, [0], {}).splitlines()]
    rows = {row[0]: row[1] for row in cells if len(row) > 1}
    assert (rows["frames"], rows["updates"], rows["minutes"]) == ("64", "16", "3")
    assert rows["eval/return"] == "40"


@pytest.mark.parametrize(
    "said, cores, expected",
    [
        ([], 4, ["threads.simulator=2", "threads.learner=2"]),
        ([], 64, ["threads.simulator=32", "threads.learner=8"]),
        (["threads.learner=1"], 4, ["threads.simulator=2"]),
    ],
)
def test_trainings_side_by_side_share_the_cores(said, cores, expected, tmp_path, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(many_seeds, "detect", lambda: Hardware(cores, 0.0, 8.0, None, False))
    commands = []

    def start(script, arguments, seed, folder):
        commands.append(arguments)
        return subprocess.Popen(["true"])

    monkeypatch.setattr(many_seeds, "_start", start)
    train_seeds(Path("recipe.py"), said, [0, 1], tmp_path)
    assert commands == [[*said, *expected]] * 2


def test_the_signal_that_ended_a_training_is_named(tmp_path):
    script = tmp_path / "recipe.py"
    script.write_text("import os, signal\nprint('half done', flush=True)\nos.kill(os.getpid(), signal.SIGKILL)\n")
    assert "ended by SIGKILL" in train_seeds(script, ["a=1", "b=2"], [0], tmp_path / "runs")[0]
    script.write_text("raise SystemExit('error: no such loss')")
    assert train_seeds(script, ["b=2", "a=1"], [0], tmp_path / "runs") == {0: "error: no such loss"}


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=["ctrl_c", "killed"])
def test_the_same_command_continues_what_was_interrupted(tmp_path, number):
    total = 1_500
    arguments = ["train", "rare_targets", *TINY, f"train.total_frames={total}", "train.checkpoint_interval=1"]
    command = [sys.executable, "-m", "coachable.cli", *arguments, "seeds=3,5", f"run_dir={tmp_path}"]

    def start():
        return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True)

    process = start()
    while not (tmp_path / "seed_3" / "checkpoints" / "LATEST").exists() and process.poll() is None:
        time.sleep(0.1)
    if number == signal.SIGKILL:
        children = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
        process.kill()
        process.communicate()
        assert children and process.returncode == -signal.SIGKILL
        assert not wait_for_end(children), "trainings save a checkpoint and end"
    else:
        os.killpg(process.pid, number)
        said, _ = process.communicate()
        assert process.returncode == 1 and "interrupted: the same command continues" in said
    assert 0 < read_state(find_checkpoint(tmp_path / "seed_3"))["loop"]["frames"] < total
    process = start()
    said, _ = process.communicate()
    assert process.returncode == 0
    assert re.search(rf"^\| frames \| {total} \| {total} \| {total} \|", said, re.MULTILINE)
    assert "Resumed " in (tmp_path / "seed_3.log").read_text()
    assert {read_state(find_checkpoint(tmp_path / f"seed_{s}"))["config"]["seed"] for s in (3, 5)} == {3, 5}
