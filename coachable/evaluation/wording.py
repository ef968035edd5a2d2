"""Names and numbers as text for people."""

from typing import Any


def readable(name: Any) -> str:
    """Return a name with spaces instead of underscores."""
    return str(name).replace("_", " ")


def readable_number(value: float, unit: str = "") -> str:
    """Return a number with three significant digits, or as a whole number from 1000 on, and its unit."""
    number = f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return f"{number} {unit}".rstrip()
