"""State of the global random number generators, and random streams that are independent of them."""

import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

_NUMPY = ("name", "keys", "position", "has_gauss", "cached")  # of its legacy state
_BORROWED = threading.RLock()  # one stream at a time uses the global generator


def seed_everything(seed: int) -> None:
    """Seed the global generators of Python, NumPy and torch (on every device).

    Args:
        seed: Integer in [0, 2**32).
    """
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - third-party environments draw from the global generator
    torch.manual_seed(seed)


def rng_state() -> dict[str, Any]:
    """Return the state of the global generators of Python, NumPy and torch.

    Returns:
        Tensors, numbers, strings and lists only, so that `torch.load(weights_only=True)` can read them.

    Example:
        >>> before = rng_state()
        >>> first = torch.rand(3)
        >>> set_rng_state(before)
        >>> bool((torch.rand(3) == first).all())
        True
    """
    version, words, gauss = random.getstate()
    numpy = dict(zip(_NUMPY, np.random.get_state(legacy=True), strict=True))  # noqa: NPY002
    state: dict[str, Any] = {
        "torch": torch.get_rng_state(),
        "numpy": {**numpy, "keys": torch.from_numpy(np.asarray(numpy["keys"]).astype(np.int64))},
        "python": {"version": int(version), "words": list(words), "gauss": gauss},
    }
    if torch.cuda.is_available():
        state["cuda"] = list(torch.cuda.get_rng_state_all())
    return state


def set_rng_state(state: dict[str, Any]) -> None:
    """Restore what `rng_state` returned.

    Args:
        state: From `rng_state`. CUDA generators are restored only if the number of CUDA devices is unchanged.
    """
    torch.set_rng_state(state["torch"].cpu())
    numpy = {**state["numpy"], "keys": state["numpy"]["keys"].numpy().astype(np.uint32)}
    np.random.set_state(tuple(numpy[key] for key in _NUMPY))  # noqa: NPY002
    python = state["python"]
    random.setstate((python["version"], tuple(python["words"]), python["gauss"]))
    if "cuda" in state and torch.cuda.is_available() and len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([s.cpu() for s in state["cuda"]])


@contextmanager
def preserved_rng() -> Iterator[None]:
    """Restore the global generators on exit, so that an evaluation does not change the course of a training."""
    state = rng_state()
    try:
        yield
    finally:
        set_rng_state(state)


class RandomStream:
    """Stream of random numbers for policies that sample, independent of other uses of torch's global CPU generator.

    Args:
        seed: Seed of the stream.

    Example:
        >>> first, second = RandomStream(0), RandomStream(0)
        >>> with first.drawn():
        ...     a = torch.rand(1)
        >>> b = torch.rand(1)
        >>> with second.drawn():
        ...     print(bool(torch.rand(1) == a))
        True
    """

    def __init__(self, seed: int) -> None:
        self._state = torch.Generator().manual_seed(seed).get_state()

    @contextmanager
    def drawn(self) -> Iterator[None]:
        """Make torch's global CPU generator continue the stream inside the context; other streams wait meanwhile."""
        with _BORROWED:
            outside = torch.get_rng_state()
            torch.set_rng_state(self._state)
            try:
                yield
            finally:
                self._state = torch.get_rng_state()
                torch.set_rng_state(outside)
