"""Files of other projects that the page needs: pinned, checked, and taken from npm or from a folder."""

import base64
import hashlib
import io
import json
import os
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

_SECONDS = 600  # that npm may take for a package


@dataclass(frozen=True)
class Package:
    """Pinned package of npm.

    Attributes:
        name: Name at npm.
        version: Exact version.
        license: SPDX identifier of its licence.
        copyright: Whose it is.
        home: Address of its source.
        integrity: Hash of its archive, as npm writes it.
        files: SHA-256 of the files that the page needs, by path in the package.
    """

    name: str
    version: str
    license: str
    copyright: str
    home: str
    integrity: str
    files: dict[str, str]


def packages(*names: str) -> list[Package]:
    """Return the packages of `third_party.json` with these names, or all of them."""
    lock = json.loads((files("coachable.export.web") / "third_party.json").read_text(encoding="utf-8"))
    return [Package(**package) for package in lock["packages"] if not names or package["name"] in names]


def provide(assets: Path | None = None, *names: str) -> dict[str, Path]:
    """Return the files by `PACKAGE/PATH`, after comparing them with their hashes.

    Args:
        assets: Folder that contains them at these paths, such as `node_modules`. By default a cache of the user, which
            is filled with `npm pack` where files are missing.
        *names: Names of the needed packages; all by default.

    Raises:
        ValueError: If a file of `assets` is missing or is not the pinned one.
        OSError: If npm is missing or fails; the message says what to install.
    """
    folder = _cache() if assets is None else assets
    found = {}
    for package in packages(*names):
        missing = [path for path in package.files if not _matches(folder, package, path)]
        if missing and assets is not None:
            raise ValueError(
                f"{assets / package.name / missing[0]} is missing or is not the file of {package.name} "
                f"{package.version}: expected a folder like node_modules after npm install "
                f"{' '.join(f'{other.name}@{other.version}' for other in packages(*names))}"
            )
        if missing:
            _fetch(package, folder)
        found |= {f"{package.name}/{path}": folder / package.name / path for path in package.files}
    return found


def _cache() -> Path:
    version = hashlib.sha256(json.dumps([p.integrity for p in packages()]).encode()).hexdigest()[:12]
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "coachable" / f"web-{version}"


def _matches(folder: Path, package: Package, path: str) -> bool:
    file = folder / package.name / path
    return file.is_file() and hashlib.sha256(file.read_bytes()).hexdigest() == package.files[path]


def _fetch(package: Package, folder: Path) -> None:
    """Get a package from npm, compare it with its hashes, and put the needed files into the cache."""
    wanted = f"{package.name}@{package.version}"
    npm = shutil.which("npm")
    if npm is None:
        raise FileNotFoundError(
            f"the page needs {wanted}, which npm fetches: install Node.js 20, or name a folder with the files by "
            "--assets"
        )
    with tempfile.TemporaryDirectory() as place:
        command = [npm, "pack", wanted, "--ignore-scripts", "--silent"]
        try:
            done = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=_SECONDS, check=False)
        except subprocess.TimeoutExpired as error:
            raise OSError(f"npm did not fetch {wanted} within {_SECONDS} s: try again, or use --assets") from error
        archives = list(Path(place).glob("*.tgz"))
        if done.returncode or len(archives) != 1:
            reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise OSError(f"npm could not fetch {wanted} ({reason}): expected a connection, or use --assets")
        for path, content in _unpack(package, archives[0].read_bytes()):
            target = folder / package.name / path
            target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            partial = target.with_name(f".{os.getpid()}-{target.name}")
            partial.write_bytes(content)
            os.replace(partial, target)


def _unpack(package: Package, archive: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield the needed files of an archive, whose hashes are compared first."""
    digest = "sha512-" + base64.b64encode(hashlib.sha512(archive).digest()).decode()
    if digest != package.integrity:
        raise OSError(f"what npm fetched as {package.name} {package.version} has another hash: expected the pinned one")
    with tarfile.open(fileobj=io.BytesIO(archive)) as members:
        for path, expected in package.files.items():
            member = members.extractfile(f"package/{path}")
            content = b"" if member is None else member.read()
            if hashlib.sha256(content).hexdigest() != expected:
                raise OSError(f"{path} of {package.name} {package.version} has another hash: expected the pinned one")
            yield path, content
