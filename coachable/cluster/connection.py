"""Connection to Ray: start it here or join a cluster, and check that the workers can run there."""

import contextlib
import logging
import os
import shutil
import socket
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from coachable.code_version import code_version
from coachable.extras import how_to_install
from coachable.training.worker_errors import WorkerError

_STORE = 512 * 2**20  # [bytes] of the object store that is started here; weights and batches take a few MB
_ANSWER = 5.0  # [s] for the address of a cluster to accept a connection
_FOLDER = "coachable_ray_"


class ClusterError(WorkerError):
    """Ray or its workers cannot be used; the message names the setting to change."""


class Connection:
    """Connection of this process to Ray, which starts a local Ray unless it is given the address of a cluster.

    If this process is connected to Ray already, that connection is used and left open.

    Args:
        address: HOST:PORT of a cluster, "auto" for the one that runs on this host, or None for the environment
            variable `RAY_ADDRESS` and without it a local Ray, which ends with this connection.
        num_workers: Number of workers.
        cpus_per_worker: Number of cores that each worker reserves.
        patience: Time for a node to answer [s].
        group_size: Number of workers that have to be on the same node.

    Raises:
        ImportError: If Ray is not installed.
        ClusterError: If no cluster answers, it has too few cores, or a node has other code.
    """

    def __init__(
        self, address: str | None, num_workers: int, cpus_per_worker: float, patience: float, group_size: int = 1
    ) -> None:
        if find_spec("ray") is None:
            raise ImportError(f"collector=ray needs Ray: {how_to_install('cluster')}, or choose collector=process")
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports its use over the network otherwise
        import ray

        self.ray: Any = ray
        self._folder: str | None = None
        self._is_ours = not ray.is_initialized()
        if self._is_ours:  # what a lost worker raises is reported as a warning; Ray would print its traceback as well
            os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")
        address = address or os.environ.get("RAY_ADDRESS")
        try:
            if self._is_ours and address:
                self._join(address)
            elif self._is_ours:
                self._start()
            self._check_cores(num_workers, cpus_per_worker, group_size)
            if self._folder is None:  # a Ray that was started here runs the code of this process
                self._check_code(patience)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the connection, and with it a local Ray and its files."""
        if self._is_ours:
            self.ray.shutdown()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._is_ours, self._folder = False, None

    def starts_at_once(self) -> int:
        """Return the number of workers that may start at the same time: one per core of the cluster, at least two."""
        return max(2, int(self.ray.cluster_resources().get("CPU", 0.0)))

    def _start(self) -> None:
        _remove_leftovers()
        self._folder = tempfile.mkdtemp(prefix=f"{_FOLDER}{os.getpid()}_")
        try:
            self._init(
                object_store_memory=_STORE,
                include_dashboard=False,
                _temp_dir=self._folder,
                _system_config={"worker_niceness": 0},  # Ray's 15 starves workers where all cores are busy
            )
        except Exception as error:  # Ray raises many types here, plain `Exception` among them
            raise ClusterError(f"collector=ray: Ray does not start on this host: {_last_line(error)}") from error

    def _join(self, address: str) -> None:
        said = f"collector.address={address}"
        if "://" in address:
            raise ClusterError(
                f"{said}: expected auto, or HOST:PORT of a cluster that this host has joined (ray start)"
            )
        host, _, port = address.rpartition(":")
        if address != "auto":
            try:
                socket.create_connection((host, int(port)), _ANSWER).close()
            except (OSError, ValueError) as error:
                raise ClusterError(f"{said}: no Ray cluster answers there ({error}). {_HOW_TO_START}") from None
        try:
            self._init(address=address)
        except Exception as error:  # see `_start`
            raise ClusterError(f"{said}: cannot join this cluster: {_last_line(error)}. {_HOW_TO_START}") from error

    def _init(self, **options: Any) -> None:
        self.ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)

    def _check_cores(self, num_workers: int, cpus_per_worker: float, group_size: int) -> None:
        cores, needed = self.ray.cluster_resources().get("CPU", 0.0), num_workers * cpus_per_worker
        if cores + 1e-6 < needed:
            raise ClusterError(
                f"collector.num_collectors={num_workers} with collector.cpus_per_worker={cpus_per_worker:g} need "
                f"{needed:g} cores: the cluster has {cores:g}; expected fewer workers, or a share of a core for each"
            )
        largest = max(node["Resources"].get("CPU", 0.0) for node in self.ray.nodes() if node["Alive"])
        if largest + 1e-6 < group_size * cpus_per_worker:
            raise ClusterError(
                f"collector.group_size={group_size} with collector.cpus_per_worker={cpus_per_worker:g} needs "
                f"{group_size * cpus_per_worker:g} cores of one node: the largest has {largest:g}"
            )

    def _check_code(self, patience: float) -> None:
        """Compare Python and coachable on every node that may get a worker."""
        expected = code_version()
        nodes = [node for node in self.ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]
        asked = {}
        for node in nodes:
            there = self.ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            task = self.ray.remote(code_version).options(num_cpus=0, scheduling_strategy=there, max_retries=0)
            asked[node["NodeID"], node["NodeManagerHostname"], node["NodeManagerAddress"]] = task.remote()
        self.ray.wait([*asked.values(), self.ray.put(None)], num_returns=len(asked) + 1, timeout=patience)
        for (_, name, address), reference in asked.items():
            try:
                found = self.ray.get(reference, timeout=0)
            except self.ray.exceptions.GetTimeoutError:
                raise ClusterError(
                    f"collector.patience={patience:g}: node {name} ({address}) does not answer within this time"
                ) from None
            except self.ray.exceptions.TaskUnschedulableError:  # the node has left the cluster meanwhile
                continue
            except self.ray.exceptions.RayError as error:
                raise ClusterError(
                    f"collector=ray: node {name} ({address}) cannot run coachable: {_last_line(error)}"
                ) from None
            if found != expected:
                raise ClusterError(
                    f"collector=ray: node {name} ({address}) has {found}, the learner has {expected}: expected the "
                    "same on every node"
                )


_HOW_TO_START = "Start one with: ray start --head; or set collector.address=null to start Ray on this host"


def _last_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1].rstrip(".") if lines else type(error).__name__


def _remove_leftovers() -> None:
    """Remove the folders of local Rays whose learner was killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_FOLDER}*_*"):
        number = folder.name.removeprefix(_FOLDER).partition("_")[0]
        with contextlib.suppress(OSError):
            if number.isdigit() and folder.stat().st_uid == os.getuid() and not Path(f"/proc/{number}").exists():
                shutil.rmtree(folder, ignore_errors=True)
