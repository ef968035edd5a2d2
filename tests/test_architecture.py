"""Imports point down through the rooms of docs/architecture.md, and nothing reaches up by another way.

Recipes stand above everything: recipes, domains, then coach, evaluation and export, then training, then transforms,
replay and losses, then networks, then distributions, then styles.
"""

import ast
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "coachable"
FILES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}

# Small modules at the top level that know no room.
BASE = {
    "code_version",
    "extras",
    "files",
    "finite",
    "gl",
    "keys",
    "object_state",
    "offscreen",
    "outputs",
    "ranges",
    "shipped",
    "signals",
    "specs",
}

# Of each room, the rooms below it that it may import; what these may import it may, too.
ROOMS = {
    "styles": set(),
    "scene": set(),  # what there is to see
    "distributions": {"styles"},
    "networks": {"distributions"},
    "contract": {"networks"},  # of exported models
    "losses": {"networks"},
    "replay": {"networks"},
    "transforms": {"networks"},
    "defaults": {"transforms", "scene"},  # what a `Domain` leaves out
    "domain": {"defaults"},  # the type of a declaration
    "training": {"contract", "domain", "losses", "replay"},
    "fast": {"losses", "training"},
    "cluster": {"training"},
    "gym": {"transforms"},
    "export": {"training"},
    "evaluation": {"training", "export"},
    "coach": {"evaluation"},
    "domains": {"coach", "envs"},
    "doctor": {"training"},
    "cli": {"coach", "doctor"},
}
NOT_STYLES = {"distributions", *BASE}  # what simulators may import: they stand beside training, below domains

GROUP = "coachable.domains"  # of the entry points, through which domains are found

# Imports that still point up. Each has to be needed; remove it here when it is gone.
EXCEPTIONS = {
    ("coachable", "coachable.coach.session.session"),  # `CoachSession`, resolved on first use
}


@cache
def allowed(room: str) -> frozenset[str]:
    """Rooms that a room may import, itself among them."""
    if room in BASE:
        return frozenset(BASE)
    if room == "envs":
        return frozenset({"envs", *NOT_STYLES})
    below = [allowed(other) for other in ROOMS[room]]
    return frozenset({room, *BASE}).union(*below)


def room_of(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def module_of(name: str) -> str:
    """The module that an imported name belongs to."""
    return name if name in FILES else name.rpartition(".")[0]


@cache
def imports(module: str) -> list[tuple[str, int, bool]]:
    """Modules of this package that a module imports, with the line and whether that is inside a function."""
    found: list[tuple[str, int, bool]] = []

    def visit(node: ast.AST, inside: bool) -> None:
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}, line {node.lineno}, has a relative import: write it absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        found.extend((module_of(n), node.lineno, inside) for n in names if n.split(".")[0] == "coachable")
        inside = inside or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for child in ast.iter_child_nodes(node):
            visit(child, inside)

    visit(ast.parse(FILES[module].read_text()), inside=False)
    return found


def arrows() -> set[tuple[str, str]]:
    return {(module, other) for module in FILES for other, _, _ in imports(module) if other != "coachable"}


def points_up(module: str, other: str) -> bool:
    if not room_of(module):  # the package itself: its names are resolved on first use
        return room_of(other) not in {*BASE, "styles", "replay", "transforms"}
    return room_of(other) not in allowed(room_of(module))


def test_every_module_has_a_room():
    rooms = {room_of(module) for module in FILES} - {"", "pretrained"}
    assert rooms <= {*ROOMS, *BASE, "envs"}, "give it a place in ROOMS"


def test_imports_point_down():
    """`TYPE_CHECKING` blocks count: a type that points up is a circle, too."""
    up = {arrow for arrow in arrows() if points_up(*arrow)}
    assert sorted(up - EXCEPTIONS) == []
    assert sorted(EXCEPTIONS - up) == [], "these exceptions are needed no more"


def test_no_circle_of_modules():
    """Not even within a room."""
    following = {module: {other for m, other in arrows() - EXCEPTIONS if m == module} for module in FILES}
    done: set[str] = set()

    def walk(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " imports ".join([*path[path.index(module) :], module])
        if module not in done:
            for other in following.get(module, ()):
                if other != module:
                    walk(other, (*path, module))
            done.add(module)

    for module in FILES:
        walk(module, ())


@pytest.mark.parametrize("room", ["domains", "envs"])
def test_a_domain_never_imports_another(room):
    for module, other in arrows():
        if room_of(module) in ("domains", "envs") and room_of(other) == room:
            own, theirs = module.split(".")[2:3], other.split(".")[2:3]
            assert own == theirs or not theirs, f"{module} imports {other}"


def test_only_domains_know_a_domain():
    for module, other in arrows():
        if room_of(other) in ("domains", "envs"):
            assert room_of(module) in ("domains", "envs"), f"{module} imports {other}"


def test_no_two_rooms_have_files_of_one_name():
    """Except the parts that every domain and every simulator has, and `domain`: the type, and the declarations."""
    rooms: dict[str, set[str]] = {}
    for module, path in FILES.items():
        if path.stem not in ("__init__", "domain"):
            room = room_of(module)
            rooms.setdefault(path.stem, set()).add("domains or simulators" if room in ("domains", "envs") else room)
    assert {name: places for name, places in rooms.items() if len(places) > 1} == {}


def test_imports_inside_functions_serve_start_up_or_extras():
    """Of this package; those of optional extras are of other packages."""
    lazy = {
        "coachable",  # `import coachable` is light; its names are imported on first use
        "coachable.cli",  # a command loads what it needs only when it runs
        "coachable.doctor",  # tells of what cannot be imported
        "coachable.coach.page.command",  # the page is up before torch is loaded
        "coachable.coach.page.server",  # its guard needs the extra `ui`
    }
    inside = {module for module in FILES for _, _, inside in imports(module) if inside}
    assert sorted(inside - lazy) == []
    assert sorted(lazy - inside) == [], "these imports moved to the top"


def test_no_names_in_strings_point_up():
    """Names that are imported lazily, read from a file or looked up as resources follow the arrows, too."""
    for module, path in FILES.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Constant) or not isinstance(node.value, str):
                continue
            name = module_of(node.value)
            if node.value == GROUP:
                continue
            if name in FILES and name != "coachable" and (module, name) not in EXCEPTIONS:
                assert not points_up(module, name), f"{module}, line {node.lineno}, names {node.value!r}"


def test_no_module_is_imported_by_a_name_in_a_string():
    """What is imported can be read from import statements."""
    for module, path in FILES.items():
        for node in ast.walk(ast.parse(path.read_text())):
            names = {getattr(node, "id", ""), getattr(node, "attr", ""), getattr(node, "name", "")}
            assert not names & {"import_module", "__import__"}, f"{module} imports a module by its name"


def test_modules_are_short():
    """See docs/architecture.md: most below 300 lines, none above 400."""
    long = {module: lines for module, path in FILES.items() if (lines := path.read_text().count("\n")) > 400}
    assert long == {}
