"""Build and load `kernels.c` and `sac.c` with the machine's C compiler, where there is one."""

import ctypes
import functools
import hashlib
import logging
import os
import shutil
import stat
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

KERNEL_THREADS = 4  # most that share the kernels' work; with more, the parallel operations of torch are faster

_LOG = logging.getLogger(__name__)
_NAMES = {torch.bfloat16: "bf16", torch.float32: "fp32"}  # as the functions' names end
_TYPES = (ctypes.c_void_p, ctypes.c_int64, ctypes.c_int)
_SOURCE = Path(__file__).with_name("sac.c")
_INCLUDED = Path(__file__).with_name("kernels.c")
_FLAGS = (
    *("-O3", "-march=native", "-mprefer-vector-width=512", "-std=gnu11", "-shared", "-fPIC"),
    # Sums in any order; infinities and NaN keep their meaning.
    *("-fno-math-errno", "-fno-trapping-math", "-fassociative-math", "-fno-signed-zeros", "-freciprocal-math"),
)


@dataclass(frozen=True)
class Products:
    """Products of matrices with what follows them, and heads of many outputs, on one thread."""

    dense_forward: Any
    dense_backward: Any
    weight_gradient: Any
    wide_head_forward: Any
    wide_head_backward: Any
    sac_gradients: Any


@dataclass(frozen=True)
class Kernels:
    """The functions of `kernels.c` for one dtype; their arguments are addresses and numbers, see there."""

    layer_forward: Any
    layer_backward: Any
    head_forward: Any
    head_backward: Any
    adam: Any
    products: Products | None


def load_sac(dtype: torch.dtype) -> Any:
    """Return the function `sac_gradients` of `sac.c`, or `None` where it was not built; see `direct.py`.

    Args:
        dtype: Of the matrix products, `torch.float32` or `torch.bfloat16`.
    """
    kernels = load_kernels().get(dtype)
    return None if kernels is None or kernels.products is None else kernels.products.sac_gradients


@functools.cache
def load_kernels() -> dict[torch.dtype, Kernels]:
    """Compile (once per machine, about a second) and load the kernels.

    The library is kept in `coachable` below `XDG_CACHE_HOME` or `~/.cache`, and only loaded from there if nobody else
    can write to the folder or the file.

    Returns:
        The kernels by dtype of the matrix products, or none without a working C compiler, or if `COACHABLE_NATIVE=0`
        is set. Everything works without them: an update of SAC takes 1.3 times as long at float32 with one thread and
        1.8 times with two (Zen 3, three layers of 256), and 1.5 times at bfloat16.
    """
    if os.environ.get("COACHABLE_NATIVE", "1") == "0":
        return {}
    compiler = next((c for c in (os.environ.get("CC"), "cc", "gcc", "clang") if c and shutil.which(c)), None)
    if compiler is None:
        _LOG.info(
            "there is no C compiler (cc, gcc or clang): updates without compiled kernels take 1.3 to 1.8 times as long"
        )
        return {}
    try:
        return _bind(_library(compiler))
    except (OSError, subprocess.SubprocessError, AttributeError) as error:  # the last one: a function is missing
        detail = getattr(error, "stderr", "") or error
        _LOG.warning("building %s with %s failed; updates run without: %s", _SOURCE.name, compiler, detail)
        return {}


def _library(compiler: str) -> ctypes.CDLL:
    """Load the library of this source from the user's cache, where it is built first if need be.

    Without a cache that only the user can write to, it is built in a folder that goes away again.
    """
    source = _SOURCE.read_bytes() + _INCLUDED.read_bytes()
    machine = repr(sorted(torch.cpu.get_capabilities().items()))  # the cache may be shared between machines
    key = hashlib.sha256(b"\0".join((source, machine.encode(), compiler.encode(), repr(_FLAGS).encode()))).hexdigest()
    name = f"kernels-{key[:20]}.so"
    folder = _cache()
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="coachable-") as private:
            return ctypes.CDLL(str(_build(compiler, Path(private) / name)))
    library = folder / name
    if not library.exists() or not _only_ours(library):
        with tempfile.TemporaryDirectory(dir=folder) as private:
            _build(compiler, Path(private) / name).replace(library)  # atomic: several processes may build at once
    return ctypes.CDLL(str(library))


def _build(compiler: str, library: Path) -> Path:
    command = [compiler, *_FLAGS, "-o", str(library), str(_SOURCE), "-lm"]
    subprocess.run(command, check=True, capture_output=True, text=True, errors="replace", timeout=120)
    library.chmod(0o700)
    return library


def _cache() -> Path | None:
    """Folder for libraries, or `None` if it cannot be written to, or could be by others."""
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "coachable"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _only_ours(folder):
            _LOG.warning(
                "%s belongs to somebody else or others can write to it: the learner's kernels are built afresh in a "
                "private folder (a second at each start); set XDG_CACHE_HOME to a folder of yours, or chmod go-w it",
                folder,
            )
            return None
        return folder if os.access(folder, os.W_OK) else None
    except (OSError, RuntimeError):  # no home
        return None


def _only_ours(path: Path) -> bool:
    """Whether `path`, which is not a link, belongs to this user and nobody else can write to it."""
    status = path.lstat()
    return status.st_uid == os.geteuid() and not status.st_mode & 0o022 and not stat.S_ISLNK(status.st_mode)


def _products(library: ctypes.CDLL, dtype: torch.dtype) -> Products | None:
    """Return the products where the processor has the vector instructions for them: AVX2, or bfloat16 of AVX-512.

    Where it also has tiles (AMX) that the library does not use, because the compiler or the kernel does not know them,
    torch's products of bfloat16 matrices are faster.
    """
    name = _NAMES[dtype]
    if not hasattr(library, f"dense_forward_{name}"):
        return None
    if dtype == torch.bfloat16 and torch.cpu.get_capabilities().get("amx_bf16") and not library.tiles_allowed():
        return None
    p, i, flag = _TYPES
    arguments = {
        "dense_forward": [i, p, p, p, p, p, p, i, i, i, i, ctypes.c_float, i, i, p, p, p, p],
        "dense_backward": [p, i, i, p, i, i, p, i, i, i, p],
        "weight_gradient": [p, i, p, i, i, i, flag, p],
        "wide_head_forward": [p, p, p, i, i, i, p],
        "wide_head_backward": [p, p, p, i, i, i, flag, flag, p, p, p],
        "sac_gradients": [p, i, i, flag, flag],
    }
    functions = {key: library[f"{key}_{name}"] for key in arguments}
    for key, function in functions.items():
        function.argtypes, function.restype = arguments[key], None
    return Products(**functions)


def _bind(library: ctypes.CDLL) -> dict[torch.dtype, Kernels]:
    p, i, flag = _TYPES
    kernels = {}
    adam = library.adam
    adam.argtypes = [p, i, *[ctypes.c_float] * 6]
    adam.restype = None
    for dtype, name in _NAMES.items():
        forward, backward = library[f"layer_forward_{name}"], library[f"layer_backward_{name}"]
        forward.argtypes = [p, p, p, p, p, i, i, i, i, ctypes.c_float, i, i, p, p, p, p]
        backward.argtypes = [p, p, p, p, p, p, p, p, i, flag, flag, i, p, p, p, p, p]
        head, head_backward = library[f"head_forward_{name}"], library[f"head_backward_{name}"]
        head.argtypes = [p, p, p, i, i, i, p]
        head_backward.argtypes = [p, p, p, i, i, i, flag, flag, p, p, p, p]
        forward.restype = backward.restype = head.restype = head_backward.restype = None
        kernels[dtype] = Kernels(forward, backward, head, head_backward, adam, _products(library, dtype))
    return kernels
