"""Atomic output: files and folders that are either complete or not written at all."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def complete_folder(out: Path) -> Iterator[Path]:
    """Provide a temporary folder whose files are moved to `out` if the block ends without an error or interruption.

    Args:
        out: Folder for the results, created if missing; existing files are kept unless they have the same names.

    Raises:
        NotADirectoryError: If `out` is a file.
        OSError: If nothing can be written there.
    """
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(f"{out} is a file: expected a folder, or a name that is free")
    made = not out.exists()
    with _named(out):
        out.mkdir(parents=True, exist_ok=True)
        unfinished = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=out))
    try:
        yield unfinished
        for file in sorted(path for path in unfinished.rglob("*") if path.is_file()):
            place = out / file.relative_to(unfinished)
            place.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, place)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        if made:
            with contextlib.suppress(OSError):  # it is not empty if the block succeeded
                out.rmdir()


@contextlib.contextmanager
def complete_file(out: Path) -> Iterator[Path]:
    """Provide a temporary file that is moved to `out` if the block ends without an error or interruption.

    Args:
        out: File to write, replaced if it exists; its folder is created if missing.

    Raises:
        IsADirectoryError: If `out` is a folder.
        OSError: If nothing can be written there.
    """
    if out.is_dir():
        raise IsADirectoryError(f"{out} is a folder: expected the name of a file")
    unfinished = out.with_name(f".unfinished-{os.getpid()}-{out.name}")
    with _named(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        unfinished.touch()
    try:
        yield unfinished
        os.replace(unfinished, out)
    finally:
        unfinished.unlink(missing_ok=True)


@contextlib.contextmanager
def _named(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OSError(f"cannot write {out}: {error.strerror or error}") from error
