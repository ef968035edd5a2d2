"""What a training tells: metrics in files and at wandb, progress; and the throttle of its rate."""

import io
import json
import resource
import time

import pytest

from coachable.training.logging import MetricsLog, Progress, wandb_logger
from coachable.training.throttle import Throttle


def test_csv_gains_columns_and_forgets_an_abandoned_future(tmp_path):
    log = MetricsLog(tmp_path)
    log.write({"frames": 1, "a": 1.0})
    log.write({"frames": 2, "b": 2.0})
    log.write({"frames": 3, "a": 3.0})
    again = MetricsLog(tmp_path)
    again.rewind(2)
    again.write({"frames": 3, "b": 5.0})
    assert (tmp_path / "metrics.csv").read_text().splitlines() == ["frames,a,b", "1,1.0,", "2,,2.0", "3,,5.0"]


def test_a_full_disk_leaves_the_rows_before_as_they_are(tmp_path):
    log = MetricsLog(tmp_path)
    log.write({"frames": 1, "a": 1.0})
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for row in ({"frames": 2, "a": 0.123456}, {"frames": 3, "another": 1.0}):
        resource.setrlimit(resource.RLIMIT_FSIZE, (log.path.stat().st_size + 3, before[1]))
        try:
            with pytest.raises(OSError):
                log.write(row)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    log.write({"frames": 4, "a": 4.0})
    assert log.path.read_text().splitlines() == ["frames,a", "1,1.0", "4,4.0"]


@pytest.mark.parametrize("torn", ["4,1", "40,1.0,", "40,1.0,2.0", '4"'])
def test_a_line_that_was_not_finished_is_dropped(tmp_path, torn):
    log = MetricsLog(tmp_path)
    log.write({"frames": 1, "a": 1.0, "b": 2.0})
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write(torn)
    again = MetricsLog(tmp_path)
    again.rewind(10)
    again.write({"frames": 5, "a": 3.0})
    assert (tmp_path / "metrics.csv").read_text().splitlines() == ["frames,a,b", "1,1.0,2.0", "5,3.0,"]


def test_progress_tells_rates_and_the_time_to_go(monkeypatch):
    clock = iter([100.0, 160.0])
    monkeypatch.setattr("coachable.training.logging.time.monotonic", lambda: next(clock))
    stream = io.StringIO()
    progress = Progress(9000, stream)
    progress.start(frames=1000, updates=10)
    progress.update(frames=3000, updates=40, metrics={})
    line = json.loads(stream.getvalue())
    assert line["steps_per_s"] == 33.3 and line["updates_per_s"] == 0.5
    assert line["eta_min"] == 3.0  # 6000 steps at 2000 a minute


def test_progress_writes_json_lines_without_a_terminal():
    stream = io.StringIO()
    progress = Progress(100, stream, every=0.0)
    progress.start(0, 0)
    progress.update(50, 5, {"episode/return": 1.23456789})
    line = json.loads(stream.getvalue())
    assert line["frames"] == 50 and line["updates"] == 5 and line["episode/return"] == 1.23457
    assert line["steps_per_s"] > 0 and line["updates_per_s"] > 0 and line["eta_min"] >= 0


def test_a_stream_that_cannot_be_written_ends_no_training():
    class Full(io.StringIO):
        def write(self, text):
            raise OSError(28, "No space left on device")

    progress = Progress(100, Full(), every=0.0)
    progress.start(0, 0)
    progress.update(50, 5, {})
    progress.close()


def test_progress_draws_a_bar_on_a_terminal():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    stream = Terminal()
    progress = Progress(100, stream)
    progress.start(20, 0)
    progress.update(60, 5, {"episode/return": 2.5}, force=True)
    progress.close()
    assert "60.0/100" in stream.getvalue() and "updates/s" in stream.getvalue() and "return 2.5" in stream.getvalue()


def test_throttle_bounds_the_rate():
    throttle = Throttle(100.0)
    start = time.monotonic()
    for _ in range(5):
        throttle.wait()
        throttle.add(10)
    throttle.wait()
    assert time.monotonic() - start >= 0.5 - 0.01
    with pytest.raises(ValueError, match="positive number of env-steps per second"):
        Throttle(0.0)


def test_wandb_is_off_without_a_key(tmp_path, monkeypatch):
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    assert wandb_logger("run", tmp_path) is None
    assert wandb_logger("run", tmp_path, mode="off") is None
    with pytest.raises(ValueError, match="must be one of auto, online, offline, off"):
        wandb_logger("run", tmp_path, mode="on")


@pytest.mark.slow
def test_wandb_has_one_run_per_log(tmp_path, monkeypatch):
    """Such as that of each stage, whose env-steps begin at 0."""
    monkeypatch.setenv("WANDB_MODE", "offline")  # restored afterwards: TorchRL sets it
    monkeypatch.setenv("WANDB_SILENT", "true")
    names = []
    for stage in ("first", "second"):
        log = MetricsLog(tmp_path / stage, wandb_logger(stage, tmp_path / stage, mode="offline"))
        log.write({"frames": 5, "loss": 1.0})
        names.append(log.logger.experiment.name)
        log.close()
    assert names == ["first", "second"]
    assert all(list((tmp_path / name).glob("wandb/offline-run-*")) for name in names)
