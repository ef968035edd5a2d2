"""Training of one recipe with several seeds, side by side in processes of their own, and a table of the results."""

import ctypes
import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from coachable.evaluation.curves import metrics_files, read_metric
from coachable.evaluation.many_agents import side_by_side, table_of
from coachable.outputs import complete_file
from coachable.training.checkpoint import CheckpointError, find_checkpoint, read_state
from coachable.training.hardware import detect, share_threads

_PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>
_COUNTED = ("frames", "updates", "minutes")  # from the start of each stage
_SHOWN = (*_COUNTED, "episode/return", "eval/return")


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of a list such as "0,1,2".

    Raises:
        ValueError: If an entry is not a whole number of at least 0, or repeats.

    Example:
        >>> parse_seeds("0,1,2")
        [0, 1, 2]
    """
    entries = text.split(",")
    if not all(entry.strip().isdecimal() for entry in entries) or len(set(map(int, entries))) < len(entries):
        raise ValueError(f"seeds={text}: expected different whole numbers, such as seeds=0,1,2")
    return [int(entry) for entry in entries]


def train_seeds(script: Path, arguments: Sequence[str], seeds: Sequence[int], folder: Path) -> dict[int, str]:
    """Train a recipe with several seeds and arguments KEY=VALUE, as many side by side as there are free cores.

    The training with seed S writes to `folder/seed_S`, and what it prints to `folder/seed_S.log`. One that has ended is
    not trained again, and one that was interrupted is continued with the settings that it had.

    Returns:
        What is wrong with the trainings that did not end, by seed.

    Raises:
        ValueError: If the folder holds trainings with other arguments.
    """
    record = folder / "arguments.json"
    if not record.exists():
        with complete_file(record) as unfinished:
            unfinished.write_text(json.dumps([*arguments]), encoding="utf-8")
    said = json.loads(record.read_text(encoding="utf-8"))
    if sorted(said) != sorted(arguments):
        raise ValueError(
            f"{folder} holds trainings with {' '.join(map(str, said)) or 'no settings'}: "
            "expected the same settings, or another folder with run_dir=PATH"
        )
    hardware = detect()
    at_once = min(len(seeds), hardware.free)
    share = share_threads(hardware=replace(hardware, cores=hardware.free // at_once, busy=0.0))
    given = {argument.split("=")[0] for argument in arguments}
    threads = [f"{key}={n}" for part, n in asdict(share).items() if (key := f"threads.{part}") not in given]
    waiting = [seed for seed in seeds if not _has_ended(folder / f"seed_{seed}")]
    running: dict[int, subprocess.Popen[bytes]] = {}
    failed: dict[int, str] = {}
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                seed = waiting.pop(0)
                running[seed] = _start(script, [*arguments, *threads], seed, folder)
            for seed in [seed for seed, process in running.items() if process.poll() is not None]:
                if code := running.pop(seed).returncode:
                    failed[seed] = _why_ended(code, folder / f"seed_{seed}.log")
            time.sleep(0.2)
    except KeyboardInterrupt:  # reaches the trainings, too, which save a checkpoint
        for process in running.values():
            process.wait()
    unfinished = [seed for seed in seeds if seed not in failed and not _has_ended(folder / f"seed_{seed}")]
    return failed | dict.fromkeys(unfinished, "interrupted: the same command continues")


def seed_table(folder: Path, seeds: Sequence[int], failed: Mapping[int, str]) -> str:
    """Return the last metrics of the trainings of `train_seeds`, with their mean and standard deviation, as a table."""
    last = {f"seed {seed}": {name: _last(folder / f"seed_{seed}", name) for name in _SHOWN} for seed in seeds}
    return table_of(side_by_side(last), ".6g") + "".join(f"seed {seed}: {why}\n" for seed, why in failed.items())


def _start(script: Path, arguments: Sequence[str], seed: int, folder: Path) -> "subprocess.Popen[bytes]":
    run = folder / f"seed_{seed}"
    try:
        find_checkpoint(run)
        chosen = [f"resume={run}"]
    except CheckpointError:
        chosen = [*arguments, f"seed={seed}", f"run_dir={run}"]
    with (folder / f"seed_{seed}.log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, str(script), *chosen],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            preexec_fn=_stop_with_parent,
        )


def _stop_with_parent() -> None:
    """Ask for SIGTERM, which saves a checkpoint, when the process that started this one is killed."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _has_ended(run: Path) -> bool:
    try:
        state = read_state(find_checkpoint(run))
    except CheckpointError:
        return False
    config = state["config"]
    is_last = not config.get("stages") or config["stages"][-1]["stage"] == config["stage"]
    return is_last and state["loop"]["frames"] >= config["train"]["total_frames"]


def _last(run: Path, name: str) -> float:
    if not metrics_files(run):
        return math.nan
    try:
        if name in _COUNTED:
            return float(read_metric(run, name, name)[0][-1])
        return float(read_metric(run, "frames", name)[1][-1])
    except ValueError:  # there is no such column, or no row has it
        return math.nan


def _why_ended(code: int, log: Path) -> str:
    if code < 0:
        return f"ended by {signal.Signals(-code).name}, see {log}: the same command continues"
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "it ended without printing anything"
