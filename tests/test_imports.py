"""What imports load: the core stays light, and what belongs to recipes stays there."""

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
            if isinstance(child, (ast.stmt, ast.excepthandler, ast.match_case)):  # no import is in an expression
                visit(child)

    visit(ast.parse(path.read_text()))
    return found


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
