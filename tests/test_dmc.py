"""The benchmark `dmc.py`: a training of seconds, its tasks, and its tables."""

import csv

import dmc
import numpy as np
import pytest
from dmc_workers import EPISODE, REPEAT, Task


def run(out, *options):
    tiny = ["num_envs=4", "random_steps=100", "widths=[16,16]", "batch_size=32", "capacity=10000"]
    chosen = ["--tasks", "walker-walk", "--contestants", "coachable", "--seeds", "0", "--threads", "1"]
    dmc.main(["--out", str(out), *chosen, *options, "--settings", *tiny])


def test_a_training_writes_its_rows_and_is_not_repeated(tmp_path, capsys):
    run(tmp_path, "--minutes", "0.05")
    with (tmp_path / "results.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["task"] == "walker-walk" and row["contestant"] == "coachable" and row["seed"] == "0"
    assert float(row["minutes"]) >= 0.05 and int(row["updates"]) > 0 and 0 <= float(row["return"]) <= EPISODE
    assert int(row["env_steps"]) > REPEAT * 100
    assert (tmp_path / "results.png").exists() and (tmp_path / "results.md").exists()
    capsys.readouterr()
    (training,) = tmp_path.glob("*.jsonl")
    before = training.read_bytes()
    run(tmp_path, "--minutes", "0.05")
    assert training.read_bytes() == before and "minutes" not in capsys.readouterr().err
    training.write_bytes(before[:-20])
    run(tmp_path, "--minutes", "0.05")
    assert dmc.read_rows(training)


@pytest.mark.parametrize("name", ["walker-walk", "quadruped-walk", "humanoid-walk"])
def test_a_task_equals_the_suite_with_each_action_twice(name):
    from dm_control import suite

    def flat(step):
        return np.concatenate([np.ravel(part) for part in step.observation.values()]).astype(np.float32)

    env = suite.load(*name.split("-"), task_kwargs={"random": 5})
    task = Task(name, 5)
    env.reset()  # a task has been reset once when it is made
    assert np.array_equal(flat(env.reset()), task.reset())
    rng = np.random.default_rng(0)
    for _ in range(EPISODE // REPEAT):
        action = rng.uniform(-1, 1, task.action_dim).astype(np.float32)
        steps = [env.step(action) for _ in range(REPEAT)]
        observation, reward, terminated, truncated = task.step(action)
        assert np.array_equal(observation, flat(steps[-1]))
        assert reward == pytest.approx(sum(step.reward for step in steps)) and not terminated
        assert truncated == steps[-1].last()


def test_results_are_found_by_task_contestant_and_seed(tmp_path):
    row = '{"minutes": 1.0, "env_steps": 1000, "return": 10.0}'
    for name in ("ball_in_cup-catch_coachable_0", "ball_in_cup-catch_sbx-sac_1"):
        (tmp_path / f"{name}.jsonl").write_text(f"{row}\n")
    found = dmc.collect(tmp_path)
    assert {name: list(seeds) for name, seeds in found["ball_in_cup-catch"].items()} == {
        "coachable": [0],
        "sbx-sac": [1],
    }


def test_marks_that_a_training_did_not_reach_are_empty():
    rows = [{"minutes": 1.0, "env_steps": 1000, "return": 10.0}, {"minutes": 2.0, "env_steps": 3000, "return": 30.0}]
    higher = [{**row, "return": row["return"] + 4} for row in rows]
    assert dmc.median_at({0: rows, 1: higher}, "minutes", 1.5) == pytest.approx(22.0)
    assert dmc.median_at({0: rows}, "env_steps", 2000) == pytest.approx(20.0)
    assert dmc.median_at({0: rows}, "minutes", 3.0) is None
    assert dmc.median_at({0: rows}, "env_steps", 500) is None
