"""Learner, loop and a training of the humanoid on an accelerator, in one command.

    python benchmarks/gpu.py                                          a quarter of an hour on a CUDA device
    python benchmarks/gpu.py --device cpu --seconds 2 --minutes 1     the same work on a CPU, as a check of this script

First it measures updates per second of SAC on a batch that stays on the device, for each width, batch size and way of
computing. Then it runs `recipes/humanoid_sac.py preset=gpu` from nothing for some minutes, prints where the time of its
loop went, and measures what the agent does in each style.
"""

import argparse
import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from learner_work import LAYERS, make_batch
from our_learners import sac_learner

from coachable.evaluation.evaluate import evaluate
from coachable.training.hardware import detect

RECIPE = Path(__file__).resolve().parent.parent / "recipes" / "humanoid_sac.py"
WAYS: dict[str, dict[str, Any]] = {
    "fp32": {"precision": "fp32"},
    "bf16": {"precision": "bf16"},
    "fp32, compiled": {"precision": "fp32", "compile": True},
    "bf16, compiled": {"precision": "bf16", "compile": True},
}
LOOP = ("collect", "store", "update", "evaluate", "log", "checkpoint", "wait")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--widths", type=int, nargs="+", default=[256, 512])
    parser.add_argument("--batches", type=int, nargs="+", default=[256, 1024, 4096])
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measurement of the learner (%(default)s)")
    parser.add_argument("--minutes", type=float, default=10.0, help="of the training; 0 for none (%(default)s)")
    parser.add_argument("--episodes", type=int, default=4, help="in each style after the training (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"), help="folder of the training (%(default)s)")
    options = parser.parse_args()
    if options.device.startswith("cuda") and not torch.cuda.is_available():
        sys.exit(f"error: --device {options.device}: torch finds no CUDA device here; --device cpu checks the script")
    print(f"{detect().describe()}; torch {torch.__version__}\n")
    measure_learner(options)
    if options.minutes:
        measure_training(options)


def measure_learner(options: argparse.Namespace) -> None:
    """Print updates per second of the learner alone."""
    print("| updates/s of SAC | " + " | ".join(f"batch {size}" for size in options.batches) + " |")
    print("|-" * (1 + len(options.batches)) + "|")
    for width in options.widths:
        for way in options.ways:
            rates = [updates_per_second(width, size, way, options) for size in options.batches]
            print(f"| {LAYERS} x {width}, {way} | " + " | ".join(f"{rate:.0f}" for rate in rates) + " |", flush=True)
    print()


def updates_per_second(width: int, size: int, way: str, options: argparse.Namespace) -> float:
    """Return the rate of updates, after warm-up and compilation; the device has finished when the clock stops."""
    learner = sac_learner(width, options.device, **WAYS[way])
    batch = make_batch(size).to(options.device)
    for _ in range(5):
        learner.update(batch)
    synchronize(options.device)
    start, updates = time.perf_counter(), 0
    while time.perf_counter() - start < options.seconds:
        for _ in range(20):
            learner.update(batch)
        updates += 20
        synchronize(options.device)
    return updates / (time.perf_counter() - start)


def synchronize(device: str) -> None:
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def measure_training(options: argparse.Namespace) -> None:
    """Train for some minutes as a user does, stop with Ctrl-C, and print the shares of the loop and the styles."""
    run = options.out / time.strftime("%Y-%m-%d_%H-%M-%S")
    command = [sys.executable, str(RECIPE), "preset=gpu", f"device={options.device}", f"run_dir={run}"]
    command += ["train.eval_interval=0", "train.total_frames=1_000_000_000", "train.anneal=0", "train.log_interval=5"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**os.environ, "WANDB_MODE": "offline"}) as training:
        try:
            training.wait(options.minutes * 60)
        except subprocess.TimeoutExpired:
            training.send_signal(signal.SIGINT)  # it saves a checkpoint and ends
    if training.returncode:
        sys.exit(f"error: the training ended with exit status {training.returncode}")
    with (run / "metrics.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    wall = float(last["minutes"]) * 60
    print(f"training: {float(last['frames']):,.0f} env-steps and {float(last['updates']):,.0f} updates in {wall:.0f} s")
    print(f"{float(last['frames']) / wall:.0f} env-steps/s, {float(last['updates']) / wall:.0f} updates/s")
    print("\n| part of the loop | share of wall time |\n|-|-|")
    for part in LOOP:
        print(f"| {part} | {float(last[f'seconds/{part}']) / wall:.1%} |")
    evaluate(str(run), run / "evaluation", episodes=options.episodes, switch_episodes=0)
    print((run / "evaluation" / "report.md").read_text())


if __name__ == "__main__":
    main()
