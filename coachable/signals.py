"""`Signal`: the declaration of a block of an observation or of an action, which explanations and contracts read."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Signal:
    """Block of adjacent entries of an observation or an action.

    Args:
        name: Name of the block.
        width: Number of entries.
        unit: What a value of 1 stands for, such as "rad" or "50 m/s", for all entries or for each of them; empty for
            pure numbers.
        entries: Name of each entry; empty if they have none.

    Raises:
        ValueError: If the width is not positive, or units or names do not fit it.

    Example:
        >>> Signal("motion", 2, ("50 m/s", "2 rad/s"), ("speed", "yaw_rate")).label(1)
        'motion: yaw_rate'
    """

    name: str
    width: int
    unit: str | tuple[str, ...] = ""
    entries: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.width < 1:
            raise ValueError(f"signal {self.name!r} has the width {self.width}: expected at least 1")
        units = self.width if isinstance(self.unit, str) else len(self.unit)
        for what, count in (("units", units), ("names", len(self.entries) or self.width)):
            if count != self.width:
                raise ValueError(f"signal {self.name!r} has {count} {what}: expected one for each of {self.width}")

    def label(self, index: int) -> str:
        """Return the name of an entry, with that of the block."""
        if self.entries:
            return f"{self.name}: {self.entries[index]}"
        return self.name if self.width == 1 else f"{self.name}, entry {index + 1} of {self.width}"

    def unit_of(self, index: int) -> str:
        """Return what a value of 1 of an entry stands for."""
        return self.unit if isinstance(self.unit, str) else self.unit[index]


def entry_names(signals: Sequence[Signal]) -> list[str]:
    """Return the name of every entry of adjacent blocks, in order."""
    return [signal.label(index) for signal in signals for index in range(signal.width)]
