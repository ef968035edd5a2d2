"""Names and numbers as text for people, and which measures tell about which parameter."""

from collections.abc import Iterable, Mapping
from typing import Any

from coachable.domain import Domain
from coachable.styles import StyleSpace


def readable(name: Any) -> str:
    """Return a name with spaces instead of underscores."""
    return str(name).replace("_", " ")


def readable_number(value: float, unit: str = "") -> str:
    """Return a number with three significant digits, or as a whole number from 1000 on, and its unit if it has one."""
    number = f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"
    return f"{number} {unit}".rstrip()


def with_unit(name: str, unit: str) -> str:
    """Return a name with its unit, such as "speed [m/s]", or without if the unit is empty."""
    return f"{name} [{unit}]" if unit else name


def counted(count: int, noun: str) -> str:
    """Return a number of things, given in the singular, such as "1 episode" or "20 episodes"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def measures_by_parameter(
    space: StyleSpace, names: Iterable[str], beside: Mapping[str, str] | None = None
) -> dict[str, list[str]]:
    """Group measures by the parameter that they belong to; those of no parameter are listed under "".

    A measure belongs to the parameter whose name is part of its own, word by word: `pose_held` to `pose`,
    `damage_melee` to `melee`. Of several such parameters, the one with the longest name is chosen.

    Args:
        space: The style space.
        names: Names of the measures.
        beside: Parameters by measure where the names do not tell, as `Domain.beside`. These measures come first.

    Example:
        >>> from coachable.styles import Setpoint
        >>> measures_by_parameter(StyleSpace([Setpoint("gap", 0, 2)]), ["gap", "gap_error", "speed"])
        {'gap': ['gap', 'gap_error'], '': ['speed']}
    """
    groups: dict[str, list[str]] = {name: [] for name in space.names} | {"": []}
    by_length, known = sorted(space.names, key=len, reverse=True), beside or {}
    for measure in sorted(names, key=lambda name: name not in known):  # stable, so otherwise in the given order
        owner = next((name for name in by_length if f"_{name}_" in f"_{measure}_"), "")
        groups[known.get(measure, owner)].append(measure)
    return groups


def unit_of(domain: Domain, space: StyleSpace, name: str) -> str:
    """Return the unit of a measure: the domain's, or that of the parameter that the measure or its error belongs to."""
    parameter = name.removesuffix("_error")
    return domain.units.get(name) or (space[parameter].unit if parameter in space else "")


def units_of(domain: Domain, space: StyleSpace, columns: Mapping[str, str]) -> dict[str, str]:
    """Return the units of a table's columns, without those that have none, such as shares.

    Names of columns, by which formats are given, may begin with `measured_`.
    """
    names = [name for name, form in columns.items() if not form.endswith("%")]
    units = {name: unit_of(domain, space, name.removeprefix("measured_")) for name in names}
    return {name: unit for name, unit in units.items() if unit}


def heading_of(domain: Domain, space: StyleSpace, column: str, form: str = "") -> str:
    """Return the heading of a published column with its unit, such as "power [W]"; see `units_of`."""
    name = column.removeprefix("measured_")
    text = f"measured {domain.words.name(name)}" if name != column else domain.words.name(name)
    return with_unit(text, units_of(domain, space, {column: form}).get(column, ""))


def measured_text(domain: Domain, space: StyleSpace, name: str, value: float) -> str:
    """Return a measured value with its unit, in the format in which the domain publishes it, or with three digits."""
    form = domain.columns.get(name, domain.columns.get(f"measured_{name}", ""))
    if form.endswith("%"):
        return format(value, form)
    unit = unit_of(domain, space, name)
    return f"{format(value, form)} {unit}".rstrip() if form else readable_number(value, unit)
