"""Ranges of numbers, and checks with an error message for numbers outside of them."""

import math
import numbers
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Range:
    """Range of valid numbers; NaN is never valid, and infinity only if a closed bound is infinite.

    Args:
        interval: The interval, such as `"[0, 1]"`, `"(0, 1]"` or `"[1, inf)"`; a round bracket excludes the bound.
        whole: Whether only whole numbers are valid.
        optional: Whether `None` is valid, too.

    Example:
        >>> Range("(0, 1]").check("tau", 0.005)
        >>> Range("(0, 1]").check("tau", 2)
        Traceback (most recent call last):
            ...
        ValueError: tau is 2: expected a number in (0, 1]
    """

    interval: str
    whole: bool = False
    optional: bool = False

    def holds(self, value: Any) -> bool:
        """Return whether a value lies in the range."""
        if value is None:
            return self.optional
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            return False
        number, (low, high) = float(value), self._bounds()
        above = number > low if self.interval[0] == "(" else number >= low
        below = number < high if self.interval[-1] == ")" else number <= high
        return above and below and (not self.whole or number.is_integer())

    def check(self, name: str, value: Any) -> None:
        """Refuse a value that is not in the range.

        Args:
            name: Name of the quantity, for the message.
            value: The value.

        Raises:
            ValueError: If it is not in the range; the message names the quantity, the value and the range.
        """
        if not self.holds(value):
            raise ValueError(f"{name} is {value!r}: expected {self}")

    def __str__(self) -> str:
        low, high = self._bounds()
        kind = "a whole number" if self.whole else "a number"
        if math.isinf(low) and math.isinf(high):
            where = "that is finite"
        elif math.isinf(high):
            where = f"{'above' if self.interval[0] == '(' else 'of at least'} {low:g}"
        else:
            where = f"in {self.interval}"
        return f"{kind} {where}{', or None' if self.optional else ''}"

    def _bounds(self) -> tuple[float, float]:
        low, high = self.interval[1:-1].split(",")
        return float(low), float(high)


def around(value: float, low: float, high: float) -> float:
    """Return a number of a circle, such as an angle, in [low, high], whose ends are the same point.

    Example:
        >>> around(190.0, -180.0, 180.0), around(180.0, -180.0, 180.0)
        (-170.0, 180.0)
    """
    return value if low <= value <= high else low + (value - low) % (high - low)


FINITE = Range("(-inf, inf)")
POSITIVE = Range("(0, inf)")
NOT_NEGATIVE = Range("[0, inf)")
SHARE = Range("[0, 1]")
COUNT = Range("[1, inf)", whole=True)
AMOUNT = Range("[0, inf)", whole=True)
