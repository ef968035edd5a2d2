"""Mutation testing: how many one-token changes of the library do the tests of their own package notice?

    python -m tests.mutation --count 300 --seed 1 [--package losses] [--module coachable/losses/policy.py]

cosmic-ray proposes the changes; this script draws `count` of them at random places, equally many in every package,
and runs the tests of that package against each, those closest to the changed module first, until one fails. A mutant
lives in a forked process that has torch already, so that no file is touched and no import of torch is paid for. The
survivors are listed at the end: each is either equivalent to the original or lacks a test.
"""

import argparse
import ast
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import itertools
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("styles", "networks", "losses", "transforms", "replay", "training")
PACKAGES += ("distributions", "fast", "envs/racing", "envs/combat", "envs/humanoid")
PACKAGES += ("domains/racing", "domains/combat", "domains/humanoid")

# Pictures, the page's words, and tables of numbers, whose tests could only repeat them.
LEFT_OUT = ("render", "domain", "domains", "constants", "tables", "garage", "circuits")

# Replacements that keep the types of their operands; most others raise an error as soon as they run.
SWAPS = {"Add": "Sub", "Mul": "Div", "FloorDiv": "Mod", "BitAnd": "BitOr", "LShift": "RShift", "Pow": "Mul"}
SWAPS = {f"{a}_{b}" for a, b in SWAPS.items()} | {f"{b}_{a}" for a, b in SWAPS.items() if a != "Pow"}
SWAPS |= {f"{a}_{b}" for a in ("Lt", "LtE", "Gt", "GtE") for b in ("Lt", "LtE", "Gt", "GtE") if a != b}
SWAPS |= {"Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is"}
OTHERS = (
    "AddNot",
    "True",
    "False",
    "AndWithOr",
    "OrWithAnd",
    "Break",
    "Continue",
    "NumberReplacer",
    "Unary",
    "ZeroIter",
)

# Loaded before the fork. Nothing of ours may be among them, nor plugins of pytest, whose assertions it rewrites.
PRELOADED = ("torch", "torchrl.collectors", "torchrl.envs", "torchrl.objectives", "tensordict.nn", "scipy.stats")
PRELOADED += ("matplotlib.pyplot", "pytest", "_pytest.assertion.rewrite")

OWN_FAULT = 70  # status of a child in which pytest itself did not come to an end


class Mutant(NamedTuple):
    """A change of one token, and where it is."""

    path: str
    line: int
    column: int
    operator: str
    occurrence: int

    def source(self) -> str:
        """Return the changed source."""
        changed = mutate_code((ROOT / self.path).read_text(), get_operator(self.operator)(), self.occurrence)
        assert changed is not None
        return changed

    def __str__(self) -> str:
        before = (ROOT / self.path).read_text().splitlines()
        after = self.source().splitlines()
        changed = [(old, new) for old, new in zip(before, after, strict=False) if old != new]
        old, new = changed[0] if changed else (before[self.line - 1], "?")
        return f"{self.path}:{self.line}: {old.strip()}  ->  {new.strip()}"


def operators() -> list[str]:
    """List the names of the cosmic-ray operators that are used."""
    chosen = []
    for name in operator_names():
        kind, _, swap = name.partition("Operator_")
        swapped = ("Binary" in kind or "Comparison" in kind) and swap in SWAPS
        other = not swap and any(part in name for part in OTHERS)
        if swapped or other or ("Unary" in kind and "Delete" in name):
            chosen.append(name)
    return chosen


def untouched(tree: ast.AST) -> Iterator[ast.AST]:
    """Find the nodes whose changes nothing can notice: annotations, texts of errors, mere guards."""
    for node in ast.walk(tree):
        match node:
            case ast.arg() | ast.AnnAssign() if node.annotation:
                yield node.annotation
            case ast.FunctionDef() if node.returns:
                yield node.returns
            case ast.JoinedStr():
                yield node
            case ast.keyword() if node.arg in ("strict", "frozen"):  # guards that fire only where another fault is
                yield node.value
            case ast.If() if "TYPE_CHECKING" in ast.dump(node.test):
                yield node


def mutants(path: str) -> list[Mutant]:
    """List all mutants of a module."""
    source = (ROOT / path).read_text()
    tree = ast.parse(source)
    columns = [line.encode() for line in source.splitlines()]

    def place(line: int, column: int) -> tuple[int, int]:
        """Convert a column that ast counts in bytes into one that parso counts in characters."""
        return line, len(columns[line - 1][:column].decode())

    def span(start: ast.expr, end: ast.expr) -> tuple[tuple[int, int], tuple[int, int]]:
        return place(start.lineno, start.col_offset), place(end.end_lineno, end.end_col_offset)  # pyright: ignore

    closed = [span(node, node) for node in untouched(tree)]  # pyright: ignore
    binary = [(span(n.left, n.left)[1], span(n.right, n.right)[0]) for n in ast.walk(tree) if isinstance(n, ast.BinOp)]
    nodes, found = list(ast_nodes(get_ast(source))), []
    for name in operators():
        operator, occurrence = get_operator(name)(), 0
        for node in nodes:
            for start, _ in operator.mutation_positions(node):
                if not any(a <= start < b for a, b in closed) and (
                    "Binary" not in name or any(a <= start < b for a, b in binary)
                ):
                    found.append(Mutant(path, *start, name, occurrence))
                occurrence += 1
    return found


def modules(package: str) -> list[str]:
    """List the modules of a package that are mutated."""
    folder = ROOT / "coachable" / package
    paths = [path for path in sorted(folder.rglob("*.py")) if not {path.stem, path.parent.name} & set(LEFT_OUT)]
    return [str(path.relative_to(ROOT)) for path in paths if path.stem != "__init__"]


def draw(package: str, count: int, seed: int, only: str | None = None) -> list[Mutant]:
    """Draw places at random, and one change at each."""
    places: dict[tuple[str, int, int], list[Mutant]] = {}
    for path in modules(package):
        if only in (None, path):
            for mutant in mutants(path):
                places.setdefault(mutant[:3], []).append(mutant)
    chance = random.Random(f"{package} {seed}")
    drawn = []
    for key in chance.sample(sorted(places), len(places)):
        mutant = chance.choice(places[key])
        if len(drawn) < count and compiles(mutant):
            drawn.append(mutant)
    return drawn


def compiles(mutant: Mutant) -> bool:
    """Return whether the changed source is Python."""
    try:
        compile(mutant.source(), mutant.path, "exec", dont_inherit=True)
    except SyntaxError:
        return False
    return True


def test_files(package: str, path: Path) -> list[str]:
    """List the test files of a package, those closest to a module first."""
    dotted = ".".join(path.with_suffix("").parts)

    def distance(file: Path) -> tuple[bool, bool, int]:
        return path.stem not in file.stem, dotted not in file.read_text(), file.stat().st_size

    files = sorted((ROOT / "tests" / package).glob("test_*.py"), key=distance)
    return [str(file.relative_to(ROOT)) for file in files]


class Loader(importlib.machinery.SourceFileLoader, importlib.abc.MetaPathFinder):
    """Imports one module from changed source."""

    def __init__(self, mutant: Mutant) -> None:
        self.module = ".".join(Path(mutant.path).with_suffix("").parts)
        self.changed = mutant.source()
        super().__init__(self.module, str(ROOT / mutant.path))

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> object:
        """Offer the changed module."""
        if fullname != self.module:
            return None
        return importlib.util.spec_from_file_location(fullname, self.path, loader=self)

    def get_code(self, fullname: str) -> object:
        """Compile the changed source."""
        return compile(self.changed, self.path, "exec", dont_inherit=True)


def run_tests(mutant: Mutant | None, files: list[str]) -> int:
    """Run the tests in this process, which ends afterwards. Without a mutant, run them on the library as it is."""
    import pytest

    if mutant is not None:
        loader = Loader(mutant)
        sys.meta_path.insert(0, loader)  # pyright: ignore

    class InOneProcess:
        """Skips tests where they start another process, which would not see the mutant."""

        @pytest.fixture(autouse=True)
        def _no_subprocess(self, monkeypatch: pytest.MonkeyPatch) -> None:
            monkeypatch.setattr(subprocess.Popen, "__init__", lambda *_, **__: pytest.skip("not the mutant"))

    quick = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:benchmark"]
    return int(pytest.main([*quick, *files], plugins=[InOneProcess()]))


def fork(mutant: Mutant | None, files: list[str], limit: float, log: Path) -> int | None:
    """Run tests in a child process. Returns the status of pytest, or None after `limit` seconds."""
    child = os.fork()
    if child == 0:
        status = OWN_FAULT
        try:
            os.setsid()
            output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(output, 1)
            os.dup2(output, 2)
            status = run_tests(mutant, files)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    deadline = time.monotonic() + limit
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def main() -> None:
    """Draw mutants, run their tests, and print what survived."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100, help="number of mutants")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--package", choices=PACKAGES, action="append", help="one or more of them; all by default")
    parser.add_argument("--module", help="path of the only module to change")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds per mutant")
    parser.add_argument("--check", action=argparse.BooleanOptionalAction, default=True, help="first without a change")
    chosen = parser.parse_args()
    packages = chosen.package or list(PACKAGES)
    os.chdir(ROOT)
    for name in PRELOADED:
        importlib.import_module(name)
    assert not any(name.split(".")[0] == "coachable" for name in sys.modules)
    if chosen.check:
        for package in packages:
            with tempfile.NamedTemporaryFile() as log:
                if fork(None, test_files(package, Path(package)), 10 * chosen.timeout, Path(log.name)) != 0:
                    text = Path(log.name).read_text(errors="replace")
                    raise SystemExit(f"the tests of {package} fail without any change:\n{text[-2000:]}")
    shares = {
        name: chosen.count // len(packages) + (i < chosen.count % len(packages)) for i, name in enumerate(packages)
    }
    drawn = [[(name, m) for m in draw(name, share, chosen.seed, chosen.module)] for name, share in shares.items()]
    killed, survivors = dict.fromkeys(packages, 0), {name: [] for name in packages}
    # One of each package in turn, so that a run that is stopped early has been fair to all.
    for package, mutant in filter(None, itertools.chain.from_iterable(itertools.zip_longest(*drawn))):
        start = time.monotonic()
        with tempfile.NamedTemporaryFile() as log:
            status = fork(mutant, test_files(package, Path(mutant.path)), chosen.timeout, Path(log.name))
            last = re.findall(r"^(?:FAILED|ERROR) (\S+)", Path(log.name).read_text(errors="replace"), re.MULTILINE)
        if status == 0:
            survivors[package].append(mutant)
        else:
            killed[package] += 1
        if status == OWN_FAULT:
            raise RuntimeError(f"the tests of {mutant} could not be started")
        by = "timeout" if status is None else last[0] if last else f"status {status}"
        verdict = "SURVIVED" if status == 0 else f"killed by {by}"
        print(f"{package}: {mutant}  [{verdict}, {time.monotonic() - start:.0f} s]", flush=True)
    print()
    for package in packages:
        count = killed[package] + len(survivors[package])
        print(f"{package:14} {killed[package]:4} of {count:4} killed")
    total = sum(killed.values()), sum(killed.values()) + sum(map(len, survivors.values()))
    print(f"{'all':14} {total[0]:4} of {total[1]:4} killed ({total[0] / max(total[1], 1):.0%})\n\nSurvivors:")
    for package in packages:
        for mutant in survivors[package]:
            print(mutant)


if __name__ == "__main__":
    main()
