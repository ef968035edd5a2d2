"""`coachable export web`: write a folder that any static host serves, in which an agent acts in the browser."""

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, metadata
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from coachable import __version__
from coachable.domain import Domain
from coachable.export.graph import import_onnx
from coachable.export.onnx import write_onnx
from coachable.export.web.part import PagePart
from coachable.export.web.pinned_files import Package, packages, provide
from coachable.outputs import complete_folder
from coachable.scene.look import ICON, stylesheet
from coachable.training.weights import LoadedPolicy

_POLICY = "policy.onnx"
_VENDORED = "third_party"
_PRELOADS = "<!-- preloads -->"


def export_page(
    agent: LoadedPolicy, domain: Domain, out: Path, assets: Path | None = None, home: str | None = None
) -> int:
    """Write the page of an agent.

    The folder contains the page's own files, the policy as ONNX, the physics as XML or ONNX, `manifest.json` with
    everything else that the page has to know, and the pinned files of other projects in `third_party`.

    Args:
        agent: The agent.
        domain: Its domain, which declares `make_web`.
        out: Folder to write into; files of the same names are replaced.
        assets: Folder with the files of other projects, see `coachable.export.web.pinned_files.provide`.
        home: Address of the documentation, to which the page links; by default the one that `home_page` finds.

    Returns:
        Size of all files of the page [byte].

    Raises:
        ImportError: If the extra `export` is not installed.
        OSError: If the files of other projects cannot be fetched, or writing fails.
    """
    import_onnx()
    assert domain.make_web is not None
    part = domain.make_web(agent.space)
    with complete_folder(out) as folder:
        vendored = provide(assets, *part.packages)
        files = part.files()
        copy_page(folder, vendored, part.licence)
        write_onnx(agent, domain, folder / _POLICY)
        for name, content in files.items():
            (folder / name).write_bytes(content)
        manifest = manifest_of(agent, domain, part) | ({} if home is None else {"home": home})
        return finish_page(folder, manifest, [*files, _POLICY], vendored)


def copy_page(out: Path, vendored: Mapping[str, Path], licence: str = "") -> None:
    """Write the page's own files, and the files of other projects with their licences.

    Args:
        out: The page's folder.
        vendored: Files of other projects, from `coachable.export.web.pinned_files.provide`.
        licence: Notice of the domain's own model, see `PagePart.licence`.
    """
    with as_file(files("coachable.export.web") / "static") as own:
        shutil.copytree(own, out, dirs_exist_ok=True)
    (out / "look.css").write_text(stylesheet(), encoding="utf-8")
    shutil.copyfile(ICON, out / ICON.name)
    for name, file in vendored.items():
        target = out / _VENDORED / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target)
    used = _used(vendored)
    (out / _VENDORED / "LICENSES.txt").write_text(_licenses(used, licence), encoding="utf-8")


def finish_page(out: Path, manifest: dict[str, Any], data: Sequence[str], vendored: Mapping[str, Path]) -> int:
    """Write `manifest.json` with the sizes of everything that the page loads.

    Args:
        out: The page's folder, with all other files.
        manifest: What the page has to know.
        data: Names of the files of this agent.
        vendored: Files of other projects, as in `copy_page`.

    Returns:
        Size of all files of the page [byte].
    """
    names = [*data, *(f"{_VENDORED}/{name}" for name in vendored)]
    manifest["downloads"] = [{"file": name, "bytes": (out / name).stat().st_size} for name in names]
    manifest["packages"] = [
        {"name": p.name, "version": p.version, "license": p.license, "home": p.home} for p in _used(vendored)
    ]
    (out / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    _name_preloads(out, manifest, vendored)
    return sum(file.stat().st_size for file in out.rglob("*") if file.is_file())


def _name_preloads(out: Path, manifest: Mapping[str, Any], vendored: Mapping[str, Path]) -> None:
    """Name in `index.html` what its scripts will ask for, so that the browser fetches everything at once."""
    modules = [f"{manifest['kind']}.js"]
    for name in modules:  # which grows
        imported = re.findall(r'"\./(\w+\.js)"', (out / name).read_text(encoding="utf-8"))
        modules += [other for other in dict.fromkeys(imported) if other not in modules]
    theirs = [f"{_VENDORED}/{name}" for name in vendored]
    modules += [name for name in theirs if name.endswith(("js", "mjs"))]
    files = [name for name in theirs if name.endswith(".wasm")]
    files += [name for kind in ("models", "graphs") for name in manifest.get(kind, {}).values()]
    links = [f'<link rel="modulepreload" href="{name}" />' for name in modules]
    links += [f'<link rel="preload" href="{name}" as="fetch" crossorigin="anonymous" />' for name in files]
    page = out / "index.html"
    text = page.read_text(encoding="utf-8")
    page.write_text(text.replace(_PRELOADS, "\n    ".join(links)), encoding="utf-8")


def about(agent: LoadedPolicy) -> dict[str, Any]:
    """Return what every page has to know of an agent."""
    return {"coachable_version": __version__, "home": home_page(), "domain": agent.metadata["domain"]}


def home_page() -> str:
    """Return the address that the installed package declares for its documentation or its repository, or ""."""
    try:
        declared = metadata("coachable").get_all("Project-URL") or []
    except PackageNotFoundError:
        return ""
    addresses = {name.strip().lower(): address.strip() for name, _, address in (d.partition(",") for d in declared)}
    return next((addresses[name] for name in ("documentation", "repository", "homepage") if name in addresses), "")


def manifest_of(agent: LoadedPolicy, domain: Domain, part: PagePart) -> dict[str, Any]:
    """Return what the page has to know of an agent and its domain besides models and graphs."""
    kept = ("name", "low", "high", "unit", "help", "default")
    controls = [
        {key: getattr(control.parameter, key) for key in kept} | {"circular": control.circular, "rate": control.rate}
        for control in domain.controls
    ]
    told = part.told()
    return {
        **about(agent),
        **told,
        "kind": part.kind,
        "title": part.title,
        "summary": part.summary,
        "style_space": agent.space.to_dict(),
        "default_style": agent.space.default.tolist(),
        "controls": controls,
        "opens": dict(part.opens),
        "idle": list(part.idle),
        "idle_note": part.idle_note,
        "names": dict(domain.words.names),
        "measures": [vars(measure) for measure in part.measures],
        "window": part.window,
        "graphs": {"policy": _POLICY, **told["graphs"]},
        "physics": dict(part.physics),
        "picture": part.picture,
        "terminated": part.terminated,
        "starts": [dict(start) for start in part.starts],
    }


def _used(vendored: Mapping[str, Path]) -> list[Package]:
    return [p for p in packages() if any(name.startswith(f"{p.name}/") for name in vendored)]


def _licenses(used: Sequence[Package], licence: str) -> str:
    """Return the notices that the licences of the vendored files ask for."""
    blocks = [f"{p.name} {p.version}\n{p.copyright}\nLicence: {p.license}\n{p.home}\n" for p in used]
    mit = (files("coachable.export.web") / "MIT.txt").read_text(encoding="utf-8")
    apache = "The Apache License 2.0 is at https://www.apache.org/licenses/LICENSE-2.0\n"
    others = [f"{licence}\n"] if licence else []
    if "Apache-2.0" in licence or any(p.license == "Apache-2.0" for p in used):
        others.append(apache)
    return "\n".join([*blocks, *others, "MIT License\n", mit])
