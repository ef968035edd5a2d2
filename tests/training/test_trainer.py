"""The loop: exact resumption, accounting of updates, statistics, refusal of bad numbers."""

import csv
import math
import os
import signal
import threading
import warnings
from types import SimpleNamespace

import pytest
import torch
from torchrl.envs import ActionScaling, PendulumEnv, TransformedEnv
from torchrl.envs.utils import RandomPolicy, check_env_specs

from coachable.networks import make_gaussian_actor
from coachable.replay import EventTableBuffer
from coachable.training import throttle
from coachable.training.checkpoint import find_checkpoint, read_state
from coachable.training.collection import evaluate_policy, make_collector, require_same_bounds
from coachable.training.train_settings import TrainSettings


def _tensors(state, prefix=""):
    for key, value in state.items():
        if isinstance(value, dict):
            yield from _tensors(value, f"{prefix}{key}.")
        elif isinstance(value, torch.Tensor):
            yield f"{prefix}{key}", value


def test_the_test_environment_keeps_its_specs(make_echo_env):
    check_env_specs(make_echo_env(0), seed=0)


def test_n_plus_n_equals_2n_bit_for_bit(make_train, tmp_path):
    whole = make_train(tmp_path / "whole", total_frames=320, utd_ratio=0.06)
    whole.run()
    half = make_train(tmp_path / "half", total_frames=160, utd_ratio=0.06)
    half.run()
    # The checkpoint decides everything, not the seed.
    rest = make_train(tmp_path / "half", total_frames=320, utd_ratio=0.06, seed=7)
    rest.resume(tmp_path / "half")
    assert rest.frames == 160
    rest.run()
    assert whole.learner.updates == rest.learner.updates == 16  # 0.06 of 280
    states = [read_state(find_checkpoint(tmp_path / name)) for name in ("whole", "half")]
    expected, found = (dict(_tensors(state)) for state in states)
    assert expected.keys() == found.keys()
    for part in ("actor.", "learner.optimizers.", "collector.carrier.", "collector.transforms.", "rng."):
        assert any(name.startswith(part) for name in expected), part
    assert states[0]["loop"] == states[1]["loop"] and states[0]["rng"]["python"] == states[1]["rng"]["python"]
    for name, value in expected.items():
        assert torch.equal(value, found[name]), name
    stored, again = whole.replay.storage.get(slice(0, 300)), rest.replay.storage.get(slice(0, 300))
    assert (stored == again).all()


def test_resume_of_a_finished_training_changes_no_row_and_writes_no_checkpoint(make_train, tmp_path):
    """A kill after the last checkpoint is complete leaves such a training behind."""
    train = make_train(total_frames=80)
    train.evaluate = lambda: {"return": 1.0}
    train.run()
    before = (tmp_path / "run" / "metrics.csv").read_text()
    assert before.count("\n80,") == 2  # of the evaluation, and of the log
    checkpoints = sorted((tmp_path / "run" / "checkpoints").iterdir())
    again = make_train(total_frames=80)
    again.evaluate = train.evaluate
    again.resume(tmp_path / "run")
    again.run()
    assert (tmp_path / "run" / "metrics.csv").read_text() == before
    assert sorted((tmp_path / "run" / "checkpoints").iterdir()) == checkpoints


def test_sums_in_tables_are_of_one_episode_if_the_collector_yields_several_steps_at_once(make_train, make_echo_env):
    train = make_train(total_frames=160)
    train.collector = make_collector(make_echo_env, train.collector.policy, frames_per_batch=16)  # 4 steps of 4
    train.replay = EventTableBuffer({"default": 300}, num_envs=4, n_steps=2, gamma=1.0)
    train.run()
    stored = train.replay.table("default")
    assert (stored["steps_to_next_obs"] == 2).sum() > 100
    later = 20 * (stored["next", "observation"] - stored["observation"])[:, 2:]  # steps since the start of the episode
    torch.testing.assert_close(later, stored["steps_to_next_obs"].float())


def test_batches_larger_than_the_replay_buffer_are_refused_at_the_start(make_train):
    make_train(batch_size=300)
    with pytest.raises(ValueError, match="batch_size=301: expected at most 300, the capacity of the replay buffer"):
        make_train(batch_size=301)


def test_a_policy_whose_actions_have_other_bounds_than_the_environments_is_refused():
    actor = make_gaussian_actor(3, 1, None, (8,))
    wide = r"entry 0 of the action ranges over \[-2, 2\] in the environment, over \[-1, 1\] in the policy"
    with pytest.raises(ValueError, match=wide):
        make_collector(lambda seed: PendulumEnv(), actor, frames_per_batch=1)
    require_same_bounds(TransformedEnv(PendulumEnv(), ActionScaling()), actor)
    require_same_bounds(PendulumEnv(), RandomPolicy(PendulumEnv().action_spec))


def test_a_training_killed_before_its_first_checkpoint_leaves_no_row_to_the_next(make_train, tmp_path):
    train = make_train(total_frames=80, log_interval=0.0)
    train.run()
    train.checkpoints.directory.rename(tmp_path / "elsewhere")
    make_train(total_frames=40).run()
    with (tmp_path / "run" / "metrics.csv").open() as file:
        assert [int(row["frames"]) for row in csv.DictReader(file)] == [40]


def test_resume_without_simulator_state_restarts_episodes_and_says_so(make_train, tmp_path):
    make_train(total_frames=80, resumable=False).run()
    rest = make_train(total_frames=120, resumable=False)
    with pytest.warns(
        UserWarning, match="episodes of StyleEchoEnv are not restored: .* has no simulator_state"
    ) as told:
        rest.resume(tmp_path / "run")
    assert len(told) == 1 and "everything else that the checkpoint holds is restored" in str(told[0].message)
    rest.run()
    assert rest.frames == 120


def test_resume_with_another_number_of_threads_says_so(make_train, tmp_path):
    make_train(total_frames=80).run()
    rest = make_train(total_frames=80)
    torch.set_num_threads(2)
    try:
        with pytest.warns(
            UserWarning, match="written with 1 torch threads, this run has 2: sums are rounded differently"
        ):
            rest.resume(tmp_path / "run")
    finally:
        torch.set_num_threads(1)


def test_what_happened_before_a_checkpoint_is_in_the_metrics(make_train, tmp_path):
    """A training that ends without a last word, right after a checkpoint, has told of every episode up to it."""
    train = make_train(total_frames=400, checkpoint_interval=0.0, log_interval=1e9, utd_ratio=0.0)
    save = train.checkpoints.try_save

    def stop_after(state, metadata, replay):
        save(state, metadata, replay)
        if metadata["frames"] >= 100:
            raise KeyboardInterrupt

    train.checkpoints.try_save = stop_after
    with pytest.raises(KeyboardInterrupt):
        train.run()
    rest = make_train(total_frames=100)
    rest.resume(tmp_path / "run")
    assert rest.seconds["collect"] > 0.0
    rest.run()
    with (tmp_path / "run" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    ended = int(rest.replay.storage.get(slice(0, 100))["next", "done"].sum())
    assert sum(int(row["episode/count"]) for row in rows) == ended > 0
    assert float(rows[-1]["seconds/collect"]) >= float(rows[-2]["seconds/collect"])


def test_resume_with_another_number_of_environments_says_so(make_train, tmp_path):
    make_train(total_frames=80).run()
    rest = make_train(total_frames=96, num_envs=8)
    with pytest.warns(UserWarning, match="holds 4 environments, this run has 8"):
        rest.resume(tmp_path / "run")
    rest.run()


def test_resume_takes_a_new_learning_rate(make_train, tmp_path):
    make_train(total_frames=80).run()
    rest = make_train(total_frames=80, actor_lr=0.5)
    rest.resume(tmp_path / "run")
    assert rest.learner.optimizers["actor"].param_groups[0]["lr"] == 0.5
    assert rest.learner.optimizers["critic"].param_groups[0]["lr"] == 1e-3


def test_learning_rates_fall_to_a_tenth_over_the_last_share(make_train, tmp_path):
    settings = TrainSettings(total_frames=400, anneal=0.25)
    assert [settings.learning_rate_factor(frames) for frames in (0, 300, 350, 400, 450)] == pytest.approx(
        [1.0, 1.0, 0.55, 0.1, 0.1]
    )
    train = make_train(total_frames=200, utd_ratio=0.05, anneal=0.25)
    train.run()
    assert train.learner.optimizers["actor"].param_groups[0]["lr"] == pytest.approx(1e-4)
    again = make_train(total_frames=400, anneal=0.25)
    again.resume(tmp_path / "run")
    assert again.learner.optimizers["actor"].param_groups[0]["lr"] == pytest.approx(1e-3)


def test_the_entropy_weight_falls_with_the_learning_rates(make_train, tmp_path):
    settings = TrainSettings(total_frames=400, anneal=0.25, anneal_entropy=0.2)
    assert [settings.entropy_factor(frames) for frames in (0, 300, 350, 400)] == pytest.approx([1.0, 1.0, 0.6, 0.2])
    before = make_train(total_frames=400).learner.loss_module.log_alpha.exp()
    train = make_train(total_frames=200, utd_ratio=0.05, anneal=0.25, anneal_entropy=0.2)
    train.run()
    assert train.learner.loss_module.log_alpha.exp() == pytest.approx(0.2 * before)
    again = make_train(total_frames=400, anneal=0.25, anneal_entropy=0.2)
    again.resume(tmp_path / "run")
    assert again.learner.loss_module.log_alpha.exp() == pytest.approx(before)


@pytest.mark.parametrize("utd_ratio, updates", [(0.0, 0), (0.125, 5), (0.3, 12), (1.0, 40)])
def test_updates_per_step(make_train, utd_ratio, updates):
    train = make_train(total_frames=80, utd_ratio=utd_ratio)
    train.run()
    assert abs(train.learner.updates - updates) <= 1  # 80 frames, the first 40 are warm-up; 0.3 is not exact in binary


def test_without_settings_every_step_is_followed_by_an_update(make_train):
    train = make_train(total_frames=6, num_envs=1)
    train.settings = TrainSettings(total_frames=6, batch_size=1)
    train.run()
    assert train.learner.updates == 6  # from the first one on
    assert train.learner.optimizers["actor"].param_groups[0]["lr"] == 1e-3  # and nothing is annealed


def test_without_a_ratio_the_learner_fills_the_throttled_time(make_train, monkeypatch):
    """Of 1.5 s, half a second is the warm-up; the rest has room for 20 updates of 50 ms."""
    now = [0.0]

    def spend(seconds):
        now[0] += seconds

    monkeypatch.setattr(throttle, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=spend))
    train = make_train(total_frames=60, utd_ratio=None, throttle=40.0, warmup_frames=20)
    update = train.learner.update
    train.learner.update = lambda batch: spend(0.05) or update(batch)
    train.run()
    assert now[0] == pytest.approx(60 / 40, abs=0.06)
    assert train.learner.updates == pytest.approx(20, abs=3)


def test_the_share_of_annealing_is_a_share():
    with pytest.raises(ValueError, match=r"anneal is 1.5: expected a number in \[0, 1\]"):
        TrainSettings(total_frames=10, anneal=1.5)
    with pytest.raises(ValueError, match=r"anneal_entropy is 0.0: expected a number in \(0, 1\]"):
        TrainSettings(total_frames=10, anneal_entropy=0.0)


def test_a_resumed_training_evaluates_at_its_own_interval(make_train, tmp_path):
    make_train(tmp_path, total_frames=100, eval_interval=20).run()
    rest = make_train(tmp_path, total_frames=300, eval_interval=60)
    evaluated = []
    rest.evaluate = lambda: evaluated.append(rest.frames) or {"score": 0.0}
    rest.resume(tmp_path)
    rest.run()
    assert evaluated == [120, 180, 240, 300]


def test_a_ratio_of_none_needs_a_throttle():
    with pytest.raises(ValueError, match=r"needs a throttle: set train\.throttle=RATE"):
        TrainSettings(total_frames=1, utd_ratio=None)


def test_replay_holds_raw_style_and_no_copy_of_it(make_train):
    train = make_train(total_frames=100)
    train.run()
    stored = train.replay.storage.get(slice(0, 100))
    assert stored["style"].shape == (100, 1)
    assert ("next", "style") not in stored.keys(True)
    expected = -(stored["next", "style_features"] - stored["style"]).abs()
    assert torch.equal(stored["next", "reward"], expected)


def test_metrics_are_sums_over_episodes(make_train, tmp_path):
    train = make_train(total_frames=200, utd_ratio=0.05, log_interval=0.0)
    train.run()
    with (tmp_path / "run" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frames"]) for row in rows] == sorted(int(row["frames"]) for row in rows)
    lengths = [float(row["episode/length"]) for row in rows if row["episode/length"]]
    assert lengths and max(lengths) <= 20
    for row in rows:
        if row["episode/return"]:
            assert float(row["episode/task_return"]) == 0.0
            assert float(row["episode/return"]) == pytest.approx(float(row["episode/style_return"]))
    counted = sum(int(row["episode/count"]) for row in rows)
    ended = int(train.replay.storage.get(slice(0, 200))["next", "done"].sum())
    assert counted >= ended > 0


def test_evaluation_happens_when_due_and_changes_nothing(make_train, make_echo_env, tmp_path):
    plain = make_train(tmp_path / "plain", total_frames=200, utd_ratio=0.05)
    plain.run()
    calls = []
    train = make_train(tmp_path / "evaluated", total_frames=200, utd_ratio=0.05, eval_interval=50)
    env = make_echo_env(5)

    def evaluate():
        calls.append(train.frames)
        return evaluate_policy(env, train.collector.policy, max_steps=30)

    train.evaluate = evaluate
    metrics = train.run()
    assert calls == [52, 100, 152, 200]  # multiples of 50 rounded up to rounds of 4; the end is one of them
    assert metrics["eval/length"] <= 20
    for name, value in _tensors(plain.learner.state_dict()):
        assert torch.equal(value, dict(_tensors(train.learner.state_dict()))[name]), name


def hold(td):
    return td.set("action", torch.zeros(4, 1))


def test_evaluation_counts_each_episode_once(make_echo_env):
    env = make_echo_env(3)
    env.hold_style(torch.tensor([0.5]))
    result = evaluate_policy(env, hold, max_steps=100)
    assert result["return"] == pytest.approx(-0.5 * result["length"], rel=1e-5)
    assert 0 < result["length"] <= 20


@pytest.mark.parametrize("device", [None, torch.device("cpu")])
def test_evaluations_bring_actions_to_the_environment(make_echo_env, monkeypatch, device):
    env, devices = make_echo_env(3), []
    monkeypatch.setattr(type(env), "device", device)

    def elsewhere(td):
        return SimpleNamespace(to=lambda place: devices.append(str(place)) or hold(td))

    evaluate_policy(env, elsewhere, max_steps=3)
    assert set(devices) == {"cpu"}


def test_an_evaluation_measures_the_style_while_episodes_last(make_echo_env):
    class Measures:
        def step(self, transition):
            return {"theta": transition["style"].squeeze(-1), "never": torch.full((4,), torch.nan)}

        def summarise(self, record, alive):
            means = torch.where(alive, record["theta"], torch.nan).nanmean(0)
            return {"theta": means, "never": record["never"].mean(0), "steps": alive.sum(0).float()}

    env = make_echo_env(3)
    env.hold_style(torch.tensor([0.5]))
    result = evaluate_policy(env, hold, max_steps=100, measures=Measures())
    assert result["theta"] == 0.5
    assert math.isnan(result["never"])
    assert result["steps"] == result["length"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_training_with_a_checkpoint(make_train, tmp_path, number):
    train = make_train(total_frames=10**9)
    before = signal.getsignal(number)
    timer = threading.Timer(0.2, os.kill, (os.getpid(), number))
    timer.start()
    train.run()
    assert signal.getsignal(number) is before
    rest = make_train(total_frames=train.frames + 40)
    rest.resume(tmp_path / "run")
    assert rest.frames == train.frames
    rest.run()


def test_a_failed_checkpoint_does_not_end_the_training(make_train, tmp_path, monkeypatch):
    train = make_train(total_frames=120, checkpoint_interval=0.0)

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("coachable.training.checkpoint.save_state", fail)
    with pytest.warns(UserWarning, match=r"was not written: .*No space left on device.*A previous one is intact"):
        train.run()
    assert train.frames == 120 and not train.saved
    assert not [p for p in (tmp_path / "run" / "checkpoints").iterdir() if p.name != "LATEST"]


def test_no_warning_in_an_ordinary_training(make_train):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_train(total_frames=80).run()


def test_resume_without_a_replay_buffer_warms_up_again(make_train, tmp_path):
    train = make_train(total_frames=120)
    train.checkpoints.replay = False
    train.run()
    rest = make_train(total_frames=200)
    with pytest.warns(UserWarning, match="no replay buffer: updates go on after 40 new env-steps"):
        rest.resume(tmp_path / "run")
    rest.run()
    assert rest.learner.updates - train.learner.updates == (200 - 120 - 40) // 4
