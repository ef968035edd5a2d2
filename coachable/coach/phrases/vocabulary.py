"""English vocabulary of the phrase box, and the tokeniser."""

import re
from collections.abc import Iterable, Iterator

# How far a comparative moves a parameter, as a share of its range.
SLIGHTLY, PLAINLY, STRONGLY = 0.1, 0.2, 0.4
# The same for left and right, as a share of a full circle of 360 degrees.
TURNS = {SLIGHTLY: 1 / 24, PLAINLY: 1 / 8, STRONGLY: 1 / 4}

LENGTH, SPEED, ANGLE, TIME, ANY = "length", "speed", "angle", "time", ""

# Unit to dimension and factor to the dimension's SI unit.
UNITS = {
    **dict.fromkeys(("m", "metre", "meter"), (LENGTH, 1.0)),
    **dict.fromkeys(("cm", "centimetre", "centimeter"), (LENGTH, 0.01)),
    **dict.fromkeys(("mm", "millimetre", "millimeter"), (LENGTH, 0.001)),
    **dict.fromkeys(("km", "kilometre", "kilometer"), (LENGTH, 1000.0)),
    **dict.fromkeys(("ft", "foot", "feet"), (LENGTH, 0.3048)),
    **dict.fromkeys(("inch", "inche"), (LENGTH, 0.0254)),
    "m/s": (SPEED, 1.0),
    **dict.fromkeys(("km/h", "kmh", "kph"), (SPEED, 1 / 3.6)),
    "mph": (SPEED, 0.44704),
    **dict.fromkeys(("deg", "degree", "°"), (ANGLE, 0.017453292519943295)),
    **dict.fromkeys(("rad", "radian"), (ANGLE, 1.0)),
    **dict.fromkeys(("s", "sec", "second"), (TIME, 1.0)),
    "ms": (TIME, 0.001),
}
PERCENT = ("%", "percent")


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_DIRECTIONS: dict[tuple[str, float], str] = {
    (ANY, +1): "more bigger larger higher greater stronger increase raise boost up",
    (ANY, -1): "less fewer smaller lower weaker decrease reduce cut down",
    (LENGTH, +1): "longer wider further farther lengthen widen extend stretch",
    (LENGTH, -1): "shorter narrower closer tighter shorten narrow shrink tighten",
    (SPEED, +1): "faster quicker accelerate hurry",
    (SPEED, -1): "slower slowly brake",
    (TIME, +1): "later",
    (TIME, -1): "sooner earlier",
    (ANGLE, +1): "left leftwards leftward",
    (ANGLE, -1): "right rightwards rightward",
}
_LEVELS: dict[tuple[str, float], str] = {
    (ANY, 0.0): "tiny minimal minimum min least smallest lowest weakest miniature",
    (ANY, 0.15): "small low weak little modest",
    (ANY, 0.5): "medium middle mid moderate average",
    (ANY, 0.85): "big large high strong great",
    (ANY, 1.0): "huge giant maximal maximum max most biggest largest highest strongest full enormous",
    (LENGTH, 0.0): "shortest narrowest",
    (LENGTH, 0.15): "short narrow dainty",
    (LENGTH, 0.85): "long wide",
    (LENGTH, 1.0): "longest widest",
    (SPEED, 0.0): "slowest",
    (SPEED, 0.15): "slow",
    (SPEED, 0.85): "fast quick",
    (SPEED, 1.0): "fastest quickest",
}


def _table(words: dict[tuple[str, float], str]) -> dict[str, tuple[str, float]]:
    return {word: meaning for meaning, text in words.items() for word in text.split()}


DIRECTIONS = _table(_DIRECTIONS)  # word to (dimension, sign)
LEVELS = _table(_LEVELS)  # word to (dimension, share of the range)
DEGREES = {
    **dict.fromkeys(("bit", "slightly", "touch", "tad", "somewhat", "marginally", "gently", "smidgen"), SLIGHTLY),
    **dict.fromkeys(("much", "lot", "lots", "far", "way", "considerably", "significantly", "strongly"), STRONGLY),
    **dict.fromkeys(("very", "really", "extremely", "super", "ultra"), STRONGLY),
}
NEGATIONS = _words("not no never without avoid stop nor neither discourage ban skip forget quit drop dont")
PREFERENCES = _words("prefer favour favor encourage love focus only mainly mostly use using choose always rather")
FACTORS = {"double": 2.0, "twice": 2.0, "triple": 3.0, "half": 0.5, "halve": 0.5}
DEFAULTS = _words("reset normal default usual neutral standard ordinary regular")
KEEPS = _words("keep same leave stay unchanged hold")
REPEATS = _words("again more further less")
EVERY = _words("both each all every")
ABSOLUTE = _words("at of than exactly about around roughly")
SEPARATORS = _words(", ; . ! ? : and or but plus while with then also")
JOINTS = _words(", and or")  # separators within a list of names
PARTICLES = _words("up forward ahead")  # options of a parameter only beside its name: "arms up", but "speed up"

# Words that carry no request of their own.
FILLERS = _words(
    """a an the of by in on at to for from as be is are was were am being been it its this that these those there so
    too just now please can could would should will shall may might must do does did i you he she we they me him us
    them my your his her our their want wants like let lets make makes making take takes taking go going get gets
    getting give set put have has having try move moving style than rather quite some any possible
    ok okay hey well thanks thank instead back exactly about roughly around by into or if when keep hold stay leave
    holding keeping bit lot lots touch tad one such kind sort how what which where when between during after before
    over under per both each all every maybe"""
)

RESERVED = frozenset().union(
    DIRECTIONS, LEVELS, FACTORS, NEGATIONS, PREFERENCES, DEFAULTS, FILLERS, SEPARATORS, UNITS, PERCENT
)
"""Words with a meaning of their own; none of them may stand for a parameter."""

_ARTICLES = _words("the your my his her its their")  # "raise your arms" reads as "raise arms"

_ONES = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
_TENS = ("ten", "twenty", "thirty", "forty", "fifty", "sixty", "seventy", "eighty", "ninety")
_NUMBERS: dict[str, float] = {word: i + 1.0 for i, word in enumerate(_ONES)} | {"fifteen": 15.0}
_NUMBERS |= {word: 10.0 * (i + 1) for i, word in enumerate(_TENS)}
_FRACTIONS = {"half": 0.5, "quarter": 0.25}
_MIXED = re.compile(rf"\b(\d+|{'|'.join(_NUMBERS)}) and a (half|quarter)\b")
_RATIO = re.compile(r"(?<![\d./])(\d{1,4})/([1-9]\d{0,3})(?![\d./])")
_THOUSANDS = re.compile(r"(?<![\d.,])[1-9]\d{0,2}(?:,\d{3})+(?!\d)")  # "1,000", but not "0,400"
_TOKEN = re.compile(r"[+-]?\d+(?:\.\d+)?|m/s(?![a-z])|km/h|[a-z°]+|%|[,;.!?:]")


def stem(word: str) -> str:
    """Return a word without the s of the plural."""
    return word[:-1] if len(word) > 3 and word.endswith("s") and not word.endswith("ss") else word


def own_unit(unit: str) -> str:
    """Return the token for a parameter's unit that is not in `UNITS`, such as "rad/s"; "" for other units and none."""
    letters = re.sub(r"[^a-z]", "", unit.lower())
    return "" if not letters or stem(unit) in UNITS else f"°{stem(letters)}"


def is_own_unit(token: str) -> bool:
    """Return whether a token is one of `own_unit`."""
    return token.startswith("°") and token not in UNITS


def mark_own_units(phrase: str, units: Iterable[str]) -> str:
    """Replace units behind numbers by their tokens, see `own_unit`.

    Example:
        >>> tokenise(mark_own_units("spin 2 rad/s", ["rad/s"]))
        ['spin', '2', '°rad']
    """
    for unit in sorted(filter(own_unit, units), key=len, reverse=True):
        written = r"\s*".join(map(re.escape, unit.split()))
        phrase = re.sub(rf"(?<=\d)\s*{written}(?![\w/])", f" {own_unit(unit)}", phrase, flags=re.IGNORECASE)
    return phrase


def tokenise(phrase: str) -> list[str]:
    """Split a phrase into words, numbers, units and punctuation, in lower case, without articles and possessives.

    Example:
        >>> tokenise("T-pose, don't: 0,4m or half a metre")
        ['t', 'pose', ',', 'do', 'not', ':', '0.4', 'm', 'or', '0.5', 'metre']
    """
    text = phrase.lower().replace("\u2019", "'").replace("\u2212", "-")  # typographic apostrophe and minus
    text = re.sub(r"\bcan't\b|\bcannot\b", "can not", text).replace("won't", "will not")
    text = re.sub(r"\b(?:instead of|rather than)\b", "not", text)
    text = re.sub(r"\b(?:all|anything|everything) (?:but|except)\b", "not", text)
    text = re.sub(r"\bno more (?!than\b)", "no ", text)
    text = re.sub(r"\ba little\b", "a bit", text)
    text = re.sub(r"\bzero\b", "0", text)
    text = re.sub(r"n't\b", " not", text).replace("'s", "").replace("'", "")
    text = re.sub(r"(?<=[a-z])[-_](?=[a-z])", " ", text)
    text = _THOUSANDS.sub(lambda m: m[0].replace(",", ""), text)
    text = re.sub(r"(?<=\d),(?=\d)", ".", text)
    text = re.sub(r"(?<![\d.])\.(?=\d)", "0.", text)
    text = _MIXED.sub(lambda m: f"{(_NUMBERS.get(m[1]) or float(m[1])) + _FRACTIONS[m[2]]:g}", text)  # "one and a half"
    text = _RATIO.sub(lambda m: f"{int(m[1]) / int(m[2]):.6f}", text)
    return [token for token in _spelt_numbers(_TOKEN.findall(text)) if token not in _ARTICLES]


def _spelt_numbers(tokens: list[str]) -> Iterator[str]:
    """Replace number words in front of a unit by digits."""
    i = 0
    while i < len(tokens):
        value, used = _FRACTIONS.get(tokens[i], _NUMBERS.get(tokens[i])), 1
        if value is not None and value >= 20 and _NUMBERS.get(tokens[i + 1] if i + 1 < len(tokens) else "", 99) < 10:
            value, used = value + _NUMBERS[tokens[i + 1]], 2
        rest = [token for token in tokens[i + used : i + used + 3] if token not in ("a", "an", "of")]
        if value is not None and rest and (stem(rest[0]) in UNITS or rest[0] in PERCENT):
            yield f"{value:g}"
            i = tokens.index(rest[0], i + used)
        else:
            yield tokens[i]
            i += 1
