"""Where a training's numbers go: a CSV file always, Weights & Biases on request, and a progress line."""

import csv
import json
import math
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from tqdm import tqdm

__all__ = ["CsvLog", "MetricsLog", "Progress", "wandb_logger"]


class CsvLog:
    """Rows of numbers in one CSV file that may gain columns.

    Args:
        path: the file; rows are appended when it exists.
        resume_at: rows whose `key` exceeds this are dropped first: they belong to a course of events that a resumed
            training leaves behind.
        key: column that orders the rows.

    Example:
        >>> import tempfile
        >>> log = CsvLog(Path(tempfile.mkdtemp()) / "metrics.csv")
        >>> log.write({"frames": 1, "loss": 0.5})
        >>> log.write({"frames": 2, "reward": 1.0})
        >>> log.path.read_text().splitlines()
        ['frames,loss,reward', '1,0.5,', '2,,1.0']
    """

    def __init__(self, path: Path, resume_at: int | None = None, key: str = "frames") -> None:
        self.path = Path(path)
        self.columns: list[str] = []
        if self.path.exists():
            with self.path.open(newline="", encoding="utf-8") as file:
                reader = csv.DictReader(file)
                self.columns = list(reader.fieldnames or [])
                rows = list(reader)
            if resume_at is not None:
                kept = [row for row in rows if float(row.get(key) or 0) <= resume_at]
                if len(kept) < len(rows):
                    self._rewrite(kept)

    def write(self, row: Mapping[str, Any]) -> None:
        """Appends one row; unknown names become new columns."""
        new = [name for name in row if name not in self.columns]
        if new:
            rows: list[dict[str, Any]] = []
            if self.path.exists() and self.columns:
                with self.path.open(newline="", encoding="utf-8") as file:
                    rows = list(csv.DictReader(file))
            self.columns += new
            self._rewrite(rows)
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self.columns, restval="", lineterminator="\n").writerow(row)

    def _rewrite(self, rows: list[dict[str, Any]]) -> None:
        partial = self.path.with_name(self.path.name + ".partial")
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self.columns, restval="", lineterminator="\n", extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
        os.replace(partial, self.path)


def wandb_logger(name: str, run_dir: Path, *, project: str = "coachable", mode: str = "auto") -> Any | None:
    """Makes TorchRL's `WandbLogger`, or None when it is switched off.

    Args:
        name: name of the run.
        run_dir: W&B's files go to `run_dir/wandb`.
        project: W&B project.
        mode: "auto" logs online when `WANDB_API_KEY` is set and not at all otherwise; "online", "offline" and "off" say
            so.

    Raises:
        ValueError: for any other mode.
    """
    modes = ("auto", "online", "offline", "off")
    if mode not in modes:
        raise ValueError(f"wandb.mode must be one of {', '.join(modes)}, got {mode!r}")
    has_key = bool(os.environ.get("WANDB_API_KEY"))
    if mode == "off" or (mode == "auto" and not has_key):
        return None
    from torchrl.record.loggers.wandb import WandbLogger

    return WandbLogger(exp_name=name, offline=mode == "offline" or not has_key, save_dir=str(run_dir), project=project)


class MetricsLog:
    """Sends every row of metrics to the CSV file and, where there is one, to a TorchRL logger.

    Args:
        run_dir: `metrics.csv` is written here.
        logger: a TorchRL logger with `log_metrics` or `log_scalar`, or None.
        resume_at: frame count of the checkpoint that is resumed (see `CsvLog`).
    """

    def __init__(self, run_dir: Path, logger: Any | None = None, resume_at: int | None = None) -> None:
        self.csv = CsvLog(Path(run_dir) / "metrics.csv", resume_at)
        self.logger = logger

    def write(self, row: Mapping[str, float], step: int) -> None:
        """Logs one row.

        Args:
            row: name -> number.
            step: env-steps so far.
        """
        self.csv.write({k: _short(v) for k, v in row.items()})
        if self.logger is not None:
            finite = {k: float(v) for k, v in row.items() if math.isfinite(v)}
            self.logger.log_metrics(finite, step=step)


class Progress:
    """A tqdm bar on a terminal, otherwise one JSON line per minute.

    Args:
        total: env-steps of the whole training.
        initial: env-steps already done.
        stream: where to write, standard error by default.
        every: [s] between JSON lines.
    """

    def __init__(self, total: int, initial: int = 0, stream: TextIO | None = None, every: float = 60.0) -> None:
        self.stream = stream or sys.stderr
        self.total = total
        self.every = every
        self._start = self._last = time.monotonic()
        self._initial = initial
        self._rates = (self._start, initial, None)
        self._bar = (
            tqdm(total=total, initial=initial, unit="step", unit_scale=True, file=self.stream, smoothing=0.05)
            if self.stream.isatty()
            else None
        )

    def update(self, frames: int, updates: int, metrics: Mapping[str, float], *, force: bool = False) -> None:
        """Shows where the training is.

        Args:
            frames: env-steps so far.
            updates: learner updates so far.
            metrics: shown beside it.
            force: write the JSON line even if the last one is recent.
        """
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(frames - self._bar.n)
            if force or now - self._last >= 1.0:
                rates = self._rate(now, frames, updates)
                self._bar.set_postfix_str(", ".join([f"{rates['updates_per_s']:.0f} updates/s", *_pretty(metrics)]))
            return
        if force or now - self._last >= self.every:
            self._last = now
            line = {"frames": frames, "updates": updates, **self._rate(now, frames, updates)}
            line |= {k: _short(v) for k, v in metrics.items()}
            self.stream.write(json.dumps(line) + "\n")
            self.stream.flush()

    def close(self) -> None:
        """Ends the bar's line."""
        if self._bar is not None:
            self._bar.close()

    def _rate(self, now: float, frames: int, updates: int) -> dict[str, float]:
        then, frames_then, updates_then = self._rates
        seconds = max(now - then, 1e-9)
        steps_per_s = (frames - frames_then) / seconds
        updates_per_s = 0.0 if updates_then is None else (updates - updates_then) / seconds
        self._rates = (now, frames, updates)
        eta = (self.total - frames) / steps_per_s if steps_per_s > 0 else float("inf")
        return {
            "steps_per_s": round(steps_per_s, 1),
            "updates_per_s": round(updates_per_s, 1),
            "eta_min": round(eta / 60, 1) if math.isfinite(eta) else -1.0,
        }


def _short(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else str(value)
    return value


def _pretty(metrics: Mapping[str, float]) -> list[str]:
    wanted = ("episode/return", "episode/length", "eval/return")
    return [f"{k.split('/')[-1]} {metrics[k]:.1f}" for k in wanted if k in metrics]
