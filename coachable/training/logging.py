"""Logging of metrics to a CSV file and, on request, to Weights & Biases, and a progress display."""

import contextlib
import csv
import io
import json
import math
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from tqdm import tqdm

from coachable.files import CheckpointError

_MOVE = "Move it away to go on with a new one"


class MetricsLog:
    """Log that writes rows of metrics to a CSV file, to which columns can be added, and to an optional TorchRL logger.

    Rows are appended to an existing file. An incomplete last line, which a process leaves behind if it is killed while
    writing, is dropped.

    Args:
        run_dir: Folder of `metrics.csv`, created if missing.
        logger: TorchRL logger with `log_metrics`, or None.

    Example:
        >>> import tempfile
        >>> log = MetricsLog(Path(tempfile.mkdtemp()))
        >>> log.write({"frames": 1, "loss": 0.5})
        >>> log.write({"frames": 2, "reward": 1.0})
        >>> log.path.read_text().splitlines()
        ['frames,loss,reward', '1,0.5,', '2,,1.0']
    """

    def __init__(self, run_dir: Path | str, logger: Any | None = None) -> None:
        Path(run_dir).mkdir(parents=True, exist_ok=True)
        self.path = Path(run_dir) / "metrics.csv"
        self.logger = logger
        self.columns: list[str] = []
        rows = self._read()
        if self.path.exists() and self.path.read_bytes()[-1:] not in (b"", b"\n"):
            self._rewrite(rows)

    def rewind(self, frames: int) -> None:
        """Drop the rows after `frames` env-steps, which a resumed training writes again.

        Raises:
            CheckpointError: If an entry of the column `frames` is not a number, or the file is not a table.
        """
        rows = self._read()
        try:
            kept = [row for row in rows if float(row.get("frames") or 0) <= frames]
        except ValueError as error:
            raise CheckpointError(f"{self.path} is damaged: {error} in 'frames'. {_MOVE}") from error
        if len(kept) < len(rows):
            self._rewrite(kept)

    def write(self, row: Mapping[str, float]) -> None:
        """Append one row.

        Args:
            row: Numbers by name, with the number of env-steps so far as "frames"; new names become new columns.

        Raises:
            OSError: If the row cannot be written; the file is as before.
        """
        new = [name for name in row if name not in self.columns]
        if new:
            rows = self._read()
            self._rewrite(rows, [*self.columns, *new])
        text = io.StringIO()
        writer = csv.DictWriter(text, self.columns, restval="", lineterminator="\n")
        writer.writerow({k: _short(v) for k, v in row.items()})
        size = self.path.stat().st_size
        try:
            with self.path.open("a", newline="", encoding="utf-8") as file:
                file.write(text.getvalue())
        except OSError:  # a full disk
            os.truncate(self.path, size)
            raise
        if self.logger is not None:
            finite = {k: float(v) for k, v in row.items() if math.isfinite(v)}
            self.logger.log_metrics(finite, step=int(row["frames"]))

    def close(self) -> None:
        """End the logger's run, so that the next one, such as that of the next stage, is another."""
        if self.logger is not None:
            self.logger.shutdown()

    def _read(self) -> list[dict[str, Any]]:
        if not self.path.exists():
            return []
        try:
            with self.path.open(newline="", encoding="utf-8") as file:
                reader = csv.DictReader(line for line in file if line.endswith("\n"))
                self.columns = list(reader.fieldnames or [])
                return list(reader)
        except (UnicodeDecodeError, csv.Error) as error:
            raise CheckpointError(f"{self.path} is not a table of metrics: {error}. {_MOVE}") from error

    def _rewrite(self, rows: list[dict[str, Any]], columns: list[str] | None = None) -> None:
        columns = self.columns if columns is None else columns
        partial = self.path.with_name(self.path.name + ".partial")
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, restval="", lineterminator="\n", extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
        os.replace(partial, self.path)
        self.columns = columns


def wandb_logger(name: str, run_dir: Path, *, project: str = "coachable", mode: str = "auto") -> Any | None:
    """Return TorchRL's `WandbLogger`, or None if it is switched off.

    Args:
        name: Name of the run.
        run_dir: Folder of the run; W&B's files are written to `run_dir/wandb`.
        project: W&B project.
        mode: "online", "offline" or "off"; "auto" means "online" if `WANDB_API_KEY` is set, otherwise "off".

    Raises:
        ValueError: If the mode is unknown.
    """
    modes = ("auto", "online", "offline", "off")
    if mode not in modes:
        raise ValueError(f"wandb.mode must be one of {', '.join(modes)}, got {mode!r}")
    if mode == "off" or (mode == "auto" and not os.environ.get("WANDB_API_KEY")):
        return None
    from torchrl.record.loggers.wandb import WandbLogger

    return WandbLogger(exp_name=name, offline=mode == "offline", save_dir=str(run_dir), project=project)


class Progress:
    """Progress display: a tqdm bar on a terminal, otherwise one JSON line per minute.

    Args:
        total: Number of env-steps of the whole training.
        stream: Stream to write to; None for standard error.
        every: Time between JSON lines [s].
    """

    def __init__(self, total: int, stream: TextIO | None = None, every: float = 60.0) -> None:
        self.stream = stream or sys.stderr
        self.total = total
        self.every = every
        self._bar: Any | None = None
        self._last = 0.0
        self._then = (0.0, 0, 0)

    def start(self, frames: int, updates: int) -> None:
        """Start the display of a training that has made some env-steps and updates already."""
        self._last = time.monotonic()
        self._then = (self._last, frames, updates)
        if self.stream.isatty():
            self._bar = tqdm(total=self.total, initial=frames, unit="step", unit_scale=True, file=self.stream)

    def update(self, frames: int, updates: int, metrics: Mapping[str, float], *, force: bool = False) -> None:
        """Show how far the training is, and some metrics; `force` does so even if the last line is recent."""
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(frames - self._bar.n)
            if force or now - self._last >= 1.0:
                self._last = now
                rates = self._rate(now, frames, updates)
                self._bar.set_postfix_str(", ".join([f"{rates['updates_per_s']:.0f} updates/s", *_pretty(metrics)]))
            return
        if force or now - self._last >= self.every:
            self._last = now
            line = {"frames": frames, "updates": updates, **self._rate(now, frames, updates)}
            line |= {k: _short(v) for k, v in metrics.items()}
            with contextlib.suppress(OSError):  # a full disk or a closed pipe must not end a training
                self.stream.write(json.dumps(line) + "\n")
                self.stream.flush()

    def close(self) -> None:
        """Close the bar."""
        if self._bar is not None:
            self._bar.close()

    def _rate(self, now: float, frames: int, updates: int) -> dict[str, float]:
        then, frames_then, updates_then = self._then
        seconds = max(now - then, 1e-9)
        steps_per_s = (frames - frames_then) / seconds
        self._then = (now, frames, updates)
        rates = {"steps_per_s": round(steps_per_s, 1), "updates_per_s": round((updates - updates_then) / seconds, 1)}
        if steps_per_s > 0:
            rates["eta_min"] = round(max(0, self.total - frames) / steps_per_s / 60, 1)
        return rates


def _short(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else str(value)
    return value


def _pretty(metrics: Mapping[str, float]) -> list[str]:
    wanted = ("episode/return", "episode/length", "eval/return")
    return [f"{k.split('/')[-1]} {metrics[k]:.1f}" for k in wanted if k in metrics]
