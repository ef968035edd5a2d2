"""Every recipe's training, resumed from its middle, ends like the one that was not interrupted, bit for bit."""

import fcntl
import gc
import os
import sys
from importlib import import_module

import pytest
import torch
from recipe_config import compose_config, run_recipe

from coachable.training.checkpoint import CheckpointError, CheckpointStore, find_checkpoint, read_state
from tests.random_kills import RECIPES, differences

TINY = ["preset=smoke", "env.num_envs=2", "threads.simulator=1", "threads.learner=1", "train.eval_interval=16"]
TINY += ["init_random_frames=8", "train.warmup_frames=8", "train.batch_size=12", "eval.max_steps=3"]
TINY += ["train.total_frames=48", "train.utd_ratio=0.25", "eval.num_envs=1"]
TINY += ["replay_capacity=60", "event_capacity=60"]


@pytest.mark.parametrize("recipe", sorted(file.stem for file in (RECIPES / "configs").glob("*_*.yaml")))
def test_a_resumed_training_equals_the_uninterrupted_one(recipe, tmp_path, monkeypatch):
    build = import_module(recipe).build
    train = build(compose_config(recipe, [*TINY, f"run_dir={tmp_path / 'whole'}"]))
    middle = CheckpointStore(tmp_path / "rest" / "checkpoints")

    def save_in_the_middle():
        if train.frames == 28:
            middle.save({**train.describe(), **train.state_dict()}, {"frames": train.frames}, train.replay)

    monkeypatch.setattr(train, "_checkpoint_if_due", save_in_the_middle)
    train.run()
    rest = build(compose_config(recipe, [f"resume={tmp_path / 'rest'}"]))
    assert rest.frames == 28 and 0 < rest.learner.updates < train.learner.updates
    rest.run()
    found = differences(tmp_path / "rest", tmp_path / "whole")
    assert [name for name in found if not name.startswith("metrics/")] == []


def test_a_resumed_training_takes_as_many_threads(tmp_path):
    """How many cores are free, and so the rounding of sums, depends on the moment."""
    arguments = [*TINY, "threads.learner=null", "train.total_frames=4", f"run_dir={tmp_path}"]
    import_module("rare_targets").build(compose_config("rare_targets", arguments)).run()
    threads = read_state(find_checkpoint(tmp_path))["config"]["threads"]["learner"]
    assert threads == torch.get_num_threads()
    assert compose_config("rare_targets", [f"resume={tmp_path}"])["threads"]["learner"] == threads


def test_the_number_of_threads_is_the_one_that_was_asked_for(tmp_path, monkeypatch):
    """TorchRL raises it when a `SerialEnv` is closed, which happens to a forgotten one at any time."""
    gc.collect()  # of earlier tests
    monkeypatch.setattr("torchrl._THREAD_POOL_INIT", 4)
    train = import_module("cheetah_speed").build(compose_config("cheetah_speed", [*TINY, f"run_dir={tmp_path}"]))
    gc.collect()
    assert torch.get_num_threads() == 1
    train.collector.shutdown()
    torch.set_num_threads(1)


def test_a_refused_resumption_leaves_the_configuration_of_the_run(tmp_path):
    build = import_module("rare_targets").build
    build(compose_config("rare_targets", [*TINY, "train.total_frames=4", f"run_dir={tmp_path}"])).run()
    before = (tmp_path / "config.json").read_bytes()
    with pytest.raises(CheckpointError, match="was trained on another style space"):
        build(compose_config("rare_targets", [f"resume={tmp_path}", "sampler=one_hot", "train.total_frames=8"]))
    assert (tmp_path / "config.json").read_bytes() == before


def test_a_folder_that_another_process_writes_to_is_left_alone(tmp_path):
    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    with pytest.raises(CheckpointError, match="another training is writing to"):
        import_module("rare_targets").build(compose_config("rare_targets", [*TINY, f"run_dir={tmp_path}"]))
    os.close(descriptor)
    assert not list(tmp_path.iterdir())


def test_settings_given_beside_resume_are_named_if_the_training_cannot_be_made(tmp_path, monkeypatch):
    build = import_module("rare_targets").build
    build(compose_config("rare_targets", [*TINY, "train.total_frames=4", f"run_dir={tmp_path}"])).run()
    monkeypatch.setattr(
        sys, "argv", ["rare_targets.py", f"resume={tmp_path}", "train.total_frames=8", "+env.nonsense=1"]
    )
    with pytest.raises(SystemExit, match=r"nonsense(.|\n)*beside resume=.*: train.total_frames, env.nonsense$"):
        run_recipe("rare_targets", build)


def trained(run, *arguments):
    """A short training of the recipe rare_targets."""
    train = import_module("rare_targets").build(compose_config("rare_targets", [*TINY, *arguments, f"run_dir={run}"]))
    train.run()
    return train


@pytest.mark.filterwarnings("ignore:the checkpoint has no replay buffer")
def test_a_run_that_continues_from_an_older_checkpoint_forgets_the_newer_one(tmp_path):
    trained(tmp_path, "train.total_frames=24", "train.checkpoint_interval=0")
    oldest, *_, newest = sorted((tmp_path / "checkpoints").glob("frames_*"))
    assert find_checkpoint(tmp_path) == newest
    import_module("rare_targets").build(compose_config("rare_targets", [f"resume={oldest}"]))  # and is killed
    assert find_checkpoint(tmp_path) == oldest
    again = import_module("rare_targets").build(compose_config("rare_targets", [f"resume={tmp_path}"]))
    again.run()
    frames = [float(line.split(",")[0]) for line in (tmp_path / "metrics.csv").read_text().splitlines()[1:]]
    assert frames == sorted(frames) and frames[-1] == again.frames == 24


def test_the_same_choice_of_a_group_may_be_given_again(tmp_path):
    trained(tmp_path, "train.total_frames=4")
    for same in ("replay=event_tables", "network=residual"):
        config = compose_config("rare_targets", [f"resume={tmp_path}", same])
        assert config["replay_capacity"] == 60 and config["network"]["actor"]["widths"] == [32, 32]
    with pytest.raises(SystemExit, match="replay cannot change in a resumed run"):
        compose_config("rare_targets", [f"resume={tmp_path}", "replay=uniform"])


def test_what_a_checkpoint_names_is_checked_even_if_the_choice_is_given_again(tmp_path, monkeypatch):
    trained(tmp_path, "train.total_frames=4")
    state = read_state(find_checkpoint(tmp_path))
    state["config"]["replay"]["hidden"] = [{"_target_": "os.system", "command": "true"}]
    monkeypatch.setattr("recipe_config.read_state", lambda checkpoint: state)
    with pytest.raises((CheckpointError, SystemExit), match=r"os\.system|replay cannot change"):
        compose_config("rare_targets", [f"resume={tmp_path}", "replay=event_tables"])
    state["config"]["replay"]["hidden"] = "${oc.env:HOME}"
    with pytest.raises(CheckpointError, match="expected a plain value"):
        compose_config("rare_targets", [f"resume={tmp_path}", "replay=event_tables"])


@pytest.mark.filterwarnings("ignore:.*was not written")
def test_a_training_whose_end_is_not_saved_fails(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("coachable.training.checkpoint.save_state", fail)
    monkeypatch.setattr(sys, "argv", ["rare_targets.py", *TINY, "train.total_frames=4", f"run_dir={tmp_path}"])
    with pytest.raises(SystemExit, match="error: the training ended at env-step 4, which could not be saved"):
        run_recipe("rare_targets", import_module("rare_targets").build)


def test_files_that_are_not_a_runs_end_with_a_sentence(tmp_path, monkeypatch):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "config.json").write_text('{"mine": 1}')
    (tmp_path / "odd" / "metrics.csv").mkdir(parents=True)
    for folder, message in (("mine", "config.json is not the configuration of a run"), ("odd", "Is a directory")):
        monkeypatch.setattr(sys, "argv", ["rare_targets.py", *TINY, f"run_dir={tmp_path / folder}"])
        with pytest.raises(SystemExit, match=f"^error: .*{message}"):
            run_recipe("rare_targets", import_module("rare_targets").build)
    assert (tmp_path / "mine" / "config.json").read_text() == '{"mine": 1}'


def test_further_observations_need_an_agent(tmp_path):
    arguments = [*TINY, "init_new_observations=5", f"run_dir={tmp_path}"]
    with pytest.raises(ValueError, match="init_new_observations=5: expected init_from=PATH beside it"):
        import_module("rare_targets").build(compose_config("rare_targets", arguments))
