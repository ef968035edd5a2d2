"""What this machine offers to a training, and how it is shared between simulator and learner."""

import os
import time
from dataclasses import dataclass

import torch

from coachable.training.precision import supports_bf16

__all__ = ["Hardware", "Threads", "choose_preset", "detect", "estimate_update_seconds", "pick_device", "share_threads"]

_MAX_LEARNER_THREADS = 8  # 512-wide layers do not fill more cores; the barriers cost more than they bring


@dataclass(frozen=True)
class Hardware:
    """What was found.

    Attributes:
        cores: cores that this process may use.
        busy: cores' worth of load by others in the last minute.
        memory_gb: physical memory [GB], 0 where it cannot be read.
        gpu: name of the first CUDA device, or None.
        bf16: whether bfloat16 matrix products run in hardware on the device that would be used.
    """

    cores: int
    busy: float
    memory_gb: float
    gpu: str | None
    bf16: bool

    def describe(self) -> str:
        """Names the hardware in one line."""
        device = f"GPU {self.gpu}" if self.gpu else "no GPU"
        bf16 = "bf16" if self.bf16 else "no bf16"
        return f"{self.cores} cores ({self.busy:.1f} busy), {self.memory_gb:.0f} GB memory, {device}, {bf16}"


@dataclass(frozen=True)
class Threads:
    """How many threads the simulator and the learner get."""

    simulator: int
    learner: int


def detect() -> Hardware:
    """Looks at cores, load, memory, GPU and bfloat16 support.

    Example:
        >>> detect().cores >= 1
        True
    """
    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    return Hardware(
        cores=_usable_cores(),
        busy=os.getloadavg()[0],
        memory_gb=_memory_gb(),
        gpu=gpu,
        bf16=supports_bf16("cuda" if gpu else "cpu"),
    )


def choose_preset(hardware: Hardware) -> str:
    """Picks the preset for a machine: `gpu` where CUDA works, else `cpu`."""
    return "gpu" if hardware.gpu else "cpu"


def pick_device(name: str = "auto") -> torch.device:
    """Turns a configured device into one with an index.

    Args:
        name: "auto" (CUDA where there is one), "cpu", "cuda" or "cuda:1".

    Raises:
        ValueError: if CUDA is asked for and there is none.

    Example:
        >>> pick_device("cpu")
        device(type='cpu')
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else torch.device(name)
    if device.type != "cuda":
        return device
    if not torch.cuda.is_available():
        raise ValueError(f"device={name} but torch finds no CUDA device here: set device=cpu, or choose preset=cpu")
    # TorchRL takes "cuda" and "cuda:0" for different devices, and would copy the policy from one to the other.
    return torch.device("cuda", torch.cuda.current_device() if device.index is None else device.index)


def share_threads(
    simulator: int | None = None, learner: int | None = None, hardware: Hardware | None = None
) -> Threads:
    """Decides thread counts; None means automatic.

    Simulator and learner take turns in one process, so each may have all cores that are free. Threads beyond the free
    cores are worse than none: OpenMP's barriers spin, which costs a factor of ten.

    Args:
        simulator: threads for physics, or None.
        learner: threads for updates, or None (then `OMP_NUM_THREADS` is respected).
        hardware: from `detect`, or None to look now.

    Raises:
        ValueError: if a count is below 1.

    Example:
        >>> share_threads(2, 1)
        Threads(simulator=2, learner=1)
    """
    for name, value in (("simulator", simulator), ("learner", learner)):
        if value is not None and value < 1:
            raise ValueError(f"threads.{name} must be at least 1 or null (automatic), got {value}")
    hardware = hardware or detect()
    free = max(1, hardware.cores - round(hardware.busy))
    limit = os.environ.get("OMP_NUM_THREADS", "")
    wanted = int(limit) if limit.isdigit() and int(limit) > 0 else free
    return Threads(simulator=simulator or free, learner=learner or max(1, min(wanted, free, _MAX_LEARNER_THREADS)))


def estimate_update_seconds(parameters: int, batch_size: int, bf16: bool, device: torch.device | str = "cpu") -> float:
    """Estimates one actor-critic update from a short matrix product on this machine.

    An update passes about 16 network-halves (forward, backward to weights, backward to inputs, over policy, twin
    critics and twin targets); matrix products are half of its time at width 512 (measured), the rest is layer norms and
    small calls.

    Args:
        parameters: weights of one network.
        batch_size: transitions per update.
        bf16: whether the update runs in bfloat16.
        device: where it runs.

    Returns:
        Seconds per update, good to a factor of about two.
    """
    device = torch.device(device)
    dtype = torch.bfloat16 if bf16 else torch.float32
    a = torch.ones(256, 512, dtype=dtype, device=device)
    b = torch.ones(512, 512, dtype=dtype, device=device)
    repeats, best = 20, float("inf")
    for _ in range(4):  # the first rounds pay for start-up; the best one is the machine's
        start = time.perf_counter()
        for _ in range(repeats):
            c = a @ b
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        best = min(best, (time.perf_counter() - start) / repeats)
    del c
    operations = 16 * 2 * batch_size * parameters
    overhead = 0.003  # about 2-3 ms of Python per update, whatever its size (measured)
    return 2 * operations * best / (2 * 256 * 512 * 512) + overhead


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


def _memory_gb() -> float:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (ValueError, OSError):
        return 0.0
