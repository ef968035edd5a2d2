"""Sphinx extension that writes the pages of the API: one per folder of the package, from its public modules.

The pages are written to `docs/api/` before Sphinx reads its sources. Names in single backticks become links if exactly
one public class, function or method has this name. Classes of PyTorch, TensorDict and TorchRL that signatures often
name are links to the documentation of these libraries.
"""

import ast
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode

PACKAGE = Path(__file__).resolve().parents[2] / "coachable"

# Folders in the order in which a newcomer needs them; folders that are not named follow in alphabetical order.
FIRST = [
    "coachable",
    "coachable.styles",
    "coachable.transforms",
    "coachable.gym",
    "coachable.networks",
    "coachable.distributions",
    "coachable.losses",
    "coachable.replay",
    "coachable.training",
    "coachable.fast",
    "coachable.evaluation",
    "coachable.export",
]

_PYTORCH = "https://docs.pytorch.org"
_TORCHRL = f"{_PYTORCH}/rl/0.14/reference/generated/torchrl"
ELSEWHERE = {
    "Tensor": f"{_PYTORCH}/docs/stable/tensors.html",
    "Module": f"{_PYTORCH}/docs/stable/generated/torch.nn.Module.html",
    "TensorDictBase": f"{_PYTORCH}/tensordict/stable/reference/generated/tensordict.TensorDictBase.html",
    "TensorDictModule": f"{_PYTORCH}/tensordict/stable/reference/generated/tensordict.nn.TensorDictModule.html",
    "EnvBase": f"{_TORCHRL}.envs.EnvBase.html",
    "TransformedEnv": f"{_TORCHRL}.envs.transforms.TransformedEnv.html",
    "LossModule": f"{_TORCHRL}.objectives.LossModule.html",
    "SACLoss": f"{_TORCHRL}.objectives.SACLoss.html",
}

INDEX = """API
===

Every public module, folder by folder, from the docstrings. What most programs need can be imported from the folder
itself, such as ``from coachable.styles import StyleSpace``, or from ``coachable``.

.. toctree::
   :maxdepth: 1

"""


def packages() -> dict[str, Path]:
    """Return the folders that hold Python modules by the name of their package."""
    found = {
        ".".join(init.parent.relative_to(PACKAGE.parent).parts): init.parent for init in PACKAGE.rglob("__init__.py")
    }
    rank = {name: place for place, name in enumerate(FIRST)}
    return {name: found[name] for name in sorted(found, key=lambda name: (rank.get(name, len(FIRST)), name))}


def exports(folder: Path) -> dict[str, str]:
    """Return the names that a package re-exports, with the modules that define them, read from its `__init__.py`."""
    tree = ast.parse((folder / "__init__.py").read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    return {
        alias.name: node.module or ""
        for node in imports
        if (node.module or "").startswith("coachable")
        for alias in node.names
        if alias.name[0] != "_" and not alias.name.startswith("choose_")
    }


def page(name: str, folder: Path) -> str:
    """Return the page of one folder in reStructuredText."""
    lines = [name, "=" * len(name), "", f".. automodule:: {name}", ""]
    if exported := exports(folder):
        links = [f":py:obj:`{short} <{module}.{short}>`" for short, module in sorted(exported.items())]
        lines += [f"Import from ``{name}``: {', '.join(links)}.", ""]
    for file in sorted(folder.glob("*.py")):
        if file.stem[0] != "_":
            module = f"{name}.{file.stem}"
            lines += [
                module,
                "-" * len(module),
                "",
                f".. automodule:: {module}",
                "   :members:",
                "   :ignore-module-all:",
            ]
            lines += ["   :show-inheritance:", ""]
    return "\n".join(lines)


def write_pages(app: Sphinx) -> None:
    """Write the pages that have changed, and remove those of folders that are gone."""
    out = Path(app.srcdir) / "api"
    out.mkdir(exist_ok=True)
    texts = {f"{name}.rst": page(name, folder) for name, folder in packages().items()}
    texts["index.rst"] = INDEX + "".join(f"   {name}\n" for name in packages())
    for old in set(out.glob("*.rst")) - {out / name for name in texts}:
        old.unlink()
    for name, text in texts.items():
        file = out / name
        if not file.exists() or file.read_text() != text:
            file.write_text(text)


def link_name(app: Sphinx, env: BuildEnvironment, node: Any, content: nodes.TextElement) -> nodes.reference | None:
    """Link a name that is written without its module if only one of our objects has it, and classes of `ELSEWHERE`."""
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py" or not re.fullmatch(r"\w*[A-Z_.][\w.]*", target) or app.builder is None:
        return None
    objects = env.get_domain("py").objects  # pyright: ignore[reportAttributeAccessIssue]
    wanted = ("class", "exception", "function", "data") if "." not in target else ("method", "property", "attribute")
    found = [name for name, entry in objects.items() if name.endswith(f".{target}") and entry.objtype in wanted]
    if len(found) != 1:
        module, _, name = target.rpartition(".")
        known = not module or module.split(".")[0] in ("torch", "tensordict", "torchrl")
        return nodes.reference("", "", content, refuri=ELSEWHERE[name]) if known and name in ELSEWHERE else None
    entry = objects[found[0]]
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, content, found[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("builder-inited", write_pages)
    app.connect("missing-reference", link_name)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
