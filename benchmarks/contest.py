"""Contestants that do the same work in turn, so that other load affects all of them equally.

Each of them is a process of its own.
"""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

HERE = Path(__file__).resolve().parent


def thread_settings(threads: int) -> dict[str, str]:
    """Environment variables of a contestant's process: threads of OpenMP, MKL and XLA, and where this package lies."""
    return {
        "OMP_NUM_THREADS": str(threads),
        "MKL_NUM_THREADS": str(threads),
        "XLA_FLAGS": "" if threads > 1 else "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(HERE.parent),
    }


def processor() -> str:
    """Return the processor's name and its family and model, which tell apart what shares a name."""
    try:
        lines = [line.split(":") for line in Path("/proc/cpuinfo").read_text().splitlines() if ":" in line]
    except OSError:
        return platform.processor()
    known = {key.strip(): value.strip() for key, value in reversed(lines)}
    return f"{known.get('model name', platform.processor())}, family {known.get('cpu family')}, {known.get('model')}"


def cpu_seconds(pid: int) -> float:
    """Return the processor time of a process, 0 if it has ended [s]."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Worker:
    """A contestant's process: `python SCRIPT NAME`, fed with numbers of rounds, answering with seconds.

    Args:
        script: file in this folder whose `main(name)` calls `serve`.
        name: contestant.
        python: interpreter, of the peers' environment for some.
        threads: of OpenMP, MKL and XLA.
    """

    def __init__(self, script: str, name: str, python: str, threads: int) -> None:
        self.name = name
        env = os.environ | thread_settings(threads)
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = subprocess.Popen([python, str(HERE / script), name], env=env, text=True, **pipes)

    def ready(self) -> bool:
        """Return whether it could be set up; if not, write the reason to stderr."""
        if self.process.stdout.readline().strip() == "ready":
            return True
        error = self.process.stderr.read().strip().splitlines()[-1:]
        sys.stderr.write(f"{self.name} is left out: {' '.join(error)}\n")
        return False

    def run(self, work: int) -> dict[str, float]:
        """Do `work` units and return the CPU and wall seconds."""
        self.process.stdin.write(f"{work}\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait(300)  # on a busy machine leaving takes long


def measure(workers: list[Worker], rounds: int, work: Mapping[str, int] | int) -> dict[str, list[dict[str, float]]]:
    """Return the seconds per unit of work of each contestant, which take turns; one entry per round."""
    contestants = [worker for worker in workers if worker.ready()]
    times = {worker.name: [] for worker in contestants}
    for _ in range(rounds):
        for worker in contestants:
            units = work if isinstance(work, int) else work[worker.name]
            times[worker.name].append({clock: spent / units for clock, spent in worker.run(units).items()})
    for worker in contestants:
        worker.close()
    return times


def serve(contestants: Mapping[str, Callable[[], Callable[[int], None]]], name: str, warmup: int) -> None:
    """The other end: set the contestant up, warm it up, then work as told until the input ends."""
    out = os.fdopen(os.dup(1), "w")  # packages that print on import must not disturb the protocol
    os.dup2(2, 1)
    run = contestants[name]()
    run(warmup)
    out.write("ready\n")
    out.flush()
    for line in sys.stdin:
        cpu, wall = time.process_time(), time.perf_counter()
        run(int(line))
        out.write(json.dumps({"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}) + "\n")
        out.flush()
