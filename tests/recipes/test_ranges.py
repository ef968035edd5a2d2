"""Numbers of a configuration that lie outside their range: refused before anything is allocated."""

import math
import re
import sys
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path

import pytest
import recipe_config
import yaml
from configs.schema import Settings
from recipe_checks import checked_values, declared, range_of
from recipe_config import compose_config

from coachable.finite import NonFiniteError
from coachable.training.worker_errors import WorkerError

CONFIGS = Path(recipe_config.CONFIGS)
FREE = {"critic_support", "network.critic.initial_value", "env.conditions"}  # any finite number
OF_TARGETS = {  # the function or class checks them itself, before anything is written
    "env.costs={power: -1}": r"costs.power is -1: expected a number of at least 0",
    "env.start_speed=-1": r"start_speed is -1: expected a number of at least 0",
    "env.push_force=-1": r"push_force is -1: expected a number of at least 0",
    "env.push_interval=0": r"push_interval is 0: expected a number above 0",
    "env.push_share=1.1": r"push_share is 1.1: expected a number in \[0, 1\]",
    "env.num_enemies=3": r"num_enemies is 3: expected a whole number in \[1, 2\]",
    "env.traps=1.5": r"traps is 1.5: expected a whole number of at least 0",
    "loss.kappa=-1": r"kappa is -1: expected a number of at least 0",
    "+network.actor.dropout=1": r"dropout is 1: expected a number in \[0, 1\)",
}


def _numbers(value, path=()):
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from _numbers(entry, (*path, str(key)))
    elif isinstance(value, list):
        for entry in value:
            yield from _numbers(entry, (*path, "*"))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path


def _every_number():
    for file in sorted(CONFIGS.rglob("*.yaml")):
        text = file.read_text(encoding="utf-8")
        shared = file.parent == CONFIGS or "# @package _global_" in text
        for path in _numbers(yaml.safe_load(text) or {}, () if shared else (file.parent.name,)):
            if path[0] == "stages":  # each changes what the recipe has; its total_frames are train.total_frames
                path = path[2:] if path[2:] != ("total_frames",) else ("train", "total_frames")
            if path[0] not in ("hydra", "defaults"):
                yield file.stem, path


def test_every_number_of_the_configurations_has_a_range():
    found = list(_every_number())
    assert len(found) > 100
    lacking = {".".join(path) for _, path in found if range_of(declared(*path)) is None}
    known = FREE | {argument.strip("+").partition("=")[0] for argument in OF_TARGETS}
    assert {name for name in lacking if not any(name.startswith(free) for free in known)} == set()


def _declared(kind=Settings, path=()):
    for entry in fields(kind):
        if is_dataclass(entry.type):
            yield from _declared(entry.type, (*path, entry.name))
        elif entry.type in (int, float, int | None, float | None):
            yield (*path, entry.name), entry.metadata.get("range")
        for name, range_ in entry.metadata.get("ranges", {}).items():
            each = isinstance(range_, list)
            if range_ is bool:
                continue
            yield (*path, entry.name, name.replace("*", "any"), *["any"] * each), range_[0] if each else range_


def test_every_number_that_the_schema_declares_has_a_range():
    lacking = {path for path, range_ in _declared() if range_ is None}
    assert lacking == {("critic_support", "v_min"), ("critic_support", "v_max")}


@pytest.mark.parametrize("path, range_", [(path, range_) for path, range_ in _declared() if range_])
def test_what_lies_outside_of_a_declared_range_is_named(path, range_):
    for value in _outside(range_):
        config = value
        for part in reversed(path):
            config = {part: config}
        with pytest.raises(ValueError, match=rf"^{'.'.join(path)}=.*: expected a .*number "):
            checked_values(config)


def _outside(range_):
    low, high = (float(part) for part in range_.interval[1:-1].split(","))
    below = low if range_.interval[0] == "(" else low - 1
    above = high if range_.interval[-1] == ")" else high + 1
    return [below, above, math.nan, math.inf, "many", True] + [1.5] * range_.whole + [None] * (not range_.optional)


def test_numbers_of_a_target_are_named_with_their_place_and_range():
    cases = {
        ("replay", "gamma"): (2, "a number in [0, 1]"),  # as `gamma` itself
        ("env", "scenarios", "cars"): (0, "a whole number of at least 1"),
        ("network", "actor", "heads", "categorical"): (
            3,
            "a list of at least one entry, each a whole number of at least 1",
        ),
        ("env", "own", "number"): (math.inf, "a number that is finite"),
    }
    for path, (value, expected) in cases.items():
        config = value
        for part in reversed(path):
            config = {part: config}
        with pytest.raises(ValueError, match=re.escape(f"{'.'.join(path)}={value}: expected {expected}")):
            checked_values(config)


@pytest.mark.parametrize("argument", OF_TARGETS)
def test_what_a_target_checks_itself_is_refused_before_anything_is_written(argument, tmp_path):
    recipe = "racing_qr_sac" if "loss" in argument else "humanoid_sac"
    recipe = "combat_cat_rac" if argument.startswith(("env.num_enemies", "env.traps")) else recipe
    with pytest.raises(ValueError, match=OF_TARGETS[argument]):
        import_module(recipe).build(compose_config(recipe, ["preset=smoke", f"run_dir={tmp_path / 'run'}", argument]))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "argument, message",
    [
        ("gamma=1.5", r"gamma=1.5: expected a number in \[0, 1\]"),
        ("alpha=-0.1", r"alpha=-0.1: expected a number above 0"),
        ("learner.tau=2", r"learner.tau=2.0: expected a number in \(0, 1\]"),
        ("train.batch_size=0", r"train.batch_size=0: expected a whole number of at least 1"),
        ("train.batch_size=1.5", r"train.batch_size=1.5: expected a whole number of at least 1"),
        ("learner.compile=2", r"learner.compile=2: expected true or false"),
        ("mirror=1.2", r"mirror=1.2: expected a number in \[0, 1\]"),
        ("network.actor.widths=512", r"network.actor.widths=512: expected a list"),
        ("network.actor.widths=[32,0]", r"network.actor.widths=0: expected a whole number of at least 1"),
        (
            "network.critic.widths=[]",
            r"network.critic.widths=\[\]: expected a list of at least one entry, each a whole number",
        ),
        ("critic_support.v_min=900", r"critic_support.v_min=900.*: expected less than v_max, which is 800.0"),
        ("replay.gamma=-1", r"replay.gamma=-1: expected a number in \[0, 1\]"),
        ("style_reward.pose_scale=nan", r"style_reward.pose_scale=nan: expected a number of at least 0"),
    ],
)
def test_on_the_command_line(argument, message):
    with pytest.raises(ValueError, match=message):
        compose_config("humanoid_sac", ["preset=smoke", argument])


def test_a_wrong_number_is_reported_where_it_was_set():
    """The critics take the number of quantiles from the loss."""
    with pytest.raises(ValueError, match=r"^loss.num_quantiles=many: expected a whole number of at least 1"):
        compose_config("racing_qr_sac", ["preset=smoke", "loss.num_quantiles=many"])


def test_shares_above_one():
    for argument in ("event_share=1.1", "replay.event_share=1", "+replay.table_proportions={default: 1.5}"):
        with pytest.raises(ValueError, match="expected a number in"):
            compose_config("rare_targets", ["preset=smoke", argument])
    with pytest.raises(ValueError, match=r"sampler.share=2: expected a number in \[0, 1\]"):
        compose_config("racing_qr_sac", ["preset=smoke", "sampler=with_extremes", "sampler.share=2"])


def test_whole_numbers_may_be_written_with_an_exponent():
    config = compose_config("humanoid_sac", ["preset=smoke", "train.total_frames=1e6", "replay_capacity=2e3"])
    for value in (config["train"]["total_frames"], config["replay"]["table_capacities"]["default"]):
        assert isinstance(value, int)


@pytest.mark.parametrize(
    "recipe, arguments, message",
    [
        ("humanoid_sac", ["train.utd_ratio=null"], "needs a throttle"),
        ("humanoid_sac", ["n_steps=3", "impersonation.n=1"], "not linear"),
        (
            "rare_targets",
            ["+sampler.neutral=0.9", "sampler=independent", "+sampler.independent=0.9"],
            "exceed 1 together",
        ),
        ("rare_targets", ["event_horizon=5000"], "less than event_horizon"),
        ("rare_targets", ["train.batch_size=2"], "train.batch_size=2: every batch"),
        (
            "rare_targets",
            ["+env.num_env=2"],
            r"RareTargets takes no 'num_env'. Did you mean num_envs\? Valid: num_envs",
        ),
        ("rare_targets", ["replay.prioritized=2"], r"prioritized=2 of .*for_events: expected true or false"),
        ("rare_targets", ["+loss.alhpa=2"], r"SACLoss takes no 'alhpa'"),
        ("racing_qr_sac", ["+env.num_car=3"], r"family_env takes no 'num_car'"),
        ("racing_qr_sac", ["env.compiled=maybe"], r"compiled is 'maybe': expected True or False"),
        (
            "rare_targets",
            ["loss._target_=coachable.losses.Odd"],
            r"_target_=.*losses.Odd or .* cannot be used: Error load",
        ),
        ("rare_targets", ["+network.actor.drop_out=0.1"], r"make_gaussian_actor takes no 'drop_out': ResidualMLP"),
        ("racing_qr_sac", ["+loss.kapa=2"], r"QRSACLoss takes no 'kapa'. Did you mean kappa"),
        ("humanoid_sac", ["+train.batchsize=2"], r"train.batchsize does not exist: .*Did you mean batch_size"),
    ],
)
def test_contradictions_are_refused_before_anything_is_written(recipe, arguments, message, tmp_path):
    run_dir = tmp_path / "run"
    config = compose_config(recipe, ["preset=smoke", f"run_dir={run_dir}", *arguments])
    with pytest.raises(ValueError, match=message):
        import_module(recipe).build(config)
    assert not run_dir.exists()


def test_a_training_that_is_stopped_by_a_number_ends_with_one_sentence(monkeypatch, tmp_path):
    """At the command line: no traceback, exit code 1 (a message makes it so)."""

    class Stopped:
        def run(self):
            raise NonFiniteError("next/reward is nan in environment 1.")

    monkeypatch.setattr(sys, "argv", ["rare_targets.py", "preset=smoke", f"run_dir={tmp_path}"])
    monkeypatch.setattr(recipe_config, "announce", lambda *_: None)
    with pytest.raises(SystemExit) as stopped:
        recipe_config.run_recipe("rare_targets", lambda config: Stopped())
    assert stopped.value.code == "error: next/reward is nan in environment 1."
    monkeypatch.setattr(sys, "argv", ["rare_targets.py", "preset=smoke", "gamma=1.5"])
    with pytest.raises(SystemExit) as refused:
        recipe_config.run_recipe("rare_targets", lambda config: Stopped())
    assert refused.value.code == "error: gamma=1.5: expected a number in [0, 1]"


def test_workers_that_cannot_be_had_end_a_training_with_one_sentence(monkeypatch, tmp_path):
    def build(config):
        raise WorkerError("collector.num_collectors=4 need 4 cores")

    monkeypatch.setattr(sys, "argv", ["rare_targets.py", "preset=smoke", f"run_dir={tmp_path}"])
    with pytest.raises(SystemExit) as stopped:
        recipe_config.run_recipe("rare_targets", build)
    assert stopped.value.code == "error: collector.num_collectors=4 need 4 cores"


def test_an_argument_that_the_configuration_leaves_out_can_be_added():
    for argument in ("style_reward.in_corners=true", "env.cars=3"):
        with pytest.raises(SystemExit, match=rf"does not exist: .*; \+{argument.partition('=')[0]}=VALUE adds"):
            compose_config("racing_qr_sac", ["preset=smoke", "family=drift", argument])
        compose_config("racing_qr_sac", ["preset=smoke", "family=drift", f"+{argument}"])
    with pytest.raises(SystemExit) as refused:
        compose_config("racing_qr_sac", ["preset=smoke", "train.batchsize=3"])  # no argument can be added there
    assert "+train" not in refused.value.code


def test_ctrl_c_outside_of_the_loop_ends_with_one_sentence(monkeypatch, tmp_path, capsys):
    def interrupted(config):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", ["rare_targets.py", "preset=smoke", f"run_dir={tmp_path}"])
    with pytest.raises(SystemExit) as stopped:
        recipe_config.run_recipe("rare_targets", interrupted)
    assert stopped.value.code == 130
    assert capsys.readouterr().err.endswith("interrupted: complete checkpoints are kept\n")
