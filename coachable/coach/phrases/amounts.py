"""Values of numeric parameters from requests such as "0.4 m", "a bit longer", "twice as much" or "avoid"."""

from itertools import pairwise
from typing import cast

from coachable.coach.phrases.segments import Segment
from coachable.coach.phrases.vocabulary import (
    ANGLE,
    ANY,
    LEVELS,
    PERCENT,
    PLAINLY,
    SLIGHTLY,
    STRONGLY,
    TURNS,
    UNITS,
    is_own_unit,
    own_unit,
    stem,
)
from coachable.evaluation.wording import readable
from coachable.ranges import around
from coachable.styles import Choice, Setpoint, Weight

Last = tuple[tuple[str, ...], float]  # parameters and direction of a change

_OF_VERBS = frozenset(("up", "down"))  # such as "speed up" or "calm down"
_QUALITY = 0.85  # share of the range that an adjective such as "careful" asks for


def amount(p: Weight | Setpoint, segment: Segment, now: float, last: Last | None, spent: bool = False) -> float | str:
    """Return the value that a request asks for.

    Args:
        p: The parameter that is changed.
        segment: The request.
        now: Value in force.
        last: The last change, to which "a bit more" refers.
        spent: Whether the parameter rewards saving what it is named after, so that "less fuel" asks for more of it.

    Returns:
        The value, which may lie outside the range if the request contains a number; or, as text, what is missing.
    """
    if segment.direction is not None and segment.direction[0] == ANGLE != dimension_of(p):
        return f"{readable(p.name)} has no left and right"
    said = segment.direction[0] if segment.direction is not None else segment.dimension
    if ANY not in (said, own := dimension_of(p)) and said != own and segment.number is None:
        return _not_a(said, p)
    compared = segment.too or (segment.negated and "so" in segment.words)
    compared |= any(part is not None for part in (segment.direction, segment.level, segment.factor))
    sense = segment.sense or (-1 if spent and compared else 0)
    sign = _sign(segment, p, last, sense)
    if segment.number is not None:
        return _given(p, segment, now, sign, sense)
    if segment.keep and sign is None and not segment.explicit:
        return now
    verb = sense and not _OF_VERBS.isdisjoint(segment.words)
    if segment.negated and (segment.direction is not None or verb):
        return now  # "not longer" and "do not slow down" ask for no change
    if segment.factor is not None:
        grows = segment.factor < 1.0 and sign is not None and sign > 0.0 and "by" in segment.words
        factor = 1.0 + segment.factor if grows else segment.factor  # "increase by half"
        return now / factor if sense < 0 else now * factor
    if sign is not None:
        return _moved(p, segment, now, sign)
    if segment.level is not None:
        if spent and not segment.sense and not segment.preferred:
            return f"save {readable(p.name)}, or use it?"
        return _level(p, 1.0 - segment.level if sense < 0 else segment.level, segment.degree)
    if segment.default and not segment.negated:
        return cast(float, p.default)  # declared, or derived when the parameter was made: never None
    if isinstance(p, Weight):
        return _weight(p, segment, spent)
    if sense:
        return _level(p, _QUALITY if (sense > 0) != segment.negated else 1.0 - _QUALITY, segment.degree)
    return f"how much? {readable(p.name)} goes from {p.low:g} to {p.high:g} {p.unit}".rstrip()


def dimension_of(parameter: Weight | Setpoint | Choice) -> str:
    """Return the dimension of a parameter's unit, such as "length"; "" if it has no known unit."""
    return UNITS.get(stem(parameter.unit), (ANY, 1.0))[0] if parameter.unit else ANY


def wrapped(p: Weight | Setpoint | Choice, value: float) -> float:
    """Return the equivalent angle in the range of a full-circle parameter; return other values unchanged."""
    return around(value, p.low, p.high) if _is_circle(p) else value


def _is_circle(p: Weight | Setpoint | Choice) -> bool:
    return p.unit == "deg" and p.high - p.low == 360.0


def _sign(segment: Segment, p: Weight | Setpoint, last: Last | None, sense: int) -> float | None:
    """Return +1 or -1 for a change relative to the value in force, or None for an absolute request."""
    same = last is not None and p.name in last[0]
    of_the_unit = segment.dimension != ANY != dimension_of(p)  # "closer" means closer, also after "careful"
    turn = -1.0 if sense < 0 and not of_the_unit else 1.0
    if segment.direction is not None:
        dimension, sign = segment.direction
        if last is not None and same and segment.repeated and dimension == ANY and not segment.mentions:
            return sign * last[1]  # "a bit more" of what was asked before
        for more, adjective in pairwise(segment.words):
            if more in ("more", "less") and adjective in LEVELS and LEVELS[adjective][1] < 0.5:
                turn = -turn  # "less short"
        return sign * turn
    if segment.level is not None:
        relative = (segment.too or segment.negated) and segment.level != 0.5
        return (-turn if segment.level > 0.5 else turn) if relative else None
    if segment.mentions and not segment.explicit and (segment.too or (segment.negated and "so" in segment.words)):
        return -turn  # "too much fire", "not so careful"
    return last[1] if last is not None and same and segment.repeated else None


def _moved(p: Weight | Setpoint, segment: Segment, now: float, sign: float) -> float:
    degree = segment.degree or (SLIGHTLY if segment.negated else PLAINLY)
    if _is_circle(p):
        return now + sign * TURNS[degree] * 360.0
    width = p.high - p.low
    moved = min(max(now + sign * degree * width, p.low), p.high)
    return moved if abs(moved) > 1e-6 * width else 0.0  # a style in float32 leaves a remainder


def _level(p: Weight | Setpoint, share: float, degree: float) -> float:
    """Return the value of an adjective, such as "short" or "very short", at a share of the range."""
    if degree == STRONGLY and share != 0.5:
        share = float(round(share))
    elif degree == SLIGHTLY:
        share = 0.5 + (share - 0.5) / 2
    return share * p.high if isinstance(p, Weight) else p.low + share * (p.high - p.low)


def _weight(p: Weight, segment: Segment, spent: bool) -> float:
    """Return the value of a weight that is only named: "fire", "a bit of fire", "avoid fire", "save fuel"."""
    if segment.negated and not segment.sense and not spent:
        return p.low
    if segment.negated and segment.preferred and spent and not segment.sense:
        return p.high  # "without using fuel"
    if segment.negated != (segment.sense < 0):
        return 0.0
    return p.high / 4 if segment.degree == SLIGHTLY else p.high


def _given(p: Weight | Setpoint, segment: Segment, now: float, sign: float | None, sense: int) -> float | str:
    """Return the value of a request that contains a number, or what is missing."""
    assert segment.number is not None
    number, unit = segment.number
    if segment.negated:
        return "say what instead"
    if sign is None and sense and "by" in segment.words:
        sign = float(sense)
    if sense < 0 and sign is None and not unit:
        return f"on which scale? {readable(p.name)} goes from {p.low:g} to {p.high:g} {p.unit}".rstrip()
    if unit in PERCENT:
        if sign is not None and not segment.absolute:
            return now * (1 + sign * number / 100)
        share = number / 100
        return p.low + (p.high - p.low) * (1.0 - share if sense < 0 else share)
    if is_own_unit(unit) and unit != own_unit(p.unit):
        return f"{readable(p.name)} {f'is in {p.unit}' if p.unit else 'has no unit'}"
    if unit in UNITS:
        if dimension_of(p) != UNITS[unit][0]:
            return _not_a(UNITS[unit][0], p)
        number = number * UNITS[unit][1] / UNITS[stem(p.unit)][1]
    if segment.signed or (number < 0 and p.low >= 0):
        return now + number
    if sign is not None and not segment.absolute and segment.level is None:
        return now + sign * number
    return float(f"{number:.9g}")


def _not_a(dimension: str, p: Weight | Setpoint) -> str:
    article = "an" if dimension == ANGLE else "a"
    return f"{readable(p.name)} is not {article} {dimension}{f', it is in {p.unit}' if p.unit else ''}"
