"""Imports point one way, domains do not know each other, and the core stays light (architecture, section 4)."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "coachable"
MODULES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}

# Layer of each part of the package; a module may import from its own layer and from those before it.
LAYERS = {
    "extras": 0,
    "files": 0,
    "finite": 0,
    "gl": 0,
    "keys": 0,
    "ranges": 0,
    "third_party": 0,
    "styles": 0,
    "distributions": 0,
    "domain": 1,
    "envs": 1,
    "networks": 1,
    "losses": 2,
    "replay": 2,
    "transforms": 2,
    "gym": 3,
    "training": 3,
    "export": 4,
    "evaluation": 4,
    "pretrained": 4,
    "coach": 5,
    "doctor": 5,
    "domains": 6,
    "cli": 7,
    "fast": 8,  # optional: nothing but recipes imports it
}

# Numerics that need nothing but torch (and the standard library).
TORCH_ONLY = ["coachable.styles", "coachable.losses.functional"]
HEAVY = ["torch", "tensordict", "torchrl", "mujoco", "dm_control", "hydra", "omegaconf", "wandb", "matplotlib", "viser"]


@functools.cache
def imported(path: Path, type_checking: bool = False) -> set[str]:
    """Absolute names of all imports of a file, those inside functions included, `TYPE_CHECKING` blocks excluded."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test) and not type_checking:
            for child in node.orelse:
                visit(child)
            return
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import, line {node.lineno}: write it absolute"
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(path.read_text()))
    return found


def part(module: str) -> str:
    """Second component of a dotted name: `styles` of `coachable.styles.space`."""
    return module.split(".")[1] if "." in module else ""


def domain(module: str) -> str | None:
    """Name of the domain that a module belongs to."""
    pieces = module.split(".")
    return pieces[2] if pieces[1:2] in (["envs"], ["domains"]) and len(pieces) > 2 else None


INTERNAL = {
    module: {name for name in imported(path) if name.split(".")[0] == "coachable"} for module, path in MODULES.items()
}


def test_every_part_has_a_layer():
    parts = {part(module) for module in MODULES} - {""}
    assert parts <= set(LAYERS), f"give {sorted(parts - set(LAYERS))} a layer in LAYERS of {__file__}"


@pytest.mark.parametrize("module", [m for m in MODULES if part(m)])
def test_imports_point_one_way(module):
    own = LAYERS[part(module)]
    for name in INTERNAL[module] - {"coachable.__version__"}:
        other = part(name)
        assert other in LAYERS, f"{module} imports {name}: import from the module that defines it"
        assert LAYERS[other] <= own, f"{module} (layer {own}) imports {name} (layer {LAYERS[other]})"


def test_a_domain_never_imports_another():
    for module, names in INTERNAL.items():
        own = domain(module)
        others = {domain(name) for name in names if domain(name)} - {own}
        if own is not None:
            assert not others, f"{module} imports from the domains {sorted(others)}"


def test_only_declared_places_name_a_domain():
    """Losses, replay, networks, styles and transforms serve every domain: none of them may import one."""
    for module, names in INTERNAL.items():
        if LAYERS.get(part(module), 99) <= 1 and part(module) not in ("envs", "domain"):
            assert not any(domain(name) for name in names), f"{module} imports a domain: {sorted(names)}"


def test_the_library_never_imports_hydra():
    for module, path in MODULES.items():
        roots = {name.split(".")[0] for name in imported(path, type_checking=True)}
        assert not roots & {"hydra", "omegaconf"}, f"{module} imports hydra or omegaconf: they belong to recipes/"


def test_torchrl_configs_are_never_imported():
    """They register global Hydra groups that shadow ours."""
    for module, path in MODULES.items():
        assert not any(name.startswith("torchrl.trainers.algorithms") for name in imported(path)), module


@pytest.mark.parametrize("prefix", TORCH_ONLY)
def test_numerics_need_torch_only(prefix):
    allowed = {"torch", "coachable", *sys.stdlib_module_names}
    checked = 0
    for module, path in MODULES.items():
        if module == prefix or module.startswith(f"{prefix}."):
            roots = {name.split(".")[0] for name in imported(path)}
            assert roots <= allowed, f"{module} imports {sorted(roots - allowed)}"
            checked += 1
    assert checked


def loaded_by(*statements: str) -> list[set[str]]:
    """Which heavy packages a fresh interpreter has loaded after each of some statements, one after the other."""
    report = "import sys\n"
    report += "".join(f"{one}\nprint(*[m for m in {HEAVY} if m in sys.modules])\n" for one in statements)
    done = subprocess.run(
        [sys.executable, "-c", report], cwd=PACKAGE.parent, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return [set(line.split()) for line in done.stdout.splitlines()]


def test_importing_the_package_loads_nothing_heavy():
    assert loaded_by("import coachable", "import coachable.keys; coachable.__version__; dir(coachable)") == [
        set(),
        set(),
    ]


def test_styles_load_torch_alone():
    """And the core modules load no simulator, logger or page. TorchRL itself imports mujoco where it is installed."""
    styles, core = loaded_by(
        "import coachable.styles; from coachable import StyleSpace",
        "import coachable.transforms.style_sampler, coachable.transforms.style_reward",
    )
    assert styles == {"torch"}
    assert not core & {"dm_control", "hydra", "omegaconf", "wandb", "matplotlib", "viser"}


def test_public_names_resolve():
    import coachable

    for name in coachable.__all__:
        assert getattr(coachable, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'StyleSpac'; it offers Choice"):
        _ = coachable.StyleSpac
