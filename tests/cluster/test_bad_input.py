"""What collection on Ray refuses, in one sentence that names the setting, before training starts."""

import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule

from coachable.cluster import ClusterCollector, ClusterError
from coachable.cluster.connection import Connection
from coachable.code_version import code_version

ROOT = Path(__file__).resolve().parents[2]


def collector(make_env=lambda seed: None, **options):
    actor = TensorDictModule(torch.nn.Linear(1, 1), in_keys=["observation"], out_keys=["action"])
    return ClusterCollector(make_env, actor, **{"frames_per_batch": 4, "num_collectors": 2, **options})


def test_without_ray_the_error_names_the_extra(monkeypatch):
    monkeypatch.setattr("coachable.cluster.connection.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"collector=ray needs Ray: pip install 'coachable\[cluster\]'"):
        collector()


def test_an_environment_that_cannot_be_pickled():
    lock = threading.Lock()
    with pytest.raises(ClusterError, match=r"cannot send make_env and the policy to its workers: TypeError: .*lock"):
        collector(lambda seed: lock)


def test_a_throttle_that_patience_cannot_wait_for():
    with pytest.raises(ValueError, match=r"collector\.patience=10: a batch of 16 env-steps takes 3\.2 s at"):
        collector(worker_throttle=5.0, patience=10.0)


@pytest.mark.ray
def test_no_cluster_at_the_address(monkeypatch):
    pytest.importorskip("ray")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    for wrong, reason in (
        (address, "no Ray cluster answers there"),
        ("nowhere", "no Ray cluster answers there"),
        ("ray://127.0.0.1:10001", "expected auto, or HOST:PORT"),
    ):
        with pytest.raises(ClusterError, match=f"^collector.address={wrong}: {reason}"):
            collector(address=wrong)


@pytest.mark.ray
def test_fewer_cores_than_workers(cluster):
    with pytest.raises(
        ClusterError,
        match=r"^collector.num_collectors=9 with collector.cpus_per_worker=0.5 need 4.5 cores: the cluster has 4; ",
    ):
        collector(num_collectors=9, cpus_per_worker=0.5)


@pytest.mark.ray
def test_a_group_that_is_larger_than_every_node(cluster):
    with pytest.raises(
        ClusterError,
        match=r"^collector.group_size=3 with collector.cpus_per_worker=1 needs 3 cores of one node: the largest has 2$",
    ):
        collector(num_collectors=4, group_size=3)


@pytest.mark.ray
def test_a_node_with_another_coachable(cluster, tmp_path):
    """The node's processes find a changed copy of the package first."""
    other = tmp_path / "other"
    shutil.copytree(ROOT / "coachable", other / "coachable", ignore=shutil.ignore_patterns("__pycache__", "*.pt"))
    with (other / "coachable" / "keys.py").open("a") as file:
        file.write("# changed\n")
    node = cluster.add(env_vars={"PYTHONPATH": str(other)})
    try:
        # In a folder without the package: Ray's processes look into the driver's folder first.
        connect = "from coachable.cluster.connection import Connection; Connection(None, 1, 1.0, 120.0)"
        ended = subprocess.run([sys.executable, "-c", connect], cwd=tmp_path, capture_output=True, text=True)
    finally:
        cluster.remove(node)
    said = ended.stderr.strip().splitlines()[-1]
    assert re.search(r"ClusterError: collector=ray: node .* has Python .*, the learner has ", said), ended.stderr
    assert said.endswith(f"{code_version()}: expected the same on every node")


@pytest.mark.ray
def test_a_node_that_does_not_answer(cluster):
    import ray

    with pytest.raises(ClusterError, match=r"^collector.patience=0.01: node .* does not answer within this time"):
        Connection(None, 1, 1.0, 0.01)
    assert not ray.is_initialized()


@pytest.mark.ray
def test_a_node_that_has_just_left_is_not_asked(cluster):
    cluster.remove()  # Ray still counts it for a moment
    Connection(None, 1, 1.0, 60.0).close()


def shared_memory():
    """Files in shared memory, without the semaphores of other programs."""
    return {name for name in os.listdir("/dev/shm") if not name.startswith("sem.")}


@pytest.mark.ray
def test_a_local_ray_leaves_nothing_behind(monkeypatch, tmp_path):
    pytest.importorskip("ray")
    import tempfile

    psutil = pytest.importorskip("psutil")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with tempfile.TemporaryDirectory(prefix="r", dir="/tmp") as folder:  # sockets need a short path
        monkeypatch.setattr(tempfile, "tempdir", folder)
        killed = Path(folder) / "coachable_ray_4194305_x"  # above the largest number of a process
        killed.mkdir()
        shared = shared_memory()
        here = psutil.Process()
        before = set(here.children(recursive=True))
        connection = Connection(None, 1, 0.1, 60.0)
        assert not killed.exists() and len(os.listdir(folder)) == 1
        started = set(here.children(recursive=True)) - before
        assert started
        niceness = connection.ray.remote(lambda: os.nice(0)).options(num_cpus=0.1).remote()
        assert connection.ray.get(niceness) == os.nice(0), "workers are not slower than the learner's other processes"
        connection.close()
        psutil.wait_procs(started, timeout=30.0)
        assert not set(here.children(recursive=True)) - before
        assert os.listdir(folder) == [] and shared_memory() <= shared
