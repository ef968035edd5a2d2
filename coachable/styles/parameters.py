"""Style parameters of three kinds: `Weight`, `Setpoint` and `Choice`.

A parameter is a plain, frozen declaration. `StyleSpace` converts a list of them into tensors. Sliders, export metadata
and reports read the same declarations.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

# Keywords of `StyleSpace.make`, which a parameter of the same name would shadow.
_RESERVED = frozenset({"strict", "self"})


def _check_name(kind: str, name: str) -> None:
    if not isinstance(name, str) or not name.isidentifier() or name in _RESERVED:
        raise ValueError(
            f"{kind} name {name!r} is not usable: expected a Python identifier such as 'step_length', "
            f"and none of {sorted(_RESERVED)}, because styles are written as space.make(name=value)."
        )


def _check_texts(what: str, **texts: object) -> None:
    for name, text in texts.items():
        if not isinstance(text, str):
            raise ValueError(f"{name} of {what} is {text!r}: expected a text.")


def _check_range(what: str, low: float, high: float) -> None:
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"{what} has the range [{low}, {high}]: expected finite bounds with low < high.")


def _check_inside(what: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{what} is {value}: expected a value inside the range [{low}, {high}].")


class _Numeric:
    """Base of `Weight` and `Setpoint`: one number with a range."""

    name: str
    low: float
    high: float
    unit: str
    help: str
    evaluation: tuple[float, float] | None
    width: ClassVar[int] = 1
    options: ClassVar[tuple[str, ...]] = ()

    def _check(self, kind: str) -> None:
        _check_name(kind, self.name)
        _check_texts(f"{kind} {self.name!r}", unit=self.unit, help=self.help)
        object.__setattr__(self, "low", float(self.low))
        object.__setattr__(self, "high", float(self.high))
        _check_range(f"{kind} {self.name!r}", self.low, self.high)
        if self.evaluation is not None:
            first, last = (float(bound) for bound in self.evaluation)
            object.__setattr__(self, "evaluation", (first, last))
            _check_range(f"evaluation of {kind} {self.name!r}", first, last)
            _check_inside(f"evaluation bound of {kind} {self.name!r}", first, self.low, self.high)
            _check_inside(f"evaluation bound of {kind} {self.name!r}", last, self.low, self.high)

    @property
    def evaluation_range(self) -> tuple[float, float]:
        """Range over which reports vary the parameter: `evaluation` if given, otherwise the whole range."""
        return (self.low, self.high) if self.evaluation is None else self.evaluation


@dataclass(frozen=True)
class Weight(_Numeric):
    """Factor on reward terms: positive values encourage, negative ones discourage, and 0 is neutral and the default.

    Args:
        name: Identifier, unique in the space.
        low: Lowest value ever sampled, at most 0.
        high: Highest value ever sampled, at least 0.
        unit: Unit for sliders and reports, empty if none.
        help: One line that tells a coach what the parameter does.
        evaluation: Range over which reports vary it, inside `[low, high]`; the whole range if None.

    Raises:
        ValueError: If the name is not an identifier, unit or help is not a text, or the range is empty, infinite or
            without 0.

    Examples:
        >>> Weight("melee", -0.375, 7.5, help="Prefer the spear").default
        0.0
    """

    name: str
    low: float
    high: float
    unit: str = ""
    help: str = ""
    evaluation: tuple[float, float] | None = None

    kind: ClassVar[str] = "weight"
    encoding: ClassVar[str] = "max"
    default: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        self._check("Weight")
        if not self.low <= 0.0 <= self.high:
            raise ValueError(
                f"Weight {self.name!r} has the range [{self.low}, {self.high}], which lacks the neutral value 0: "
                "widen the range, or declare a Setpoint."
            )


@dataclass(frozen=True)
class Setpoint(_Numeric):
    """Target or threshold inside a reward term, such as a step length.

    Args:
        name: Identifier, unique in the space.
        low: Lowest value ever sampled.
        high: Highest value ever sampled.
        unit: Unit for sliders and reports.
        help: One line that tells a coach what the parameter does.
        default: Value if the coach gives none; None for the middle of the range.
        encoding: "max": networks see `theta / max(|low|, |high|)`, the paper's f. "range": they see the range mapped to
            `[-1, 1]`, for set-points far from 0 (our choice).
        evaluation: Range over which reports vary it, inside `[low, high]`; the whole range if None.

    Raises:
        ValueError: If the name is not an identifier, unit or help is not a text, the range is empty or infinite, the
            default lies outside, or the encoding is unknown.

    Examples:
        >>> Setpoint("gap", 0.0, 2.0, unit="m").default
        1.0
    """

    name: str
    low: float
    high: float
    unit: str = ""
    help: str = ""
    default: float | None = None
    encoding: str = "max"
    evaluation: tuple[float, float] | None = None

    kind: ClassVar[str] = "setpoint"

    def __post_init__(self) -> None:
        self._check("Setpoint")
        # Rounded, so that the middle of [0.3, 0.6] reads 0.45 and equals an explicit 0.45.
        middle = float(f"{(self.low + self.high) / 2:.12g}")
        default = middle if self.default is None else float(self.default)
        _check_inside(f"default of Setpoint {self.name!r}", default, self.low, self.high)
        object.__setattr__(self, "default", default)
        if self.encoding not in ("max", "range"):
            raise ValueError(f"Setpoint {self.name!r} has the encoding {self.encoding!r}: expected 'max' or 'range'.")


@dataclass(frozen=True)
class Choice:
    """One of several named options, one-hot in theta and in the encoding.

    Args:
        name: Identifier, unique in the space.
        options: At least two distinct names, in the order of the one-hot entries.
        help: One line that tells a coach what the parameter does.
        default: Option if the coach gives none; None for the first.

    Raises:
        ValueError: If the name is not an identifier, help is not a text, options repeat or are too few, or the default
            is not an option.

    Examples:
        >>> Choice("pose", ("front", "t_pose", "up")).width
        3
    """

    name: str
    options: tuple[str, ...]
    help: str = ""
    default: str | None = None

    kind: ClassVar[str] = "choice"
    encoding: ClassVar[str] = "one_hot"
    low: ClassVar[float] = 0.0
    high: ClassVar[float] = 1.0
    unit: ClassVar[str] = ""

    def __post_init__(self) -> None:
        _check_name("Choice", self.name)
        _check_texts(f"Choice {self.name!r}", help=self.help)
        options = (self.options,) if isinstance(self.options, str) else tuple(self.options)
        object.__setattr__(self, "options", options)
        if len(options) < 2 or len(set(options)) != len(options) or not all(isinstance(o, str) and o for o in options):
            raise ValueError(f"Choice {self.name!r} has the options {options}: expected at least two distinct names.")
        if self.default is None:
            object.__setattr__(self, "default", options[0])
        if self.default not in options:
            raise ValueError(f"default of Choice {self.name!r} is {self.default!r}: expected one of {options}.")

    @property
    def width(self) -> int:
        """Number of entries of theta: one per option."""
        return len(self.options)


Parameter = Weight | Setpoint | Choice
