"""Signals to a training on Ray whose workers have not sent anything yet."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from coachable.training.checkpoint import find_checkpoint, read_state
from tests.cluster.test_faults import wait_for_end
from tests.cluster.workers_of_tests import cluster_train

pytestmark = pytest.mark.ray

RESUMED = """
import sys, warnings
from pathlib import Path
from tests.cluster.workers_of_tests import cluster_train
warnings.simplefilter("ignore")
folder = Path(sys.argv[1])
train = cluster_train(folder, "start", total_frames=10**6, group_size=int(sys.argv[2]), cpus_per_worker=0.5)
train.resume(folder / "run")
train.run()
"""


@pytest.mark.parametrize(("number", "group_size"), [(signal.SIGTERM, 2), (signal.SIGINT, 1)], ids=["term", "ctrl_c"])
def test_a_signal_before_the_first_batch_ends_the_training(cluster, tmp_path, number, group_size):
    train = cluster_train(tmp_path)
    train.run()
    command = [sys.executable, "-c", RESUMED, str(tmp_path), str(group_size)]
    with subprocess.Popen(command, cwd=Path(__file__).parents[2], start_new_session=True) as learner:
        while len(started := list(tmp_path.glob("started_*"))) < 2 and learner.poll() is None:
            time.sleep(0.1)
        os.killpg(learner.pid, number)  # as a terminal does
    assert len(started) == 2 and learner.returncode == 0
    workers = [int(file.name.removeprefix("started_")) for file in started]
    assert not wait_for_end(workers), "workers do not outlive their learner"
    state = read_state(find_checkpoint(tmp_path / "run"))
    assert state["loop"]["frames"] == train.frames
