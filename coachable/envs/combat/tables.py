"""Tables of the game (`data/*.csv`), with checks.

The second row of each file gives the origin of each column: `paper` (tables of Appendix C and D) or `ours`.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

ELEMENTS = ("acid", "purgewater", "frost", "shock", "plasma", "fire", "adhesive")
PART_TYPES = ("shield", "weapon", "canister")
KINDS = ("cone", "charge", "ranged", "area")
CLASSES = ("small", "charger", "brute", "titan", "stalker")
PART_SLOTS = 12
ATTACK_SLOTS = 4


@dataclass(frozen=True)
class Table:
    """Contents of a data file.

    Attributes:
        file: Name of the file.
        origin: Origin of the numbers of each column, "paper" or "ours".
        rows: Rows by the text of their first column, each a mapping from column to text.
    """

    file: str
    origin: Mapping[str, str]
    rows: Mapping[str, Mapping[str, str]]

    def fail(self, row: str, problem: str) -> ValueError:
        """Return an error that names file and row."""
        return ValueError(f"coachable/envs/combat/data/{self.file}, row {row!r}: {problem}")

    def number(self, row: str, column: str) -> float:
        """Return a finite or infinite number of the table.

        Raises:
            ValueError: If the cell is not a number.
        """
        text = self.rows[row][column]
        try:
            value = float(text)
        except ValueError:
            raise self.fail(row, f"{column} is {text!r}, expected a number") from None
        if value != value:
            raise self.fail(row, f"{column} is NaN, expected a number")
        return value

    def column(self, name: str) -> list[float]:
        """Return all numbers of a column, in the order of the rows."""
        return [self.number(row, name) for row in self.rows]

    def words(self, row: str, column: str, allowed: tuple[str, ...]) -> tuple[str, ...]:
        """Return the space-separated names of a cell.

        Raises:
            ValueError: If one is not allowed.
        """
        found = tuple(self.rows[row][column].split())
        for word in found:
            if word not in allowed:
                raise self.fail(row, f"{column} has {word!r}, expected some of {allowed}")
        return found


def parse_table(file: str, text: str) -> Table:
    """Parse the text of a data file: a line of column names, a line of origins, and a line per row.

    Raises:
        ValueError: If a row is incomplete or repeated, or an origin is unknown.
    """
    lines = list(csv.reader(text.splitlines()))
    names, origin, rows = lines[0], dict(zip(lines[0][1:], lines[1][1:], strict=False)), {}
    table = Table(file, origin, rows)
    if lines[1][0] != "origin" or set(origin) != set(names[1:]) or not set(origin.values()) <= {"paper", "ours"}:
        raise table.fail("origin", f"expected 'paper' or 'ours' for each of {names[1:]}")
    for cells in lines[2:]:
        if len(cells) != len(names):
            raise table.fail(cells[0] if cells else "", f"{len(cells)} cells, expected {len(names)}: {names}")
        if cells[0] in rows:
            raise table.fail(cells[0], "appears twice")
        rows[cells[0]] = dict(zip(names[1:], cells[1:], strict=True))
    if not rows:
        raise ValueError(f"coachable/envs/combat/data/{file} has no rows")
    return table


@cache
def load_table(name: str) -> Table:
    """Return a table of `data/`, such as "machines"."""
    file = f"{name}.csv"
    return parse_table(
        file, resources.files("coachable.envs.combat").joinpath("data", file).read_text(encoding="utf-8")
    )


@dataclass(frozen=True)
class Machine:
    """A machine type of machines.csv.

    Attributes:
        name: Name in the paper.
        hp: Health [HP].
        strong: Elements of which it takes half the damage.
        weak: Elements of which it takes twice the damage.
        parts: Numbers of removable shields, weapons and canisters.
        kind: Class that determines its attacks.
        radius: Radius of the body [m].
        speed: Speed [m/s].
        threat: Factor of its hits.
        height: Height at which it flies [m].
    """

    name: str
    hp: float
    strong: tuple[str, ...]
    weak: tuple[str, ...]
    parts: tuple[int, int, int]
    kind: str
    radius: float
    speed: float
    threat: float
    height: float

    @property
    def hit(self) -> float:
        """Damage of its unscaled attack [HP]."""
        return 6.0 * self.hp**0.36 * self.threat

    def slots(self) -> tuple[int, int, int]:
        """Return the number of part slots of each type.

        Each type that is present has a slot. Each free slot then goes to the type with the most units per slot.
        """
        slots = [int(count > 0) for count in self.parts]
        while sum(slots) < PART_SLOTS:
            load = [count / slot if slot else 0.0 for count, slot in zip(self.parts, slots, strict=True)]
            if max(load) <= 1:
                break
            slots[load.index(max(load))] += 1
        return slots[0], slots[1], slots[2]


def machines_of(table: Table) -> dict[str, Machine]:
    """Return the machines of a table by name.

    Raises:
        ValueError: If a row is invalid.
    """
    found = {}
    for name in table.rows:
        strong, weak = (table.words(name, column, ELEMENTS) for column in ("strong", "weak"))
        if set(strong) & set(weak):
            raise table.fail(name, f"strong and weak share {sorted(set(strong) & set(weak))}")
        counts = [table.number(name, f"{part}s") for part in PART_TYPES]
        if any(count < 0 or count != int(count) for count in counts):
            raise table.fail(name, f"parts are {counts}, expected whole numbers from 0")
        kinds = table.words(name, "class", CLASSES)
        if len(kinds) != 1:
            raise table.fail(name, f"class is {kinds}, expected one of {CLASSES}")
        values = {column: table.number(name, column) for column in ("hp", "radius", "speed", "threat")}
        for column, value in values.items():
            if not 0 < value < float("inf"):
                raise table.fail(name, f"{column} is {value}, expected a positive number")
        parts = (int(counts[0]), int(counts[1]), int(counts[2]))
        height = table.number(name, "height")
        found[name] = Machine(name, strong=strong, weak=weak, parts=parts, kind=kinds[0], height=height, **values)
    return found


MACHINES: dict[str, Machine] = machines_of(load_table("machines"))
"""The paper's 19 training machines, from the weakest to the strongest."""

UNSEEN_MACHINES: dict[str, Machine] = machines_of(load_table("unseen_machines"))
"""Three machines that are never trained on."""

ALL_MACHINES: dict[str, Machine] = MACHINES | UNSEEN_MACHINES

WEAPONS: tuple[str, ...] = tuple(dict.fromkeys(row["weapon"] for row in load_table("weapons").rows.values()))
"""The six weapons, in the order of the wheel, counter-clockwise from the right."""

AMMO: tuple[tuple[str, ...], ...] = tuple(
    tuple(name for name, row in load_table("weapons").rows.items() if row["weapon"] == weapon) for weapon in WEAPONS
)
"""Ammo of each weapon, in the order of the wheel's sections."""

TRAPS: tuple[str, ...] = tuple(load_table("traps").rows)
SITES: tuple[str, ...] = tuple(load_table("sites").rows)
STYLES: tuple[str, ...] = tuple(load_table("styles").rows)
"""The 18 style weights, in the order of theta, `style_features` and `events`."""


def resistance(machine: Machine) -> list[float]:
    """Return the factor on damage and build-up of each element: 2 if weak, 0.5 if strong, 1 otherwise."""
    return [2.0 if e in machine.weak else 0.5 if e in machine.strong else 1.0 for e in ELEMENTS]


def attacks_of(kind: str) -> list[str]:
    """Return the names of the attacks of a class, one to four.

    Raises:
        ValueError: If there are none or more.
    """
    table = load_table("attacks")
    found = [name for name, row in table.rows.items() if row["class"] == kind]
    if not 1 <= len(found) <= ATTACK_SLOTS:
        raise ValueError(
            f"coachable/envs/combat/data/{table.file}: class {kind!r} has {len(found)} attacks, expected 1 to "
            f"{ATTACK_SLOTS}"
        )
    for name in found:
        if len(table.words(name, "kind", KINDS)) != 1:
            raise table.fail(name, f"expected one kind of {KINDS}")
    return found


def check_styles(styles: Sequence[str] | None) -> tuple[str, ...]:
    """Return the chosen styles in the order given; None chooses all 18.

    Raises:
        ValueError: If one is unknown or repeated, or if there are none.
    """
    chosen = STYLES if styles is None else tuple(styles)
    unknown = [name for name in chosen if name not in STYLES]
    if unknown or not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(f"styles are {styles!r}: expected a list of distinct ones of {list(STYLES)}")
    return chosen
