"""`coachable doctor`: check the installation and the hardware of this machine."""

import os
import platform
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import Literal

from coachable.extras import EXTRAS, how_to_install

Verdict = Literal["ok", "note", "problem"]
_SHOWN = ("torch", "torchrl", "tensordict", "mujoco", "dm_control", "numpy", "hydra-core", "wandb")
PYTHON = ((3, 11), (3, 12))  # first and last version for which all dependencies have files
RAY = ((2, 50), (3, 0))  # first version that works, and the first that is not known to
_RAY_PORTS = {6379: "cluster", 8265: "dashboard and jobs", 10001: "clients"}  # of `ray start --head`
_REINSTALL = "pip install coachable (in a clone: pip install -e .) in a fresh environment"


@dataclass(frozen=True)
class Check:
    """Result of one check.

    Attributes:
        name: The part that was checked.
        verdict: The result: "ok", "note" (it works with a restriction) or "problem" (it has to be fixed).
        finding: One sentence, with the remedy if one is needed.
    """

    name: str
    verdict: Verdict
    finding: str


def examine() -> list[Check]:
    """Check versions, MuJoCo, rendering, precision, threads, extras and Ray, without changing anything."""
    parts: tuple[Callable[[], list[Check]], ...] = (_versions, _mujoco, _rendering, _hardware, _extras, _ray)
    return [check for part in parts for check in part()]


def installed(name: str) -> str | None:
    """Return the version of a distribution, or None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def python_version() -> tuple[int, int]:
    """Return the major and minor version of the interpreter."""
    return sys.version_info[:2]


def _python() -> Check:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    first, last = (".".join(map(str, version)) for version in PYTHON)
    if PYTHON[0] <= python_version() <= PYTHON[1]:
        return Check("python", "ok", found)
    newer = python_version() > PYTHON[1]
    reason = ", because labmaze, which dm-control needs, has no files for it" if newer else ""
    return Check("python", "problem", f"{found}: expected Python {first} or {last}{reason}")


def _versions() -> list[Check]:
    checks = [_python()]
    for name in _SHOWN:
        version = installed(name)
        verdict, finding = ("ok", version) if version else ("problem", f"missing: {_REINSTALL}")
        checks.append(Check(name, verdict, finding))
    return checks


def _mujoco() -> list[Check]:
    mujoco, core = installed("mujoco"), installed("mujoco-core")
    if mujoco and core and _major(mujoco) < 4:  # a downgrade from MuJoCo 4 in place leaves files of mujoco-core 4
        finding = f"mujoco-core {core} lies beside mujoco {mujoco}, in the same folder: make a new virtual environment"
        return [Check("mujoco", "problem", finding)]
    if mujoco and _major(mujoco) >= 4:
        remedy = "make a new virtual environment with 'mujoco>=3.17,<4'"
        return [Check("mujoco", "problem", f"{mujoco} breaks dm_control: {remedy}")]
    return []


def _rendering() -> list[Check]:
    from coachable.gl import INSTALL_HINT, NO_BACKEND, choose_gl_backend

    backend = choose_gl_backend()
    if backend == NO_BACKEND:
        return [Check("rendering", "note", f"training works, videos do not: {INSTALL_HINT}")]
    return [Check("rendering", "ok", f"MUJOCO_GL={backend}")]


def _hardware() -> list[Check]:
    if installed("torch") is None or installed("torchrl") is None:
        return []
    from coachable.training.hardware import choose_preset, detect, share_threads

    hardware = detect()
    threads = share_threads(hardware=hardware)
    slow = "" if hardware.bf16 else "; without bf16 in hardware an update takes two to four times as long"
    checks = [
        Check("hardware", "ok" if hardware.bf16 else "note", hardware.describe() + slow),
        Check("preset", "ok", f"{choose_preset(hardware)} (what preset=auto chooses)"),
        Check("threads", "ok", f"simulator {threads.simulator}, learner {threads.learner} (set threads.* to change)"),
    ]
    limit = os.environ.get("OMP_NUM_THREADS", "")
    if limit.isdigit() and int(limit) > hardware.cores:
        finding = f"OMP_NUM_THREADS={limit} exceeds the {hardware.cores} cores: updates become many times slower"
        checks.append(Check("threads", "problem", finding))
    return checks


def _extras() -> list[Check]:
    checks = []
    for extra, names in EXTRAS.items():
        missing = [name for name in names if installed(name) is None]
        finding = f"not installed ({', '.join(missing)}): {how_to_install(extra)}" if missing else "installed"
        checks.append(Check(f"[{extra}]", "note" if missing else "ok", finding))
    return checks


def _ray() -> list[Check]:
    """Check Ray's version and the ports that `ray start --head` listens at, if Ray is installed."""
    version = installed("ray")
    if version is None:
        return []
    if not RAY[0] <= tuple(map(int, version.split(".")[:2])) < RAY[1]:
        first, end = (".".join(map(str, bound)) for bound in RAY)
        return [Check("ray", "problem", f"{version}: expected at least {first} and less than {end}")]
    taken = [port for port in _RAY_PORTS if _is_taken(port)]
    if taken:
        named = ", ".join(f"{port} ({_RAY_PORTS[port]})" for port in taken)
        finding = f"{version}; a program listens at {named}: a cluster of this host, or ray start --head needs others"
        return [Check("ray", "note", finding)]
    return [Check("ray", "ok", f"{version}; its ports {', '.join(map(str, _RAY_PORTS))} are free on this host")]


def _is_taken(port: int) -> bool:
    with socket.socket() as tried:
        tried.settimeout(0.5)
        return tried.connect_ex(("127.0.0.1", port)) == 0


def _major(version: str) -> int:
    return int(version.split(".")[0])
