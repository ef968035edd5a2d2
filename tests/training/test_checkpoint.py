"""Checkpoints: atomic, pickle-free, pruned, refused with a reason; and the files made from them."""

import fcntl
import json
import os
import signal

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from coachable.distributions.hl_gauss import HLGauss
from coachable.files import save_state
from coachable.replay import EventTableBuffer, KeyEvents
from coachable.replay.replay_files import read_replay, write_replay
from coachable.styles import Setpoint, StyleSpace
from coachable.styles.samplers import PointMass, Uniform
from coachable.training.checkpoint import (
    CheckpointError,
    CheckpointStore,
    check_writable,
    claim_folder,
    find_checkpoint,
    read_state,
)
from coachable.training.rng import preserved_rng, rng_state, seed_everything, set_rng_state
from coachable.training.weights import export_weights, initialise_from, load_policy


def _buffer(capacity=10):
    return TensorDictReplayBuffer(storage=LazyTensorStorage(capacity))


def _records(start, stop):
    value = torch.arange(start, stop)
    return TensorDict(
        {"a": value.float()[:, None].expand(-1, 3), "next": {"done": value % 2 == 0}}, batch_size=[stop - start]
    )


def test_store_keeps_the_newest_and_their_pointer(tmp_path):
    store = CheckpointStore(tmp_path, keep=2)
    replay = _buffer()
    replay.extend(_records(0, 4))
    for frames in (100, 200, 300):
        store.save({"x": torch.tensor(frames)}, {"frames": frames}, replay)
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["LATEST", "frames_000000000200", "frames_000000000300"]
    assert find_checkpoint(tmp_path).name == "frames_000000000300"
    assert not (tmp_path / "frames_000000000200" / "replay").exists(), "only the newest holds the replay buffer"
    assert (tmp_path / "frames_000000000300" / "replay").is_dir()
    assert read_state(find_checkpoint(tmp_path))["x"] == 300
    assert json.loads((tmp_path / "frames_000000000300" / "metadata.json").read_text())["frames"] == 300


def test_a_run_that_went_back_in_frames_resumes_where_it_last_was(tmp_path):
    store = CheckpointStore(tmp_path, keep=3)
    for frames in (300, 100, 100):
        store.save({"x": frames}, {"frames": frames})
    assert find_checkpoint(tmp_path).name == "frames_000000000100-2"
    (tmp_path / "LATEST").unlink()
    assert find_checkpoint(tmp_path).name == "frames_000000000100-2"
    (tmp_path / "LATEST").write_text("frames_of_old\n")
    assert find_checkpoint(tmp_path).name == "frames_000000000100-2"


@pytest.mark.parametrize("fails_at", ["torch.save", "os.rename", "os.fsync"])
def test_a_failed_write_leaves_the_previous_checkpoint_and_no_partial(tmp_path, monkeypatch, fails_at):
    store = CheckpointStore(tmp_path)
    store.save({"x": 1}, {"frames": 1})

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(fails_at, fail)
        with pytest.warns(UserWarning, match="checkpoint at 2 frames was not written"):
            assert store.try_save({"x": 2}, {"frames": 2}) is None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["LATEST", "frames_000000000001"]
    assert read_state(find_checkpoint(tmp_path))["x"] == 1


def test_a_full_disk_is_one_sentence_with_the_space_needed(make_train, tmp_path, monkeypatch):
    """Every write to /dev/full fails as on a full disk; torch's zip writer reports that in its own way."""
    make_train(total_frames=80).run()
    full = tmp_path / "full"
    os.symlink("/dev/full", full)
    monkeypatch.setattr("coachable.training.checkpoint.save_state", lambda state, _: save_state(state, full))
    monkeypatch.setattr("coachable.training.weights.save_state", lambda state, _: save_state(state, full))
    sentence = r"^cannot write \S+: it needs about 4\.0 MB, [\d,.]+ MB are free \([^()]+\)$"
    store = CheckpointStore(tmp_path)
    with pytest.raises(OSError, match=sentence):
        store.save({"x": torch.zeros(1_000_000)}, {"frames": 1})
    with pytest.warns(
        UserWarning, match="checkpoint at 1 frames was not written: cannot write .* it needs about 4.0 MB"
    ):
        assert store.try_save({"x": torch.zeros(1_000_000)}, {"frames": 1}) is None
    with pytest.raises(OSError, match=r"^cannot write \S+: it needs about 0\.0 MB"):
        export_weights(tmp_path / "run", tmp_path / "weights" / "weights.pt")
    assert list((tmp_path / "weights").iterdir()) == []
    monkeypatch.undo()
    assert store.save({"x": 1}, {"frames": 1}).is_dir()


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_kill_during_a_write_leaves_the_previous_checkpoint(tmp_path, monkeypatch):
    """The process is killed in the middle of writing the second checkpoint, with half of it on disk."""
    store = CheckpointStore(tmp_path)
    store.save({"x": 1}, {"frames": 1})

    def killed(state, file):
        file.write_bytes(b"half of a checkpoint")
        os.kill(os.getpid(), signal.SIGKILL)

    child = os.fork()
    if child == 0:
        try:
            monkeypatch.setattr("coachable.training.checkpoint.save_state", killed)
            store.save({"x": 2}, {"frames": 2})
        finally:
            os._exit(1)
    status = os.waitpid(child, 0)[1]
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
    assert list(tmp_path.glob(".*.partial")), "the kill left a partial behind"
    assert read_state(find_checkpoint(tmp_path))["x"] == 1
    CheckpointStore(tmp_path).save({"x": 3}, {"frames": 3})
    assert not list(tmp_path.glob(".*.partial")), "the next write cleans up"


def test_pickles_are_refused(tmp_path):
    class Harmful:
        def __reduce__(self):
            return (os.system, ("true",))

    file = tmp_path / "state.pt"
    torch.save({"schema": 1, "x": Harmful()}, file)
    with pytest.raises(CheckpointError, match="cannot read"):
        read_state(tmp_path)


def test_other_schemas_and_missing_files_are_named(tmp_path):
    torch.save({"schema": 99}, tmp_path / "state.pt")
    with pytest.raises(CheckpointError, match="has schema 99, this version of coachable reads schema 1"):
        read_state(tmp_path)
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        find_checkpoint(tmp_path / "nowhere")


def test_replay_files_restore_a_wrapped_ring_buffer(tmp_path):
    replay = _buffer(10)
    replay.extend(_records(0, 8))
    replay.extend(_records(8, 13))  # overwrites the three oldest
    write_replay(replay, tmp_path / "replay")
    again = _buffer(10)
    assert read_replay(again, tmp_path / "replay") == 10
    assert again.storage.get(slice(0, 10))["a"][:, 0].tolist() == [10, 11, 12, 3, 4, 5, 6, 7, 8, 9]
    assert again.storage.get(slice(0, 10))["next", "done"].dtype == torch.bool
    for buffer in (replay, again):
        buffer.extend(_records(13, 14))
    assert (replay.storage.get(slice(0, 10)) == again.storage.get(slice(0, 10))).all()
    torch.manual_seed(0)
    first = replay.sample(6)
    torch.manual_seed(0)
    assert (again.sample(6) == first).all()


def test_replay_files_hold_only_what_is_filled(tmp_path):
    replay = _buffer(1_000_000)
    replay.extend(_records(0, 5))
    write_replay(replay, tmp_path / "replay")
    assert np.load(tmp_path / "replay" / "a.npy", allow_pickle=False).shape == (5, 3)
    assert sum(f.stat().st_size for f in (tmp_path / "replay").iterdir()) < 10_000
    with pytest.raises(CheckpointError, match="holds 1000000 records, this run's 10"):
        read_replay(_buffer(10), tmp_path / "replay")


@pytest.mark.parametrize("version", [None, 1, 3])
def test_records_of_another_version_are_refused(tmp_path, version):
    replay = _buffer(10)
    replay.extend(_records(0, 5))
    write_replay(replay, tmp_path)
    index = json.loads((tmp_path / "index.json").read_text())
    (tmp_path / "index.json").write_text(json.dumps({**index, "version": version}))
    with pytest.raises(CheckpointError, match=f"it has version {version}, expected 2"):
        read_replay(_buffer(10), tmp_path)


def test_generators_are_restored_without_pickle(tmp_path):
    import random

    def draw():
        return random.random(), np.random.rand(), torch.rand(1).item(), random.gauss(0, 1), np.random.randn()  # noqa: NPY002

    seed_everything(3)
    draw()
    torch.save(rng_state(), tmp_path / "rng.pt")
    expected = draw()
    set_rng_state(torch.load(tmp_path / "rng.pt", weights_only=True))
    with preserved_rng():
        draw()
    assert draw() == expected


def test_unwritable_and_full_folders_are_named_before_the_start(tmp_path):
    file = tmp_path / "file"
    file.write_text("in the way")
    with pytest.raises(CheckpointError, match=r"cannot write to .*Choose another folder with run_dir=PATH"):
        check_writable(file / "run")
    with pytest.raises(CheckpointError, match=r"MB free, checkpoints need about 1,000,000,000,000 MB"):
        check_writable(tmp_path, required_bytes=10**18)
    check_writable(tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []


def test_a_folder_that_another_process_writes_to_is_refused(tmp_path):
    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    with pytest.raises(CheckpointError, match=r"another training is writing to .*run_dir=PATH"):
        claim_folder(tmp_path)
    os.close(descriptor)
    claim_folder(tmp_path)
    claim_folder(tmp_path)
    descriptor = os.open(tmp_path, os.O_RDONLY)
    with pytest.raises(BlockingIOError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(descriptor)


def test_another_style_space_is_refused_with_the_difference(make_train, tmp_path):
    make_train(total_frames=80).run()
    other = StyleSpace([Setpoint("target", -0.8, 0.5)], name="echo")
    with pytest.raises(CheckpointError, match=r"another style space: .*target"):
        make_train(total_frames=80, space=other).resume(tmp_path / "run")


def test_another_help_text_is_no_other_style_space(make_train, tmp_path):
    make_train(total_frames=80).run()
    reworded = StyleSpace([Setpoint("target", -0.8, 0.8, help="what to do")], name="echo")
    make_train(total_frames=80, space=reworded).resume(tmp_path / "run")


def test_another_network_is_refused_with_the_shapes(make_train, tmp_path):
    make_train(total_frames=80).run()
    with pytest.raises(CheckpointError, match=r"the actor of .*weight is \(16, 4\) in the checkpoint, \(24, 4\) here"):
        make_train(total_frames=80, width=24).resume(tmp_path / "run")


def test_policies_load_from_runs_checkpoints_and_weights(make_train, make_echo_env, echo_space, tmp_path):
    train = make_train(total_frames=120)
    train.run()
    td = make_echo_env(1).reset()
    expected = train.collector.policy(td.clone())["loc"]
    weights = export_weights(tmp_path / "run", tmp_path / "shipped" / "weights.pt")
    assert weights.stat().st_size < 50_000
    actions = []
    for source in (tmp_path / "run", find_checkpoint(tmp_path / "run"), weights):
        policy = load_policy(source)
        assert policy.space == echo_space
        assert policy.config["seed"] == 0
        assert policy.metadata["domain"] == "echo" and policy.metadata["frames"] == 120
        assert policy.metadata["updates"] == train.learner.updates
        assert not policy.actor.training and not any(p.requires_grad for p in policy.actor.parameters())
        actions.append(policy.actor(td.clone())["loc"])
    assert torch.equal(actions[0], actions[1]) and torch.equal(actions[0], actions[2])
    assert torch.equal(expected, actions[0])


def test_unknown_policies_are_named(tmp_path):
    with pytest.raises(CheckpointError, match=r"no checkpoint at nonsense.*domains with weights"):
        load_policy("nonsense")
    torch.save({"schema": 1, "actor": {}}, tmp_path / "weights.pt")
    with pytest.raises(CheckpointError, match="lacks domain, space, config, network, critics"):
        load_policy(tmp_path / "weights.pt")


def test_a_file_cannot_choose_what_is_called(make_train, tmp_path):
    make_train(total_frames=80).run()
    state = torch.load(find_checkpoint(tmp_path / "run") / "state.pt", weights_only=True)
    state["network"]["actor"]["_target_"] = "os.system"
    torch.save(state, tmp_path / "harmful.pt")
    with pytest.raises(CheckpointError, match=r"names 'os\.system' as its network: expected coachable\.networks\."):
        load_policy(tmp_path / "harmful.pt")


def test_a_policy_with_other_bounds_of_actions_is_refused(make_train, tmp_path):
    make_train(total_frames=80).run()
    state = torch.load(find_checkpoint(tmp_path / "run") / "state.pt", weights_only=True)
    state["network"]["actor"] |= {"low": -2.0, "high": 2.0}
    torch.save(state, tmp_path / "wide.pt")
    with pytest.raises(CheckpointError, match=r"a network that cannot be used: .*'low'"):
        load_policy(tmp_path / "wide.pt")


def test_weights_name_no_path_of_the_machine_that_trained(make_train, tmp_path):
    train = make_train(total_frames=120)
    describe, paths = (
        train.describe,
        {"run_dir": "/my/run", "resume": "/my/run", "init_from": "/my/other"},
    )
    train.describe = lambda: describe() | {"config": {"seed": 0, **paths, "stages": [{"seed": 0, **paths}]}}
    train.run()
    config = load_policy(export_weights(tmp_path / "run", tmp_path / "weights.pt")).config
    none = {"seed": 0, "run_dir": None, "resume": None, "init_from": None}
    assert config == none | {"stages": [none]}


def test_initialise_from_copies_actor_critics_and_targets(make_train, echo_space, tmp_path):
    first = make_train(total_frames=120)
    first.run()
    weights = export_weights(tmp_path / "run", tmp_path / "weights.pt")
    second = make_train(tmp_path / "second", total_frames=120, seed=5)
    loss = second.learner.loss_module
    initialise_from(weights, second.collector.policy, loss, echo_space)
    trained, fresh = first.learner.loss_module.state_dict(), loss.state_dict()
    for name, value in trained.items():
        if name.startswith(("actor_network_params.", "qvalue_network_params.")):
            assert torch.equal(value, fresh[name]), name
        if name.startswith("qvalue_network_params."):
            assert torch.equal(value, fresh["target_" + name]), name
    assert second.learner.updates == 0
    second.run()
    assert second.learner.updates > 0
    # The styles of the new training may be drawn in another way, but must mean the same.
    initialise_from(weights, second.collector.policy, loss, echo_space.with_sampler(PointMass([0.0])))
    wider = StyleSpace([Setpoint("target", -9.0, 9.0)], Uniform([6.0], [9.0]), name="echo")
    with pytest.raises(CheckpointError, match=r"was trained on another style space: .*target"):
        initialise_from(weights, second.collector.policy, loss, wider)


def test_initialise_from_refuses_critics_of_another_support(make_train, echo_space, tmp_path):
    train = make_train(total_frames=40)
    describe = train.describe
    train.describe = lambda: describe() | {"config": {"loss": {"v_min": -50.0, "v_max": 650.0}}}
    train.run()
    loss = train.learner.loss_module
    loss.bins = HLGauss(-50.0, 650.0, 51)
    initialise_from(tmp_path / "run", train.collector.policy, loss, echo_space)
    loss.bins = HLGauss(-500.0, 1000.0, 51)
    with pytest.raises(CheckpointError, match=r"in \[-50.0, 650.0\], those of this training in \[-500.0, 1000.0\]"):
        initialise_from(tmp_path / "run", train.collector.policy, loss, echo_space)


def test_weights_name_no_place_on_the_machine_that_trained(make_train, tmp_path):
    make_train(total_frames=80).run()
    weights = export_weights(tmp_path / "run", tmp_path / "weights.pt")
    assert str(tmp_path).encode() not in weights.read_bytes()
    assert read_state(weights)["config"]["run_dir"] is None


def test_replay_files_restore_event_tables(tmp_path):
    """Tables, their cursors, the running windows and the buffer's own generator."""

    def make():
        return EventTableBuffer(
            {"default": 30, "hit": 6},
            events=KeyEvents(["hit"]),
            event_horizon=3,
            num_envs=1,
            batch_size=8,
            generator=torch.Generator().manual_seed(5),
        )

    def steps(start, stop):
        time = torch.arange(start, stop)
        done = torch.zeros(len(time), 1, dtype=torch.bool)
        return TensorDict({"t": time, "next": {"done": done, "events": (time % 7 == 0)[:, None]}}, [len(time)])

    replay, again = make(), make()
    replay.extend(steps(0, 50))
    replay.sample()
    write_replay(replay, tmp_path / "replay")
    read_replay(again, tmp_path / "replay")
    for buffer in (replay, again):
        buffer.extend(steps(50, 57))  # an event whose window began before the files were written
    for name in ("default", "hit"):
        assert torch.equal(replay.table(name)["t"], again.table(name)["t"])
    assert torch.equal(replay.sample()["t"], again.sample()["t"])
