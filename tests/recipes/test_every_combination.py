"""Every recipe with every loss and replay buffer: composed, and trained for a few updates."""

import itertools
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
import recipe_boxes
import torch
from recipe_checks import typed_settings
from recipe_config import compose_config, config_groups, run_recipe
from tensordict import TensorDict

from coachable.domains.racing.families import racing_family
from coachable.envs.racing.race.observation import COURSE_POINTS
from coachable.replay import KeyEvents
from coachable.training.checkpoint import CheckpointError, find_checkpoint, read_state
from coachable.training.collection import simulation_env
from coachable.training.trainer import REPLAY_KEYS
from coachable.training.weights import load_policy
from coachable.transforms import TaskImpersonation

RECIPES = sorted(file.stem for file in (Path(__file__).resolve().parents[2] / "recipes" / "configs").glob("*_*.yaml"))
TINY = ["preset=smoke", "env.num_envs=2", "threads.simulator=1", "threads.learner=1", "train.eval_interval=0"]
TINY += ["init_random_frames=8", "train.warmup_frames=8", "train.batch_size=12", "eval.max_steps=3"]
TINY += ["train.total_frames=28", "train.utd_ratio=0.125", "impersonation.n=0", "eval.num_envs=1"]
TINY += ["replay_capacity=100", "event_capacity=60"]
BRIEF = ["train.utd_ratio=0", "train.total_frames=3"]
FULLY = ("humanoid_sac", "combat_cat_rac")  # continuous actions, and mixed ones
SCENARIOS = {"racing_qr_sac": ("solo", "recovery"), "combat_cat_rac": ("Scrounger", "Ravager")}
POLICY_FIRST = {"qr_sac", "rac", "cat_rac", "sac_categorical"}  # paper, Appendix B


def _train(recipe, run_dir, *arguments):
    config = compose_config(recipe, [*TINY, f"run_dir={run_dir}", *arguments])
    train = import_module(recipe).build(config)
    train.run()
    return train


def _is_served(recipe, loss):
    return recipe != "combat_cat_rac" or loss not in ("sac", "qr_sac")


def _losses_and_buffers():
    """Every loss with one buffer for each kind of action; the other recipes share the losses, with every buffer each.

    Their losses differ in nothing but their numbers: what a recipe gives to one, it gives to all of them.
    """
    losses = itertools.cycle(config_groups("humanoid_sac")["loss"])
    for recipe in RECIPES:
        groups = config_groups(recipe)
        if recipe in FULLY:
            served = [loss for loss in groups["loss"] if _is_served(recipe, loss)]
            buffers = itertools.cycle(groups["replay"])
            yield from ((recipe, loss, buffer) for loss, buffer in zip(served, buffers, strict=False))
        else:
            yield from ((recipe, next(losses), buffer) for buffer in groups["replay"])


def test_recipes_were_found():
    assert {"humanoid_sac", "combat_cat_rac", "racing_qr_sac", "cheetah_speed", "rare_targets"} <= set(RECIPES)


@pytest.mark.parametrize("recipe, loss, replay", list(_losses_and_buffers()))
def test_every_loss_and_every_replay_buffer_train(recipe, loss, replay, tmp_path, capsys):
    choice = [f"loss={loss}", f"replay={replay}", "impersonation.n=1", "n_steps=1", "train.total_frames=26"]
    train = _train(recipe, tmp_path, *choice)
    assert train.learner.updates == (26 - 8) // 8
    assert train.learner.update_order == ("policy_first" if loss in POLICY_FIRST else "simultaneous")
    for name, value in train.learner.loss_module.named_parameters():
        assert torch.isfinite(value).all(), name
    sample = train.replay.sample(8)
    assert set(REPLAY_KEYS) - {("next", "style_features")} <= set(sample.keys(True))
    if replay == "multi_tables":
        scenarios = SCENARIOS.get(recipe, ())
        assert train.replay.names == (scenarios or ("default",))
        stored = sample.get("scenario", None)
        assert torch.equal(stored.squeeze(-1), sample["table"]) if scenarios else stored is None
        assert ("there is one table" in capsys.readouterr().out) == (not scenarios)
        return
    assert train.replay.names[:1] == ("default",) and (len(train.replay.names) > 1) == (replay == "event_tables")


def test_the_papers_racing_learns_with_dropout_and_acts_without(tmp_path):
    tiny = ["preset=paper", "device=cpu", "env.num_envs=3", "network.actor.widths=[8,8]", "network.critic.widths=[8]"]
    tiny += ["replay_capacity=300", "init_random_frames=0", "train.warmup_frames=3", "train.total_frames=18"]
    tiny += ["train.utd_ratio=0.25", "n_steps=2", "train.batch_size=8", "threads.learner=1"]
    train = import_module("racing_qr_sac").build(
        compose_config("racing_qr_sac", [*TINY[1:], *tiny, f"run_dir={tmp_path}"])
    )
    races = simulation_env(train.collector.env)
    assert races.garage.pooled and races.garage.pool.shape[1] == 530 and len(races.starter.conditions.compounds) == 9
    policy = train.collector.policy
    dropped = []
    for module in policy.modules():
        if isinstance(module, torch.nn.Dropout):
            assert module.p == 0.1
            module.register_forward_hook(lambda *_: dropped.append(train.learner.updates))
    acted = next(iter(train.collector)).select("observation", "style", "loc")
    assert not dropped
    train.run()
    assert train.learner.updates == 2 and dropped == [0, 0, 1, 1]  # two layers, in the policy's loss alone
    loaded = load_policy(tmp_path).actor
    with torch.no_grad():
        again, mode = policy(acted.clone())["loc"], loaded(acted.clone())["loc"]
    assert torch.equal(again, mode) and torch.equal(loaded(acted.clone())["loc"], mode)


def test_a_table_of_an_event_has_labels_of_its_own(tmp_path):
    choice = ["impersonation.n=1", "impersonation.own_table=true"]
    train = _train("combat_cat_rac", tmp_path, *choice, "events.every_style=true")
    (relabel,) = (part for part in train.replay._transform if isinstance(part, TaskImpersonation))
    asked = {train.replay.names[number]: sampler.sample((50,)) for number, sampler in relabel.tables.items()}
    assert tuple(asked) == relabel.space.names and {*train.replay.names} - {*asked} <= {"default", "kill"}
    assert all(((styles > 0).sum(0) > 0).nonzero().item() == i for i, styles in enumerate(asked.values()))
    assert isinstance(train.replay._writer.events, KeyEvents)
    with pytest.raises(ValueError, match=r"own_table=true: expected replay=event_tables.*the tables are default"):
        _train("combat_cat_rac", tmp_path / "uniform", *choice, "replay=uniform")
    with pytest.raises(ValueError, match=r"own_table=true with impersonation.n=0"):
        _train("combat_cat_rac", tmp_path / "none", "impersonation.n=0", choice[1])


def test_most_requests_of_the_continuous_one_hot_sampler_are_one_weight_of_any_size(tmp_path):
    train = _train("combat_cat_rac", tmp_path, "sampler=continuous_one_hot", "impersonation.n=7")
    assert train.learner.updates > 0
    theta = train.replay.sample(64)["style"].reshape(-1, train.learner.loss_module.actor_network.module[0].space.dim)
    single = theta[(theta != 0).sum(-1) == 1].sum(-1)
    assert len(single) > 0.3 * len(theta) and len(single.unique()) > 20


def test_returns_over_several_steps_are_relabelled_by_the_sum_of_their_features(tmp_path):
    train = _train("racing_qr_sac", tmp_path, "n_steps=3", "impersonation.n=2", "family=resources")
    sample = train.replay.sample(16)
    assert sample.shape == (16, 3) and (sample["steps_to_next_obs"] == 3).any()
    following = sample["next"]
    style_reward = racing_family("resources").make_reward(racing_family("resources").make_space())
    expected = following["task_reward"] + style_reward(following["style_features"], sample["style"])
    torch.testing.assert_close(following["reward"], expected, rtol=1e-4, atol=1e-4)


def test_circuits_that_turn_left_turn_right_in_the_mirror(tmp_path):
    train = _train("racing_qr_sac", tmp_path, "mirror=1", "impersonation.n=1", "n_steps=1", "family=resources")
    assert train.learner.updates > 0
    bends = train.replay.sample(16)["observation"][..., -COURSE_POINTS:]  # curvature of a ring and an oval
    assert (bends <= 0).all() and (bends < 0).any()


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_choice_composes(recipe):
    """Every choice of every group, several groups at a time."""
    groups = config_groups(recipe)
    for row in range(max(map(len, groups.values()))):
        chosen = {group: choices[row % len(choices)] for group, choices in groups.items()}
        config = compose_config(recipe, [f"{group}={choice}" for group, choice in chosen.items()])
        assert config["preset"] != "auto", "auto was replaced by what it chose"
        assert config["preset"] == chosen["preset"] or chosen["preset"] == "auto"


@pytest.mark.parametrize(
    "stage, style_reward, new", [("traffic", {}, 33), ("late_traffic", {"gained": 2.0, "defended": 8.0}, 0)]
)
def test_the_stages_in_traffic_are_of_the_tyre_and_fuel_family(stage, style_reward, new):
    config = compose_config("racing_qr_sac", ["preset=resources", f"stage={stage}"])
    assert config["domain"] == "racing_resources" and config["style_reward"] == style_reward
    assert config["sampler"]["only"] is None and config["init_new_observations"] == new
    assert sum(config["env"]["scenarios"]["shares"].values()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "stage, margins",
    [
        ("races", {"weight": 2.0}),
        ("passing", {"weight": 1.0}),
        ("late_races", {"weight": 16.0, "apart": 0.1}),
    ],
)
def test_the_stages_of_races_are_of_their_family(stage, margins, tmp_path):
    config = compose_config("racing_qr_sac", ["preset=aggressiveness", f"stage={stage}"])
    assert config["domain"] == "racing_aggressiveness" and config["style_reward"] == margins
    assert config["sampler"]["shared"] is True
    assert sum(config["env"]["scenarios"]["shares"].values()) == pytest.approx(1.0)
    arguments = ["preset=aggressiveness", f"stage={stage}", "family=drift", f"run_dir={tmp_path}"]
    config = compose_config("racing_qr_sac", arguments)
    with pytest.raises(
        ValueError, match=f"style_reward has {', '.join(sorted(margins))}: racing_drift takes angle_scale, in_corners"
    ):
        import_module("racing_qr_sac").build(config)


@pytest.mark.parametrize("stage", ["alone", "clean", "races"])
def test_a_driver_of_races_learns_alone_on_the_observation_of_races(stage):
    config = compose_config(
        "racing_qr_sac", ["preset=aggressiveness", f"stage={stage}", "env.num_envs=3", "env.track=ring"]
    )
    among_others = stage == "races"
    assert config["impersonation"]["n"] == (2 if among_others else 0) and config["init_new_observations"] == 0
    settings = typed_settings(config)
    env = settings.env.build(num_envs=3, seed=0)
    assert env.cars == (5 if among_others else 1) and env.observation_size == 190
    assert env.reset()["style_features"].shape[-1] == 10 + 3 * (env.cars - 1)


@pytest.mark.parametrize("stage", ["laps", "corners"])
def test_the_stages_of_drifting_pay_for_corners_on_many_circuits(stage):
    config = compose_config("racing_qr_sac", ["preset=drift", f"stage={stage}"])
    assert config["domain"] == "racing_drift" and config["style_reward"] == {"in_corners": True, "angle_scale": 2.5}
    assert config["env"]["track"] == "training" and config["env"]["curvature"] is True
    shares = {name: config["sampler"][name] for name in ("positive", "full", "neutral")}
    assert sum(shares.values()) < 1.0 and config["sampler"]["_target_"].endswith("with_requests")


def test_a_driver_who_drove_alone_starts_out_blind_to_others(tmp_path):
    alone = _train("racing_qr_sac", tmp_path / "alone", "family=resources", "train.total_frames=16")
    choice = ["family=resources", "+env.cars=3", "env.num_envs=3", f"init_from={tmp_path / 'alone'}"]
    with pytest.raises(RuntimeError, match=r"\(\d+, 161\) in the checkpoint, \(\d+, 194\) here"):
        _train("racing_qr_sac", tmp_path / "refused", *choice)
    among = _train("racing_qr_sac", tmp_path / "among", *choice, "init_new_observations=33", *BRIEF)
    seen, theta, others = torch.randn(5, 157), torch.randn(5, 4), torch.randn(5, 33)
    action = alone.collector.policy(TensorDict({"observation": seen, "style": theta}, [5]))["loc"]
    wider = TensorDict({"observation": torch.cat([seen, others], -1), "style": theta}, [5])
    torch.testing.assert_close(among.collector.policy(wider)["loc"], action)


def test_a_wide_network_that_drove_alone_still_can_while_nobody_is_near(tmp_path):
    wide = ["family=resources", *(f"network.{part}.widths=[256,256]" for part in ("actor", "critic"))]
    alone = _train("racing_qr_sac", tmp_path / "alone", *wide, "train.total_frames=16")
    choice = ["+env.cars=3", "env.num_envs=3", f"init_from={tmp_path / 'alone'}", "init_new_observations=33"]
    among = _train("racing_qr_sac", tmp_path / "among", *wide, *choice, *BRIEF)
    seen, theta, action = torch.randn(5, 157), torch.randn(5, 4), torch.rand(5, 2)
    drive = TensorDict({"observation": seen, "style": theta, "action": action}, [5])
    nobody = drive.clone().set("observation", torch.cat([seen, torch.zeros(5, 33)], -1))
    torch.testing.assert_close(among.collector.policy(nobody)["loc"], alone.collector.policy(drive)["loc"])
    old, new = alone.learner.loss_module, among.learner.loss_module
    value = _value(old, old.qvalue_network_params, drive)
    for params in (new.qvalue_network_params, new.target_qvalue_network_params):
        torch.testing.assert_close(_value(new, params, nobody), value)


def _value(loss, params, data):
    with params[1].to_module(loss.qvalue_network):
        return loss.qvalue_network(data.clone())["state_action_value"]


def test_networks_without_room_for_others_are_refused(tmp_path):
    narrow = ["family=resources", *(f"network.{part}.widths=[170,170]" for part in ("actor", "critic"))]
    _train("racing_qr_sac", tmp_path / "alone", *narrow, *BRIEF)
    choice = ["+env.cars=3", "env.num_envs=3", "init_new_observations=33", f"init_from={tmp_path / 'alone'}"]
    with pytest.raises(CheckpointError, match=r"layers of \[170, 170\] units cannot get 33 inputs"):
        _train("racing_qr_sac", tmp_path / "among", *narrow, *choice)


@pytest.mark.parametrize("loss, replay", [("sac", "uniform"), ("cat_rac", "event_tables")])
def test_runs_with_tables_resume_bit_for_bit(loss, replay, tmp_path):
    choice = [f"loss={loss}", f"replay={replay}", "n_steps=3", "replay.prioritized=true"]
    _train("humanoid_sac", tmp_path / "whole", *choice, "train.total_frames=56")
    _train("humanoid_sac", tmp_path / "half", *choice, "train.total_frames=28")
    rest = compose_config("humanoid_sac", [f"resume={tmp_path / 'half'}", "train.total_frames=56"])
    import_module("humanoid_sac").build(rest).run()
    states = [read_state(find_checkpoint(tmp_path / name)) for name in ("whole", "half")]
    for name, value in states[0]["actor"].items():
        assert torch.equal(value, states[1]["actor"][name]), name


@pytest.mark.parametrize(
    "recipe, arguments, message",
    [
        ("humanoid_sac", ["sampler=one_hot"], r"pose, step_length .* cannot be \(not a weight\)"),
        ("humanoid_sac", ["n_steps=3", "impersonation.n=4"], r"impersonation.n=4 with n_steps=3"),
        ("humanoid_sac", ["replay=event_tables", "events=null"], r"replay=event_tables: humanoid names no events"),
        (
            "humanoid_sac",
            ["replay=event_tables", "train.batch_size=2"],
            r"train.batch_size=2: every batch .* 3 tables \(default, step, fall\)",
        ),
        (
            "humanoid_sac",
            ["loss=cat_rac", "critic_support.v_min=100"],
            r"initial_value must lie in \[100.0, 800.0\], got 0.0",
        ),
        ("humanoid_sac", ["init_from=nowhere"], r"nowhere"),
        ("humanoid_sac", ["loss=qr_sac", "network.critic.num_outputs=5"], r"5 outputs: QRSACLoss expects 32"),
        ("cheetah_speed", ["+network.critic.num_outputs=2"], r"2 outputs: SACLoss expects 1"),
        ("combat_cat_rac", ["env.machines=[Thunderclaw]"], r"Thunderclaw"),
        ("combat_cat_rac", ["loss=sac"], r"continuous actions only"),
        ("combat_cat_rac", ["loss=qr_sac"], r"continuous actions only"),
        ("combat_cat_rac", ["loss=sac", "network=residual"], r"continuous actions only, combat has buttons: .*gamepad"),
        ("rare_targets", ["network=gamepad"], r"continuous actions only, network.actor has buttons"),
        ("cheetah_speed", ["mirror=0.5"], r"cheetah has no mirror images, expected mirror=0"),
        ("racing_qr_sac", ["mirror=0.5", "env.curvature=false"], r"mirror images need env.curvature=true"),
        ("cheetah_speed", ["+network.actor.heads.axes=6"], r"make_gaussian_actor .* required .*'action_dim'"),
        ("cheetah_speed", ["~env._target_"], r"^env has no _target_: expected the name of a function or class"),
        ("cheetah_speed", ["~network.critic._target_"], r"^network.critic has no _target_"),
        ("rare_targets", ["+collector.frames_per_batch=99"], r"^frames_per_batch=99 of .*: the recipe sets it"),
        ("rare_targets", ["+env.seed=5"], r"^seed=5 of rare_targets.RareTargets: the recipe sets it"),
        ("rare_targets", ["collector.num_collectors=4"], r"^collector.num_collectors=4: collector=direct collects in"),
        (
            "rare_targets",
            ["loss=cat_rac", "network.critic.v_min=-7"],
            r"^network.critic.v_min=-7: the loss has -5.0; expected critic_support",
        ),
        ("rare_targets", ["+network.actor.obs_dim=3"], r"^network.actor.obs_dim: the environment sets it"),
    ],
)
def test_what_makes_no_sense_fails_at_the_start_with_one_sentence(recipe, arguments, message, tmp_path):
    with pytest.raises((ValueError, RuntimeError), match=message):
        _train(recipe, tmp_path, *arguments)


def test_an_environment_of_ones_own_that_takes_no_seed_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(import_module("cheetah_speed"), "cheetah_env", lambda num_envs, seconds: None)
    with pytest.raises(ValueError, match=r"^cheetah_speed.cheetah_env does not take .* unexpected .*'seed'"):
        _train("cheetah_speed", tmp_path)


@pytest.mark.parametrize("recipe", ["humanoid_sac", "racing_qr_sac"])
def test_help_names_the_recipe(recipe, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [f"{recipe}.py", "--help"])
    with pytest.raises(SystemExit) as stop:
        run_recipe(recipe, build=None)
    assert stop.value.code == 0
    assert f"python recipes/{recipe}.py preset=smoke" in capsys.readouterr().out


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_critics_are_tried_on_their_own_device(recipe, tmp_path, monkeypatch):
    """The example environment stays on the CPU, whatever the device of the networks."""
    make_loss, devices = recipe_boxes.make_loss, []

    def watched(run, actor, critics, env):
        example = env.fake_tensordict()
        with monkeypatch.context() as patch:
            moved = SimpleNamespace(to=lambda device: devices.append(device) or example)
            patch.setattr(env, "fake_tensordict", lambda: moved)
            return make_loss(run, actor, critics, env)

    monkeypatch.setattr(recipe_boxes, "make_loss", watched)
    _train(recipe, tmp_path, *BRIEF)
    assert devices == [torch.device("cpu")]
