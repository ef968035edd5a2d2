"""Version of the code that runs here, which learner and workers must share."""

import platform
import zlib
from functools import cache
from pathlib import Path

from coachable import __version__

_PACKAGE = Path(__file__).resolve().parent
RECIPES = str(next(p for p in (_PACKAGE / "recipes", _PACKAGE.parent / "recipes", _PACKAGE) if p.is_dir()))
"""Folder of the recipes: in the installed package, or beside it in a clone."""


def code_version() -> str:
    """Return in words the versions of Python and coachable, and a checksum of coachable's source at the first call."""
    return f"Python {platform.python_version()} and coachable {__version__} ({_checksum():08x})"


@cache
def _checksum() -> int:
    checksum = 0
    for path in sorted(_PACKAGE.rglob("*.py")):
        if "recipes" not in path.relative_to(_PACKAGE).parts:
            checksum = zlib.crc32(path.read_bytes(), checksum)
    return checksum
