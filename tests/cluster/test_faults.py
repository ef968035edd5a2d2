"""Collection on a Ray cluster of several local nodes whose workers and nodes are killed."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from coachable.cluster import ClusterError
from coachable.cluster.flat_weights import flat_weights, load_flat_weights, portable_copy
from coachable.training.checkpoint import find_checkpoint, read_state
from tests.cluster.workers_of_tests import NUM_ENVS, STEPS, Watch, cluster_train

pytestmark = [pytest.mark.ray, pytest.mark.filterwarnings("ignore:a Ray worker was lost")]

one_or_two = pytest.mark.parametrize("group_size", [1, 2])


def is_alive(pid):
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


def wait_for_end(pids, seconds=60.0):
    end = time.monotonic() + seconds
    while any(map(is_alive, pids)) and time.monotonic() < end:
        time.sleep(0.1)
    return [pid for pid in pids if is_alive(pid)]


def end(watch):
    watch.train.settings = dataclasses.replace(watch.train.settings, total_frames=1)


def end_after_restart(watch):
    if any(restart for _, restart in watch.serials()):
        end(watch)


def end_after_forty_of_both(watch):
    if len(watch.batches) >= 40 and len(set(watch.numbers("worker"))) == 2:
        end(watch)


@one_or_two
def test_every_batch_comes_with_the_weights_of_its_version(cluster, tmp_path, group_size):
    train = cluster_train(tmp_path, group_size=group_size, total_frames=10**6)
    actor, weights = train.learner.loss_module.actor_network, {0: None}
    offer = train.collector.workers.offer

    def keep(version, offered):
        weights[version] = flat_weights(offered)
        offer(version, offered)

    train.collector.workers.offer = keep
    watch = Watch(train, end_after_forty_of_both)
    latest = train.run()
    assert train.frames // 10 - 2 <= train.learner.updates <= train.frames // 10  # 0.1 per env-step after the warm-up
    assert set(watch.numbers("restart")) == {0}
    versions = watch.numbers("version")
    assert len(set(versions)) > 5 and max(versions) > 20
    copy = portable_copy(actor)
    for data, version in zip(watch.batches, versions, strict=True):
        load_flat_weights(copy, weights[version])
        with torch.no_grad():
            expected = copy[0](data.reshape(-1).select(*copy[0].in_keys))["loc"]
        torch.testing.assert_close(expected, data.reshape(-1)["loc"], rtol=1e-4, atol=1e-5)
    assert 0.0 < latest["workers/staleness"] < train.learner.updates and latest["workers/restarts"] == 0
    watch.require_nothing_lost()
    watch.require_sums_within_trajectories()


def test_batches_of_one_worker_that_wait_together_are_stored_in_order(cluster, tmp_path):
    train = cluster_train(tmp_path)
    watch = Watch(train, lambda watch: time.sleep(0.5))  # in which each worker fills its share of the queue
    latest = train.run()
    assert latest["workers/queue"] >= 2
    watch.require_nothing_lost()
    watch.require_sums_within_trajectories()


@one_or_two
def test_workers_killed_in_the_middle_of_a_batch_are_replaced(cluster, tmp_path, group_size):
    killed = []

    def kill(watch):
        replaced = [serials for key, serials in watch.serials().items() if key[1] == 1 and len(serials) > 3]
        if len(replaced) == 2:
            end(watch)
        elif len(killed) < 2 and watch.numbers("worker").count(len(killed)) >= 5:
            killed.append(watch.train.collector.workers.slots[len(killed)].pid)
            time.sleep(0.02)  # of the 0.05 s that a batch takes
            os.kill(killed[-1], signal.SIGKILL)

    train = cluster_train(tmp_path, total_frames=10**6, group_size=group_size)
    watch = Watch(train, kill)
    latest = train.run()
    assert latest["workers/restarts"] == 2
    watch.require_nothing_lost()
    watch.require_sums_within_trajectories()
    assert not wait_for_end(killed)


@one_or_two
def test_an_error_in_one_worker_and_its_replacement(cluster, tmp_path, group_size):
    train = cluster_train(tmp_path, "raise", total_frames=10**6, group_size=group_size)

    watch = Watch(train, end_after_restart)
    with pytest.warns(
        UserWarning, match="worker was lost: worker .*: ZeroDivisionError: the pole has no length. It is st"
    ):
        train.run()
    watch.require_nothing_lost()
    watch.require_sums_within_trajectories()


@one_or_two
def test_nobody_waits_for_a_slow_worker_and_one_that_never_answers_is_replaced(cluster, tmp_path, group_size):
    (tmp_path / "slow").mkdir()
    (tmp_path / "hang").mkdir()
    train = cluster_train(tmp_path / "slow", "slow", total_frames=600, group_size=group_size)
    watch = Watch(train)
    train.run()
    counts = sorted(len(serials) for serials in watch.serials().values())
    assert len(counts) == 1 or counts[0] < counts[1] / 3
    watch.require_nothing_lost()

    def lose_patience(watch):
        workers = watch.train.collector.workers  # starts may take long on a busy machine
        workers.patience = 20.0 if len(watch.serials()) == 2 and not workers.restarts else 600.0
        end_after_restart(watch)

    train = cluster_train(tmp_path / "hang", "hang", total_frames=10**6, group_size=group_size)
    watch = Watch(train, lose_patience)
    with pytest.warns(UserWarning, match=r"it did not answer for 10 s \(see collector\.patience\)"):
        train.run()
    watch.require_nothing_lost()


def test_a_node_is_removed_and_another_added(cluster, tmp_path):
    train = cluster_train(tmp_path, total_frames=10**6)
    events = []

    def change(watch):
        workers = watch.train.collector.workers
        if not events and len(watch.serials()) == 2 and len(watch.batches) > 10:
            events.append("removed")
            cluster.remove()
        elif events == ["removed"] and workers.restarts and len(watch.batches) > 40:
            assert workers.alive() >= 1, "the run goes on with the one that is left"
            events.append("added")
            cluster.add()
        elif events == ["removed", "added"]:
            end_after_restart(watch)

    watch = Watch(train, change)
    train.run()
    assert events == ["removed", "added"]
    watch.require_nothing_lost()
    watch.require_sums_within_trajectories()


def test_a_full_object_store_stops_nobody(cluster, tmp_path):
    import numpy as np
    import ray

    train = cluster_train(tmp_path)
    held = [ray.put(np.ones(40 * 2**20, np.uint8)) for _ in range(4)]  # twice what the store of a node holds
    watch = Watch(train)
    train.run()
    assert 400 <= train.frames <= 400 + 2 * NUM_ENVS * STEPS and len(held) == 4
    watch.require_nothing_lost()


def test_without_any_worker_the_training_ends_with_one_sentence_and_its_checkpoint(cluster, tmp_path):
    def break_all(watch):
        if len(watch.batches) >= 20:
            (tmp_path / "all_fail").touch()
            watch.train.collector.workers.patience = 10.0

    train = cluster_train(tmp_path, "all", total_frames=10**6, checkpoint_interval=0.0)
    watch = Watch(train, break_all)
    with pytest.raises(
        ClusterError,
        match=r"^no Ray worker delivered a batch for 10 s \(collector.patience\); worker \d on .*: ZeroDivisionError: "
        r"the pole has no length. The training stopped at env-step \d+, without another checkpoint.$",
    ):
        train.run()
    assert read_state(find_checkpoint(tmp_path / "run"))["loop"]["frames"] == train.frames
    watch.require_nothing_lost()


def parent(pid):
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def test_a_group_whose_actor_is_killed_starts_again(cluster, tmp_path):
    killed = []

    def kill(watch):
        if not killed and len(watch.serials()) == 2:
            killed.extend(slot.pid for slot in watch.train.collector.workers.slots)
            actors = {parent(parent(pid)) for pid in killed}  # below it is the process that forks
            assert len(actors) == 1
            killed.extend(actors)
            os.kill(killed[-1], signal.SIGKILL)
        elif {(0, 1), (1, 1)} <= set(watch.serials()):
            end(watch)

    train = cluster_train(tmp_path, total_frames=10**6, group_size=2)
    watch = Watch(train, kill)
    latest = train.run()
    assert latest["workers/restarts"] == 2
    watch.require_nothing_lost()
    watch.require_sums_within_trajectories()
    assert not wait_for_end(killed), "workers end with their actor"


def test_an_error_of_all_workers_at_once_is_told_at_once(cluster, tmp_path):
    train = cluster_train(tmp_path, "raise always", patience=10_000.0)
    with pytest.raises(ClusterError, match=r"every Ray worker fails before its first batch; worker .* has no length"):
        train.run()


LEARNER = """
import sys, warnings
from pathlib import Path
from tests.cluster.workers_of_tests import Watch, cluster_train
warnings.simplefilter("ignore")
folder = Path(sys.argv[1])
options = {"address": sys.argv[2], "group_size": int(sys.argv[3])}
train = cluster_train(folder, total_frames=10**6, checkpoint_interval=0.0, **options)

def tell(watch):
    pids = [slot.pid for slot in watch.train.collector.workers.slots]
    if len(watch.batches) >= 20 and not (folder / "pids").exists():  # checkpoints were written before
        (folder / "pids.partial").write_text(" ".join(map(str, pids)))
        (folder / "pids.partial").rename(folder / "pids")

Watch(train, tell)
train.run()
"""


@one_or_two
def test_a_killed_learner_resumes_from_its_checkpoint(cluster, tmp_path, group_size):
    command = [sys.executable, "-c", LEARNER, str(tmp_path), cluster.address, str(group_size)]
    with subprocess.Popen(command, cwd=Path(__file__).parents[2]) as learner:
        while not (tmp_path / "pids").exists() and learner.poll() is None:
            time.sleep(0.1)
        learner.kill()
    pids = [int(pid) for pid in (tmp_path / "pids").read_text().split()]
    assert len(pids) == 2
    assert not wait_for_end([pid for pid in pids if pid]), "workers do not outlive their learner"
    train = cluster_train(tmp_path, group_size=group_size)
    with pytest.warns(UserWarning, match="episodes of echo are not restored: environments in other processes"):
        train.resume(tmp_path / "run")
    frames, updates = train.frames, train.learner.updates
    assert frames > 0 and updates > 0
    train.settings = type(train.settings)(total_frames=frames + 200, utd_ratio=0.1)
    watch = Watch(train)
    train.run()
    assert train.frames >= frames + 200 and train.learner.updates > updates
    assert min(watch.numbers("restart")) >= 1, "the workers draw other random numbers than before"
    assert min(watch.numbers("version")) >= updates
