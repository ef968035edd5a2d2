"""Extras of an installation, and the commands that install them."""

from collections.abc import Iterator
from contextlib import contextmanager

# Distributions by extra.
EXTRAS = {
    "ui": ("viser",),
    "video": ("av",),
    "export": ("onnx", "onnxruntime", "onnxscript"),
    "explain": ("captum",),
    "gym": ("gymnasium",),
    "cluster": ("ray",),
}


def how_to_install(extra: str) -> str:
    """Return the commands that install an extra, for an installed package and for a clone of the repository.

    Example:
        >>> how_to_install("ui")
        "pip install 'coachable[ui]' (in a clone: pip install -e '.[ui]')"
    """
    return f"pip install 'coachable[{extra}]' (in a clone: pip install -e '.[{extra}]')"


@contextmanager
def from_extra(extra: str) -> Iterator[None]:
    """Say how to install an extra if an import in the block fails.

    Raises:
        ImportError: If a package is not installed; the message names it and the extra.
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(f"{error.name} is missing: {how_to_install(extra)}") from error
