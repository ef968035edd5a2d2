"""The links of the documentation lead somewhere, and the commands that it prints name what exists."""

import argparse
import ast
import importlib.util
import re
import shlex
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from coachable.cli import _parser
from coachable.domain import domain_names, load_domain

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = ROOT / "recipes" / "configs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINKED = [
    *PAGES,
    ROOT / "CHANGELOG.md",
    ROOT / "SECURITY.md",
    *sorted((ROOT / "coachable").glob("pretrained/*/MODEL_CARD.md")),
]
RECIPES = sorted(path.stem for path in (ROOT / "recipes").glob("*.py") if (CONFIGS / f"{path.stem}.yaml").is_file())

_FENCE = re.compile(r"^```(\{?[\w-]*\}?)[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^)\s]+)\)")
_ADDRESS = re.compile(r"\b[a-z][a-z0-9+.-]*://[^\s<>\"'`\])]+", re.IGNORECASE)
_LOCAL = ("localhost", "127.0.0.1")
_PROGRAMS = ("python", "python3", "coachable", "pytest")


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def anchors(page: Path) -> set[str]:
    """The fragments of a page's headings, made as GitHub makes them."""
    text = _FENCE.sub("", page.read_text())
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(page: Path) -> list[str]:
    broken = []
    for target in _LINK.findall(_FENCE.sub("", page.read_text())):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, fragment = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        if not found.exists() or (fragment and found.suffix == ".md" and fragment not in anchors(found)):
            broken.append(target)
    return broken


def addresses(text: str) -> set[str]:
    """The addresses on other machines that a text contains."""
    found = {address.rstrip(".,;:") for address in _ADDRESS.findall(text)}
    return {address for address in found if urlsplit(address).hostname not in _LOCAL}


def is_valid(address: str) -> bool:
    """Whether an address is one of https, with the full name of a host and nothing before or after it."""
    return re.match(r"https://([a-z0-9-]+\.)+[a-z]{2,}(/|$)", address) is not None


def spellings(found: set[str]) -> dict[str, set[str]]:
    """Addresses by what they lead to, where there is more than one of them."""
    same: dict[str, set[str]] = {}
    for address in found:
        url = urlsplit(address.lower())
        key = url.netloc.removeprefix("www.") + url.path.removesuffix(".git").rstrip("/")
        same.setdefault(f"{key}?{url.query}", set()).add(address.partition("#")[0])
    return {key: written for key, written in same.items() if len(written) > 1}


def commands(text: str) -> Iterator[list[str]]:
    """The commands of a shell script as lists of words, without the variables that are set for them."""
    for line in text.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars=";&|<>")
        lexer.whitespace_split = True
        command: list[str] = []
        for word in [*lexer, ";"]:
            if word in ("do", "done", "then") or not set(word) - set(";&|<>"):
                if command:
                    yield command
                command = []
            elif command or not re.fullmatch(r"\w+=.*", word):
                command.append(word.removeprefix(".venv/bin/") if not command else word)


def printed_commands(page: Path) -> list[list[str]]:
    """The commands of a page, in its blocks of shell and between its backticks."""
    text = page.read_text()
    scripts = [body for language, body in _FENCE.findall(text) if language in ("bash", "sh", "")]
    spans = re.findall(r"`([^`\n]+)`", _FENCE.sub("", text))
    scripts += [span for span in spans if re.match(r"(\.venv/bin/)?(python|coachable|pytest) \S", span)]
    return [command for script in scripts for command in commands(script) if command[0] in _PROGRAMS]


def shown_commands(recipe: str) -> list[list[str]]:
    """The commands at the head of a recipe; what explains a command stands more than two spaces away from it."""
    text = ast.get_docstring(ast.parse((ROOT / "recipes" / f"{recipe}.py").read_text())) or ""
    lines = [re.split(r"\s{3,}", line)[0] for line in text.splitlines() if line.startswith("python ")]
    return [shlex.split(line) for line in lines]


def mistake_in(command: list[str]) -> str | None:
    """What a command names that does not exist; None if nothing."""
    program, *words = command
    if program == "coachable":
        return mistake_in_options(words)
    if program == "pytest" or words[:2] == ["-m", "pytest"]:
        files = [word for word in words if word.endswith(".py")]
        return next((f"there is no {file}" for file in files if not (ROOT / file).is_file()), None)
    if words[0] == "-m":
        exists = words[1] in ("venv", "pip") or importlib.util.find_spec(words[1])
        return None if exists else f"there is no module {words[1]}"
    script = ROOT / words[0]
    if not script.is_file():
        return f"there is no {words[0]}"
    return mistake_in_overrides(script.stem, words[1:]) if script.parent.name == "recipes" else None


def mistake_in_options(words: list[str]) -> str | None:
    """Of `coachable`: a sub-command, a format, or an option that neither it nor the domain has."""
    (subcommands,) = (a for a in _parser()._actions if isinstance(a, argparse._SubParsersAction))
    if words[0] not in subcommands.choices:
        return f"there is no sub-command {words[0]}"
    if words[0] == "export" and words[1:] and words[1] not in ("onnx", "web"):
        return f"export has no format {words[1]}"
    known = {*subcommands.choices[words[0]]._option_string_actions}
    source = words[2:3] if words[:2] == ["export", "web"] else words[1:2]
    for domain in {*source} & {*domain_names()} if words[0] in ("coach", "evaluate", "export") else ():
        known |= {f"--{option.name}" for option in load_domain(domain).env_options}
    options = [word.partition("=")[0] for word in words if word.startswith("--")]
    return next((f"{words[0]} has no option {option}" for option in options if option not in known), None)


def mistake_in_overrides(recipe: str, words: list[str]) -> str | None:
    """Of a recipe: a choice that a group does not have."""
    if recipe not in RECIPES:
        return f"{recipe} has no configuration in {name_of(CONFIGS)}"
    for word in words:
        key, equals, choice = word.lstrip("+").partition("=")
        folder = CONFIGS / key / (recipe if key == "preset" else "")
        if equals and "$" not in choice and folder.is_dir() and not (folder / f"{choice}.yaml").is_file():
            return f"{recipe} has no {key}={choice}"
    return None


def test_pages_and_recipes_were_found():
    assert len(PAGES) > 10 and len(RECIPES) > 4
    assert sum(len(printed_commands(page)) for page in PAGES) > 50


@pytest.mark.parametrize("page", LINKED, ids=name_of)
def test_links_and_pictures_exist(page):
    assert broken_links(page) == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_printed_commands_name_what_exists(page):
    mistakes = {shlex.join(command): mistake_in(command) for command in printed_commands(page)}
    assert {command: mistake for command, mistake in mistakes.items() if mistake} == {}


@pytest.mark.parametrize("recipe", RECIPES)
def test_commands_of_recipes_name_what_exists(recipe):
    found = shown_commands(recipe)
    assert found
    assert [mistake_in(command) for command in found] == [None] * len(found)


def test_every_preset_and_every_choice_of_a_group_is_described():
    page = (ROOT / "docs" / "configuration.md").read_text()
    choices = [file.stem for file in CONFIGS.glob("*/**/*.yaml")]
    assert len(choices) > 30
    assert [choice for choice in choices if f"`{choice}`" not in page] == []


@pytest.mark.parametrize(
    "line, mistake",
    [
        ("python recipes/humanoid_sac.py preset=smoke loss=qr_sac", None),
        ("for s in 0 1; do python recipes/rare_targets.py seed=$s replay=$2; done", None),
        ("A=1 python recipes/racing_qr_sac.py preset=nothing", "racing_qr_sac has no preset=nothing"),
        ("python recipes/racing_qr_sac.py loss=nothing", "racing_qr_sac has no loss=nothing"),
        ("python recipes/nothing.py", "there is no recipes/nothing.py"),
        ("python benchmarks/loop.py && python benchmarks/nothing.py", "there is no benchmarks/nothing.py"),
        ("python -m coachable.nothing", "there is no module coachable.nothing"),
        ("coachable curves a='runs/*' --out x.png", None),
        ("coachable nothing", "there is no sub-command nothing"),
        ("coachable coach humanoid --nothing", "coach has no option --nothing"),
        ("coachable export web racing_drift --track own.csv", None),
        ("coachable export web humanoid --track own.csv", "export has no option --track"),
        ("coachable export humanoid", "export has no format humanoid"),
    ],
)
def test_mistakes_are_found(line, mistake):
    *_, last = (command for command in commands(line) if command[0] in _PROGRAMS)
    assert mistake_in(last) == mistake


def test_every_reason_not_to_run_a_command_is_some_commands_reason():
    from tests.printed_commands import NOT_RUN, documented_commands, reason_not_to_run

    given = {reason_not_to_run(command) for command in documented_commands()}
    assert given == set(NOT_RUN.values())


def test_broken_links_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# One, two\n[a](#one-two) [b](#three) ![c](none.png) [d](https://example.org) [e](page.md)\n")
    assert broken_links(page) == ["#three", "none.png"]


def test_addresses_are_valid_and_each_is_written_in_one_way():
    found = set().union(*(addresses(page.read_text()) for page in LINKED))
    assert found
    assert [address for address in sorted(found) if not is_valid(address)] == []
    assert spellings(found) == {}


def test_wrong_addresses_are_found():
    found = addresses("[a](http://a.org/b), https://a.org/b/. <https://me@c.org> `https://d` http://localhost:8000/e")
    assert found == {"http://a.org/b", "https://a.org/b/", "https://me@c.org", "https://d"}
    assert {address for address in found if not is_valid(address)} == found - {"https://a.org/b/"}
    assert spellings(found) == {"a.org/b?": {"http://a.org/b", "https://a.org/b/"}}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_printed_extras_exist(page):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    printed = {
        name for names in re.findall(r"'(?:\.|coachable)\[([\w,]+)\]'", page.read_text()) for name in names.split(",")
    }
    assert printed <= set(project["optional-dependencies"])


@pytest.mark.parametrize("page", ["docs/quickstart.md", "docs/guides/add_a_loss.md"])
def test_printed_programs_run(page, capsys):
    blocks = [body for language, body in _FENCE.findall((ROOT / page).read_text()) if language == "python"]
    exec("\n".join(blocks), {"__name__": "page"})
