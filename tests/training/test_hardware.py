"""How a machine is shared and judged, for machines that are made up."""

import itertools
import time

import pytest
import torch

from coachable.training import hardware
from coachable.training.hardware import (
    Hardware,
    Threads,
    choose_preset,
    estimate_update_seconds,
    pick_device,
    share_threads,
)


def machine(cores=12, busy=0.0, gpu=None):
    return Hardware(cores, busy, 16.0, gpu, bf16=False)


@pytest.mark.parametrize(
    ("limit", "cores", "busy", "expected"),
    [
        (None, 12, 0.0, Threads(12, 8)),  # more than eight do not help a learner
        (None, 12, 6.6, Threads(5, 5)),
        (None, 2, 5.0, Threads(1, 1)),
        ("3", 12, 0.0, Threads(12, 3)),
        ("3", 2, 0.0, Threads(2, 2)),
        ("0", 6, 0.0, Threads(6, 6)),  # what OpenMP ignores says nothing
        ("4,2", 6, 0.0, Threads(6, 6)),
        ("", 6, 0.0, Threads(6, 6)),
    ],
)
def test_simulator_and_learner_have_the_free_cores_in_turn(monkeypatch, limit, cores, busy, expected):
    if limit is None:
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    else:
        monkeypatch.setenv("OMP_NUM_THREADS", limit)
    assert share_threads(hardware=machine(cores, busy)) == expected


def test_threads_that_are_asked_for_are_taken_literally(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert share_threads(20, 10, machine(4)) == Threads(20, 10)
    assert share_threads(None, 10, machine(4)) == Threads(4, 10)
    assert share_threads(1, None, machine(4)) == Threads(1, 2)


def test_cores_are_busy_as_far_as_they_work_at_the_moment(monkeypatch, tmp_path):
    """Of three cores, the second waits half of the time for others or a disk, and the third may not be used."""
    stat = tmp_path / "stat"
    stat.write_text("cpu 9 9 9 9\ncpu0 100 0 50 700 0 0 0 0\ncpu1 5 5 0 90 0 0 0 0 0 0\ncpu2 1 0 0 9 0 0 0 0\nintr 7")

    def later(_):
        stat.write_text("cpu 9 9\ncpu0 110 0 50 700 0 0 0 0\ncpu1 6 6 1 93 2 1 0 1 0 0\ncpu2 9 0 0 9 0 0 0 0\nintr 8")

    monkeypatch.setattr(hardware, "_PROC_STAT", stat)
    monkeypatch.setattr(time, "sleep", later)
    assert hardware._busy_cores({0, 1}) == pytest.approx(1.0 + 0.5)


def test_the_load_average_counts_where_the_system_does_not_tell_more(monkeypatch, tmp_path):
    monkeypatch.setattr(hardware, "_PROC_STAT", tmp_path / "none")
    monkeypatch.setattr("os.getloadavg", lambda: (0.7, 0.5, 0.1))
    assert hardware._busy_cores({0}) == 0.7


def test_a_machine_is_described_and_has_its_preset():
    assert choose_preset(machine()) == "cpu"
    assert choose_preset(machine(gpu="H100")) == "gpu"
    assert machine(busy=1.26).describe() == "12 cores (1.3 busy), 16 GB memory, no GPU, no bf16"
    assert Hardware(4, 0.0, 8.0, "H100", bf16=True).describe() == "4 cores (0.0 busy), 8 GB memory, GPU H100, bf16"


def test_an_update_takes_sixteen_products_which_are_half_of_its_time(monkeypatch):
    """Twenty products of 256 rows by a matrix of 512 x 512 take a second on this clock; 3 ms are the calls."""
    ticks, small = itertools.count(), torch.zeros(1, 1)
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(ticks)))
    monkeypatch.setattr(torch, "ones", lambda *_, **__: small)  # so that it need not be waited for
    assert estimate_update_seconds(512 * 512, 256, bf16=False) == pytest.approx(2 * 16 / 20 + 0.003)
    assert estimate_update_seconds(2 * 512 * 512, 64, bf16=True) == pytest.approx(16 / 20 + 0.003)


@pytest.mark.parametrize("name", ["cude", "meta"])
def test_a_device_on_which_nothing_can_be_trained_is_named(name):
    with pytest.raises(ValueError, match=f"device={name}: expected auto, cpu, cuda or cuda:0"):
        pick_device(name)
