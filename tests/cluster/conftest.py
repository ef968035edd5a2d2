"""A Ray cluster of three local nodes, on two of which workers may run."""

import os
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


class LocalCluster:
    """A head without cores, and nodes with two cores and an object store of 80 MB each."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster

        self.ray = Cluster()
        self.nodes = []
        self.ray.add_node(num_cpus=0, object_store_memory=80 * 2**20, include_dashboard=False)
        for _ in range(2):
            self.add()

    @property
    def address(self):
        return self.ray.address

    def add(self, **options):
        self.nodes.append(self.ray.add_node(num_cpus=2, object_store_memory=80 * 2**20, **options))
        return self.nodes[-1]

    def remove(self, node=None):
        node = node or self.nodes[0]
        self.nodes.remove(node)
        self.ray.remove_node(node, allow_graceful=False)


@pytest.fixture(scope="session")
def running_cluster():
    ray = pytest.importorskip("ray")
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory(prefix="ray_", dir="/tmp") as folder:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(ROOT / "recipes")]))
        patch.setenv("RAY_AUTH_MODE", "disabled")
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")  # with Ray's 15 workers get nothing while all cores are busy
        patch.setenv("RAY_TMPDIR", folder)
        cluster = LocalCluster()
        patch.setenv("RAY_ADDRESS", cluster.address)
        yield cluster
        ray.shutdown()
        cluster.ray.shutdown()


@pytest.fixture
def cluster(running_cluster):
    """The cluster, with two nodes for workers."""
    while len(running_cluster.nodes) < 2:
        running_cluster.add()
    return running_cluster
