"""The humanoid recipe: its configuration, its errors, and a short run of every part."""

import csv
import inspect
import json
import subprocess
import sys
from dataclasses import fields
from importlib import import_module
from pathlib import Path

import pytest
import recipe_config
import torch
from recipe_config import announce, checked_arguments, compose_config

from coachable.domains.humanoid import humanoid_style_reward
from coachable.envs.humanoid import HumanoidEnv
from coachable.training import Learner
from coachable.training.checkpoint import CheckpointError, find_checkpoint, read_state
from coachable.training.hardware import Hardware
from coachable.training.train_settings import TrainSettings
from coachable.training.weights import domain_of, load_policy

REPOSITORY = Path(__file__).resolve().parents[2]
RECIPE = REPOSITORY / "recipes" / "humanoid_sac.py"
TINY = ["preset=smoke", "env.num_envs=2", "threads.simulator=1", "threads.learner=1", "train.eval_interval=0"]
TINY += ["init_random_frames=8", "train.warmup_frames=8", "train.batch_size=8", "eval.max_steps=3"]
TINY += ["replay_capacity=100"]


def _compose(*arguments):
    return compose_config("humanoid_sac", list(arguments))


def _run(run_dir, *arguments):
    import humanoid_sac

    train = humanoid_sac.build(_compose(*TINY, f"run_dir={run_dir}", *arguments))
    train.run()
    return train


def _resume(run_dir, *arguments):
    import humanoid_sac

    train = humanoid_sac.build(_compose(f"resume={run_dir}", *arguments))
    train.run()
    return train


@pytest.mark.parametrize("name", ["a=b", "a, b", "it's {here}", "1.5", "x=y=[z]"])
def test_any_name_of_a_folder_can_be_written_to_and_resumed(tmp_path, name):
    config = _compose(f"run_dir={tmp_path / name}", f"init_from={tmp_path / name}")
    assert config["run_dir"] == config["init_from"] == str(tmp_path / name)


def test_a_path_may_be_quoted_or_null(tmp_path):
    config = _compose(f"run_dir='{tmp_path / 'quoted'}'", "init_from=null")
    assert config["run_dir"] == str(tmp_path / "quoted") and config["init_from"] is None


def test_the_paper_preset_is_the_papers():
    config = _compose("preset=paper")
    assert config["gamma"] == 0.99 and config["replay_capacity"] == 750_000
    assert config["learner"]["actor_lr"] == config["learner"]["critic_lr"] == 1e-4
    assert config["learner"]["update_order"] == "simultaneous"
    assert config["loss"]["alpha_init"] == 0.01 and config["loss"]["fixed_alpha"] is True
    assert config["train"]["warmup_frames"] == 15_000 and config["train"]["throttle"] == 60
    assert config["network"]["actor"]["widths"] == config["network"]["critic"]["widths"] == [512, 512, 512]


def test_the_configuration_lists_what_its_targets_take():
    """Every key is an argument of what it configures, and the style rewards' values are the library's defaults."""
    config = _compose("preset=smoke")
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(humanoid_style_reward).parameters.items()
        if name != "space"
    }
    assert config["style_reward"] == defaults
    assert set(config["train"]) - {"_target_"} == {field.name for field in fields(TrainSettings)}
    assert set(config["learner"]) - {"_target_"} <= set(inspect.signature(Learner).parameters)
    assert set(config["env"]) - {"_target_"} <= set(inspect.signature(HumanoidEnv.__init__).parameters)


@pytest.mark.parametrize(
    "argument, message",
    [
        ("los=sac", r"los does not exist.*Did you mean loss\?"),
        ("loss=sacc", r"loss=sacc does not exist\. Did you mean sac\? Valid: .*sac"),
        ("preset=fast", r"preset=fast does not exist\. Valid: auto, cpu, gpu, paper, smoke"),
        ("train.batchsize=3", r"train has no 'batchsize'\. Did you mean batch_size\? Valid: .*total_frames"),
        ("train.batch_size=many", r"train.batch_size=many: expected a whole number of at least 1"),
        ("learner.actor_lr=fast", r"learner.actor_lr=fast: expected a number of at least 0"),
        ("train.throttle=fast", r"train.throttle=fast: expected a number above 0, or null"),
        ("gamma=null", r"gamma=null: expected a number in \[0, 1\]"),
        ("domain=[a]", r"domain=\['a'\]: expected a name or path"),
        ("wandb=online", r"wandb=online: expected a group of settings"),
        ("stages=3", r"stages=3: expected a list"),
        ("stages=[a]", r"stages=\[a\]: Cannot assign str to Dict\[str, Any\]"),
        ("gamma.x=1", r"gamma=\{\}: expected a number in \[0, 1\]"),
        ("train.batch_size", r"expected KEY=VALUE"),
    ],
)
def test_mistakes_are_named_with_the_valid_choices(argument, message):
    with pytest.raises(SystemExit, match=message):
        _compose(argument)


@pytest.mark.parametrize(
    "text, message",
    [
        ("alphaa: 0.1", r"alphaa does not exist: .* Did you mean alpha\? Valid: .*train"),
        ("train: {batchsize: 3}", r"train.batchsize does not exist: train has no 'batchsize'. Did you mean batch_size"),
        ("train: {batch_size: many}", r"train.batch_size=many: expected a whole number of at least 1"),
        ("learner: 3", r"In 'preset/humanoid_sac/mine': .* int is not a subclass of Learner"),
    ],
)
def test_mistakes_in_a_file_of_ones_own_are_named_too(text, message, tmp_path):
    file = tmp_path / "preset" / "humanoid_sac" / "mine.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("# @package _global_\ndefaults: [/preset/humanoid_sac/smoke]\npreset: mine\n")
    arguments = ["--config-dir", str(tmp_path), "preset=mine"]
    expected = ["preset=humanoid_sac/mine", "--config-dir", str(tmp_path)]
    assert checked_arguments("humanoid_sac", arguments) == expected
    file.write_text(f"# @package _global_\n{text}\n")
    with pytest.raises(SystemExit, match=message):
        checked_arguments("humanoid_sac", arguments)


def test_the_bare_command_chooses_a_preset():
    (chosen,) = checked_arguments("humanoid_sac", [])
    assert chosen in ("preset=humanoid_sac/cpu", "preset=humanoid_sac/gpu")
    assert _compose()["preset"] == chosen.removeprefix("preset=humanoid_sac/")


def test_several_seeds_are_for_the_command():
    with pytest.raises(SystemExit, match="coachable train humanoid_sac seeds=0,1,2"):
        checked_arguments("humanoid_sac", ["preset=smoke", "seeds=0,1"])


def test_an_empty_path_is_refused():
    with pytest.raises(SystemExit, match="resume= is empty: expected resume=PATH"):
        checked_arguments("humanoid_sac", ["preset=smoke", "resume="])


def test_a_domain_that_nobody_registers_is_refused():
    with pytest.raises(ValueError, match=r"domain=humanoit: expected a registered one\. Did you mean humanoid\?"):
        compose_config("humanoid_sac", ["preset=smoke", "domain=humanoit"])


def test_one_critic_is_refused_where_the_loss_takes_the_smaller_value(tmp_path):
    config = compose_config("humanoid_sac", ["preset=smoke", "network.num_critics=1", f"run_dir={tmp_path}"])
    with pytest.raises(ValueError, match=r"network.num_critics is 1: expected at least 2 with loss=sac"):
        import_module("humanoid_sac").build(config)


def test_a_learned_entropy_weight_that_is_to_be_annealed_is_refused_at_the_start(tmp_path):
    settings = ["loss.fixed_alpha=false", "train.anneal=0.5", "train.anneal_entropy=0.4", f"run_dir={tmp_path}"]
    with pytest.raises(ValueError, match="no fixed entropy weight to scale"):
        import_module("humanoid_sac").build(compose_config("humanoid_sac", ["preset=smoke", *settings]))


def test_a_training_too_short_for_an_update_says_so(tmp_path, capsys):
    config = compose_config("rare_targets", ["preset=smoke", "train.total_frames=100", f"run_dir={tmp_path}"])
    announce(config, import_module("rare_targets").build(config))
    assert "warning: no update will be made, because train.warmup_frames=" in capsys.readouterr().out


def test_bf16_without_hardware_for_it_says_so(tmp_path, capsys, monkeypatch):
    settings = ["preset=smoke", "learner.precision=bf16", "train.total_frames=200", f"run_dir={tmp_path}"]
    config = compose_config("rare_targets", settings)
    train = import_module("rare_targets").build(config)
    for has_bf16 in (True, False):
        monkeypatch.setattr(recipe_config, "detect", lambda bf16=has_bf16: Hardware(2, 0.0, 8.0, None, bf16))
        announce(config, train)
        assert ("warning: this machine has no bf16 in hardware" in capsys.readouterr().out) != has_bf16


def test_hydras_options_pass_through():
    arguments = checked_arguments("humanoid_sac", ["preset=cpu", "--cfg", "job", "train.total_frames=1e6"])
    assert arguments == ["train.total_frames=1e6", "preset=humanoid_sac/cpu", "--cfg", "job"]
    assert _compose("+note=mine")["note"] == "mine"
    assert checked_arguments("humanoid_sac", ["preset=cpu", "--info"]) == ["preset=humanoid_sac/cpu", "--info"]
    assert checked_arguments("humanoid_sac", ["--hydra-help"]) == ["--hydra-help"]


@pytest.mark.parametrize("arguments", [["--multirun"], ["-m", "seed=0,1"], ["seed=0,1"], ["preset=smoke,cpu"]])
def test_sweeps_are_refused(arguments):
    with pytest.raises(SystemExit, match=r"expected coachable train humanoid_sac seeds=0,1,2 for several seeds"):
        checked_arguments("humanoid_sac", arguments)


def test_resumed_runs_equal_uninterrupted_ones(tmp_path):
    """Bit for bit on one thread, the physics of the running episodes included."""
    _run(tmp_path / "whole", "train.total_frames=56")
    _run(tmp_path / "half", "train.total_frames=28")
    _resume(tmp_path / "half", "train.total_frames=56")
    states = [read_state(find_checkpoint(tmp_path / name)) for name in ("whole", "half")]
    updates = {state["learner"]["updates"] for state in states}
    assert updates == {(56 - 8) // 8}
    for part in ("learner", "collector", "rng", "loop"):
        _assert_equal(states[0][part], states[1][part], part)


def _assert_equal(a, b, where):
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            _assert_equal(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, torch.Tensor):
        assert torch.equal(a, b), where
    else:
        assert a == b, where


def test_a_resumed_run_keeps_its_configuration(tmp_path):
    _run(tmp_path / "run", "train.total_frames=24", "learner.tau=0.5")
    config = _compose(f"resume={tmp_path / 'run'}", "train.total_frames=32", "learner.actor_lr=1e-5")
    assert config["preset"] == "smoke" and config["learner"]["tau"] == 0.5
    assert config["train"]["total_frames"] == 32 and config["learner"]["actor_lr"] == 1e-5
    assert config["run_dir"] == str(tmp_path / "run")
    with pytest.raises(SystemExit, match=r"gamma cannot change in a resumed run: start a new one with init_from="):
        _compose(f"resume={tmp_path / 'run'}", "gamma=0.9")
    with pytest.raises(SystemExit, match=r"n_steps, alpha cannot change in a resumed run"):
        _compose(f"resume={tmp_path / 'run'}", "n_steps=5", "alpha=0.5")
    with pytest.raises(ValueError, match=r"train.batch_size=0: expected a whole number of at least 1"):
        _compose(f"resume={tmp_path / 'run'}", "train.batch_size=0")
    with pytest.raises(SystemExit, match="a resumed run keeps its preset"):
        _compose(f"resume={tmp_path / 'run'}", "preset=cpu")
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        _compose(f"resume={tmp_path / 'nowhere'}")


def test_a_new_run_starts_from_another_ones_weights(tmp_path):
    _run(tmp_path / "first", "train.total_frames=24")
    second = _run(tmp_path / "second", "train.total_frames=4", "sampler=independent", f"init_from={tmp_path / 'first'}")
    assert second.learner.updates == 0
    first = read_state(find_checkpoint(tmp_path / "first"))
    for name, value in read_state(find_checkpoint(tmp_path / "second"))["actor"].items():
        assert torch.equal(value, first["actor"][name]), name


def test_the_family_of_gaits_trains_with_a_domain_of_its_own(tmp_path):
    assert _compose()["domain"] == "humanoid" and _compose("family=gait")["domain"] == "humanoid_gait"
    train = _run(tmp_path / "run", "family=gait", "impersonation.n=1", "train.total_frames=24")
    assert train.learner.updates == 2
    agent = load_policy(tmp_path / "run")
    assert agent.space.names == ("pose", "step_length", "speed")
    env = domain_of(agent).make_env(num_envs=1, num_threads=1)
    assert env.styled_speed and env.gait.step_max == 2.0
    with pytest.raises(SystemExit, match="family cannot change in a resumed run"):
        _compose(f"resume={tmp_path / 'run'}", "family=steps")
    _resume(tmp_path / "run", "train.total_frames=32")
    with pytest.raises(ValueError, match="unknown family 'run': expected steps or gait"):
        _run(tmp_path / "other", "family=run")


def test_a_checkpoint_that_names_no_family_is_of_the_default_one(tmp_path):
    import humanoid_sac

    config = _compose(*TINY, f"run_dir={tmp_path}", "train.total_frames=8")
    del config["family"]
    humanoid_sac.build(config).run()
    assert load_policy(tmp_path).space.names == ("pose", "step_length")


def test_the_command_line_from_another_folder(tmp_path):
    """The smoke preset as a user starts it: trains, evaluates, writes a checkpoint that loads and can be resumed."""
    command = [sys.executable, str(RECIPE), "preset=smoke", "train.total_frames=240", "train.eval_interval=120"]
    command.append("eval.max_steps=10")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    (run,) = (tmp_path / "runs" / "humanoid").iterdir()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["runs"], "Hydra leaves nothing behind"
    assert sorted(p.name for p in run.iterdir()) == ["checkpoints", "config.json", "metrics.csv"]
    assert json.loads((run / "config.json").read_text())["preset"] == "smoke"
    with (run / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert int(rows[-1]["frames"]) == 240 and any(row["eval/return"] for row in rows)
    assert [row for row in rows if row["loss/loss_qvalue"] and float(row["loss/loss_qvalue"]) > 0]
    assert [row for row in rows if row["step/style_pose"]]
    assert all(float(row["minutes"]) > 0 for row in rows[1:])
    measured = [float(row["eval/pose_held"]) for row in rows if row["eval/return"]]
    assert measured and all(0 <= share <= 1 for share in measured), "from the first evaluation on"
    policy = load_policy(run)
    assert policy.metadata["frames"] == 240 and policy.space.dim == 4
    last = json.loads(done.stderr.strip().splitlines()[-1])
    assert last["frames"] == 240 and last["updates"] == 5


@pytest.mark.slow
def test_workers_in_other_processes(tmp_path):
    command = [sys.executable, str(RECIPE), "preset=smoke", "collector=process", f"run_dir={tmp_path / 'run'}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    assert read_state(find_checkpoint(tmp_path / "run"))["loop"]["frames"] == 2_000
