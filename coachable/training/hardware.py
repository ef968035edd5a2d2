"""Detection of the hardware, and its division between simulator and learner."""

import os
import time
from dataclasses import dataclass

import torch

from coachable.training.precision import supports_bf16

__all__ = ["Hardware", "Threads", "choose_preset", "detect", "estimate_update_seconds", "pick_device", "share_threads"]

_MAX_LEARNER_THREADS = 8  # 512-wide layers do not fill more cores; the barriers cost more than they bring


@dataclass(frozen=True)
class Hardware:
    """Hardware that a training can use.

    Attributes:
        cores: Number of cores that this process may use.
        busy: System load of the last minute [cores].
        memory_gb: Physical memory [GB], or 0 if it cannot be read.
        gpu: Name of the first CUDA device, or None.
        bf16: Whether the GPU, or without one the CPU, multiplies bfloat16 matrices in hardware.
    """

    cores: int
    busy: float
    memory_gb: float
    gpu: str | None
    bf16: bool

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
    return Hardware(
        cores=len(affinity(0)) if affinity else os.cpu_count() or 1,
        busy=os.getloadavg()[0],
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
        ValueError: If a CUDA device is named and none is available.

    Example:
        >>> pick_device("cpu")
        device(type='cpu')
    """
    try:
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else torch.device(name)
    except RuntimeError:
        raise ValueError(f"device={name}: expected auto, cpu, cuda or cuda:0") from None
    if device.type != "cuda":
        return device
    if not torch.cuda.is_available():
        raise ValueError(f"device={name} but torch finds no CUDA device here: set device=cpu, or choose preset=cpu")
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
    hardware = hardware or detect()
    free = max(1, hardware.cores - round(hardware.busy))
    limit = os.environ.get("OMP_NUM_THREADS", "")
    wanted = int(limit) if limit.isdigit() and int(limit) > 0 else free
    return Threads(simulator=simulator or free, learner=learner or max(1, min(wanted, free, _MAX_LEARNER_THREADS)))


def estimate_update_seconds(parameters: int, batch_size: int, bf16: bool, device: torch.device | str = "cpu") -> float:
    """Estimate the duration of one actor-critic update from a short matrix product on this machine.

    An update multiplies by a network's weights about 16 times (forward, backward to weights and backward to inputs,
    over policy, twin critics and twin targets). At width 512 these products take half of its time (measured); layer
    norms and small calls take the rest.

    Args:
        parameters: Number of weights of one network.
        batch_size: Transitions per update.
        bf16: Whether the update runs in bfloat16.
        device: Device of the update.

    Returns:
        Seconds per update, correct to a factor of about two.
    """
    device = torch.device(device)
    dtype = torch.bfloat16 if bf16 else torch.float32
    a = torch.ones(256, 512, dtype=dtype, device=device)
    b = torch.ones(512, 512, dtype=dtype, device=device)
    repeats, best = 20, float("inf")
    for _ in range(4):  # the first rounds include start-up costs, so the best one counts
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


def _memory_gb() -> float:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (ValueError, OSError):
        return 0.0
