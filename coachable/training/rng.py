"""The global random number generators as one plain, pickle-free state."""

import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

__all__ = ["RandomStream", "preserved_rng", "rng_state", "seed_everything", "set_rng_state"]

_BORROWED = threading.RLock()  # the global generator, by one stream at a time


def seed_everything(seed: int) -> None:
    """Seeds python, numpy and torch (every device).

    Args:
        seed: any integer in [0, 2**32).
    """
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - third-party environments draw from the global generator
    torch.manual_seed(seed)


def rng_state() -> dict[str, Any]:
    """Reads the state of python's, numpy's and torch's global generators.

    Returns:
        Tensors, numbers, strings and lists only, so that `torch.load(weights_only=True)` reads it back.

    Example:
        >>> before = rng_state()
        >>> first = torch.rand(3)
        >>> set_rng_state(before)
        >>> bool((torch.rand(3) == first).all())
        True
    """
    version, words, gauss = random.getstate()
    name, keys, position, has_gauss, cached = np.random.get_state(legacy=True)  # noqa: NPY002
    state: dict[str, Any] = {
        "torch": torch.get_rng_state(),
        "numpy": {
            "name": str(name),
            "keys": torch.from_numpy(np.asarray(keys).astype(np.int64)),
            "position": int(position),
            "has_gauss": int(has_gauss),
            "cached": float(cached),
        },
        "python": {"version": int(version), "words": list(words), "gauss": gauss},
    }
    if torch.cuda.is_available():
        state["cuda"] = list(torch.cuda.get_rng_state_all())
    return state


def set_rng_state(state: dict[str, Any]) -> None:
    """Restores what `rng_state` read.

    Args:
        state: from `rng_state`. CUDA generators are restored only where as many devices exist as when it was read.
    """
    torch.set_rng_state(state["torch"].cpu())
    numpy = state["numpy"]
    np.random.set_state(  # noqa: NPY002
        (
            numpy["name"],
            numpy["keys"].numpy().astype(np.uint32),
            numpy["position"],
            numpy["has_gauss"],
            numpy["cached"],
        )
    )
    python = state["python"]
    random.setstate((python["version"], tuple(python["words"]), python["gauss"]))
    if "cuda" in state and torch.cuda.is_available() and len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([s.cpu() for s in state["cuda"]])


@contextmanager
def preserved_rng() -> Iterator[None]:
    """Puts the global generators back afterwards, so that an evaluation cannot change the course of a training."""
    state = rng_state()
    try:
        yield
    finally:
        set_rng_state(state)


class RandomStream:
    """Random numbers for policies that sample, from torch's global CPU generator but independent of its other users.

    Args:
        seed: of the stream.

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
        """Random numbers drawn meanwhile are the stream's; other streams wait."""
        with _BORROWED:
            outside = torch.get_rng_state()
            torch.set_rng_state(self._state)
            try:
                yield
            finally:
                self._state = torch.get_rng_state()
                torch.set_rng_state(outside)
