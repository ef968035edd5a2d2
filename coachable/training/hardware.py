"""Detection of the hardware, and its division between simulator and learner."""

import os
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from coachable.training.precision import supports_bf16

_MAX_LEARNER_THREADS = 8  # 512-wide layers do not fill more cores; the barriers cost more than they bring
_SAMPLE_SECONDS = 0.1  # over which the cores are watched
_PROC_STAT = Path("/proc/stat")


@dataclass(frozen=True)
class Hardware:
    """Hardware that a training can use.

    Attributes:
        cores: Number of cores that this process may use.
        busy: How many of these cores other processes keep busy at the moment; the system load of the last minute where
            the system does not tell [cores].
        memory_gb: Physical memory [GB], or 0 if it cannot be read.
        gpu: Name of the first CUDA device, or None.
        bf16: Whether the GPU, or without one the CPU, multiplies bfloat16 matrices in hardware.
    """

    cores: int
    busy: float
    memory_gb: float
    gpu: str | None
    bf16: bool

    @property
    def free(self) -> int:
        """Number of cores that are not busy, at least 1."""
        return max(1, self.cores - round(self.busy))

    def describe(self) -> str:
        """Return a one-line description."""
        device = f"GPU {self.gpu}" if self.gpu else "no GPU"
        bf16 = "bf16" if self.bf16 else "no bf16"
        return f"{self.cores} cores ({self.busy:.1f} busy), {self.memory_gb:.0f} GB memory, {device}, {bf16}"


@dataclass(frozen=True)
class Threads:
    """Numbers of threads of the simulator and of the learner."""

    simulator: int
    learner: int


def detect() -> Hardware:
    """Return the cores, load, memory, GPU and bfloat16 support of this machine.

    Example:
        >>> detect().cores >= 1
        True
    """
    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    affinity = getattr(os, "sched_getaffinity", None)  # missing on macOS and Windows
    usable = affinity(0) if affinity else set(range(os.cpu_count() or 1))
    return Hardware(
        cores=len(usable),
        busy=_busy_cores(usable),
        memory_gb=_memory_gb(),
        gpu=gpu,
        bf16=supports_bf16("cuda" if gpu else "cpu"),
    )


def choose_preset(hardware: Hardware) -> str:
    """Return the name of the preset for a machine: `gpu` if it has a CUDA device, otherwise `cpu`."""
    return "gpu" if hardware.gpu else "cpu"


def pick_device(name: str = "auto") -> torch.device:
    """Return a configured device, with an index if it is a CUDA device.

    Args:
        name: "auto" (CUDA if available), "cpu", "cuda" or a device with an index such as "cuda:1".

    Raises:
        ValueError: If the device is neither the CPU nor a CUDA device, or a CUDA device is named and none is available.

    Example:
        >>> pick_device("cpu")
        device(type='cpu')
    """
    try:
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise ValueError(f"device={name}: expected auto, cpu, cuda or cuda:0")
    if device.type == "cpu":
        return device
    if not torch.cuda.is_available():
        raise ValueError(
            f"device={name} but torch finds no CUDA device here: set device=cpu, or choose a preset for CPU cores "
            "(--help lists them)"
        )
    # TorchRL treats "cuda" and "cuda:0" as different devices, and would copy the policy from one to the other.
    return torch.device("cuda", torch.cuda.current_device() if device.index is None else device.index)


def share_threads(
    simulator: int | None = None, learner: int | None = None, hardware: Hardware | None = None
) -> Threads:
    """Return the thread counts of simulator and learner.

    Simulator and learner take turns in one process, so each may use all free cores. More threads than free cores slow
    a training down by a factor of ten, because OpenMP's barriers spin.

    Args:
        simulator: Threads for physics; None for one per free core.
        learner: Threads for updates; None for one per free core, at most 8 and at most `OMP_NUM_THREADS`.
        hardware: From `detect`; None calls it.

    Raises:
        ValueError: If a count is below 1.

    Example:
        >>> share_threads(2, 1)
        Threads(simulator=2, learner=1)
    """
    for name, value in (("simulator", simulator), ("learner", learner)):
        if value is not None and value < 1:
            raise ValueError(f"threads.{name} must be at least 1 or null (automatic), got {value}")
    if simulator is not None and learner is not None:
        return Threads(simulator, learner)
    hardware = hardware or detect()
    free = hardware.free
    limit = os.environ.get("OMP_NUM_THREADS", "")
    wanted = int(limit) if limit.isdigit() and int(limit) > 0 else free
    return Threads(simulator=simulator or free, learner=learner or max(1, min(wanted, free, _MAX_LEARNER_THREADS)))


def estimate_update_seconds(parameters: int, batch_size: int, bf16: bool, device: torch.device | str = "cpu") -> float:
    """Estimate the duration of one actor-critic update from a short matrix product on this machine.

    An update multiplies by a network's weights about 16 times (forward, backward to weights and backward to inputs,
    over policy, twin critics and twin targets). At width 512 these products take half of its time (measured); layer
    norms and small calls take the rest.

    The result [s] is correct to a factor of about two; `parameters` is the number of weights of one network.
    """
    device = torch.device(device)
    dtype = torch.bfloat16 if bf16 else torch.float32
    a = torch.ones(256, 512, dtype=dtype, device=device)
    b = torch.ones(512, 512, dtype=dtype, device=device)
    repeats, best = 20, float("inf")
    for _ in range(4):  # the first rounds include start-up costs, so the best one counts
        start = time.perf_counter()
        for _ in range(repeats):
            torch.mm(a, b)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        best = min(best, (time.perf_counter() - start) / repeats)
    operations = 16 * 2 * batch_size * parameters
    overhead = 0.003  # about 2-3 ms of Python per update, whatever its size (measured)
    return 2 * operations * best / (2 * 256 * 512 * 512) + overhead


def _busy_cores(usable: set[int]) -> float:
    """Return how many of some cores are busy. The load average would still count a training that has just ended."""
    if not _PROC_STAT.exists():
        return os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    before = _core_seconds()
    time.sleep(_SAMPLE_SECONDS)
    shares = []
    for core, (busy, total) in _core_seconds().items():
        if core in usable and core in before:
            busy, total = busy - before[core][0], total - before[core][1]
            shares.append(busy / total if total > 0 else 0.0)
    return sum(shares)


def _core_seconds() -> dict[int, tuple[float, float]]:
    """Return the time that each core was busy, and that time and the idle time together, in the system's unit."""
    found = {}
    for line in _PROC_STAT.read_text(encoding="utf-8").splitlines():
        name, *counts = line.split()
        if name.startswith("cpu") and name != "cpu":
            times = [float(count) for count in counts[:8]]  # user, nice, system, idle, iowait, irq, softirq, steal
            found[int(name[3:])] = (sum(times) - sum(times[3:5]), sum(times))
    return found


def _memory_gb() -> float:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (ValueError, OSError):
        return 0.0
