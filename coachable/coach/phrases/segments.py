"""Division of a phrase into single requests."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from coachable.coach.phrases.vocabulary import (
    ABSOLUTE,
    DEFAULTS,
    DEGREES,
    DIRECTIONS,
    EVERY,
    FACTORS,
    FILLERS,
    JOINTS,
    KEEPS,
    LEVELS,
    NEGATIONS,
    PARTICLES,
    PERCENT,
    PREFERENCES,
    REPEATS,
    SEPARATORS,
    STRONGLY,
    UNITS,
    is_own_unit,
    stem,
)

_FLAGS = {
    "preferred": PREFERENCES,
    "default": DEFAULTS,
    "keep": KEEPS,
    "repeated": REPEATS,
    "every": EVERY,
    "absolute": ABSOLUTE,
}
"""Words by the attribute of `Segment` that they set."""

_PARTICLES = [[word] for word in PARTICLES]


@dataclass(frozen=True)
class Mention:
    """Meaning of a word or phrase of the lexicon.

    Attributes:
        names: Parameters that it names; several for a word such as "room", which means the gaps on all sides.
        value: An option or a number, if the word stands for one.
        sign: +1 if the word asks for more of the parameters ("careful" for gaps), -1 if it asks for less
            ("aggressive"), 0 if it only names them ("gap").
    """

    names: tuple[str, ...]
    value: float | str | None = None
    sign: int = 0


@dataclass
class Segment:
    """One request: at most one parameter, and how to change it.

    Attributes:
        words: Words of the phrase.
        mentions: Parameters and options that are named.
        direction: Dimension and sign of a comparative.
        level: Share of the range that an adjective stands for.
        dimension: Dimension of the words, such as "length"; "" if they fit any.
        number: Value and unit; the unit is "" if there is none.
        degree: Strength of the change, 0 if there is none.
        factor: Factor of words such as "twice".
        unknown: Words without a meaning.
        joint: The separator before the request, "" if there is none.
    """

    words: list[str] = field(default_factory=list)
    mentions: list[Mention] = field(default_factory=list)
    direction: tuple[str, float] | None = None
    level: float | None = None
    dimension: str = ""
    number: tuple[float, str] | None = None
    degree: float = 0.0
    factor: float | None = None
    unknown: list[str] = field(default_factory=list)
    negated: bool = False
    preferred: bool = False
    default: bool = False
    keep: bool = False
    repeated: bool = False
    every: bool = False
    absolute: bool = False
    signed: bool = False
    joint: str = ""

    @property
    def text(self) -> str:
        """Words of the request as one text."""
        return " ".join(self.words)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that all mentions have in common: "the bow of the hunter" names one bow."""
        first, *others = (mention.names for mention in self.mentions) if self.mentions else ((),)
        return tuple(name for name in first if all(name in names for names in others))

    @property
    def sense(self) -> int:
        """Sign of the words: +1 or -1 if they ask for more or less of the parameters, 0 if they only name them."""
        return math.prod(signs) if (signs := [m.sign for m in self.mentions if m.sign]) else 0

    @property
    def too(self) -> bool:
        """Whether the request says "too", except at its end, where "too" means "also"."""
        return "too" in self.words[:-1]

    @property
    def explicit(self) -> bool:
        """Whether the request contains a comparative, an adjective, a number or a factor."""
        return any(part is not None for part in (self.direction, self.level, self.number, self.factor))

    @property
    def has_head(self) -> bool:
        """Whether the request asks for a change, with or without the name of a parameter."""
        return self.explicit or self.default or self.repeated or self.keep or self.degree > 0

    @property
    def bare(self) -> bool:
        """Whether the request consists of names only."""
        asks = self.has_head or self.negated or self.preferred or self.unknown
        return bool(self.mentions) and not asks and all(mention.value is None for mention in self.mentions)

    @property
    def complete(self) -> bool:
        """Whether another request may begin here."""
        return any(m.value is not None for m in self.mentions) or bool(self.mentions and self.explicit)


def split(
    tokens: Sequence[str], lexicon: Mapping[tuple[str, ...], Mention], ignored: Collection[str] = ()
) -> list[Segment]:
    """Split a phrase at punctuation, at conjunctions, and where a request is complete and another one begins.

    The run time is proportional to the number of tokens.

    Args:
        tokens: Output of `tokenise`.
        lexicon: Meaning of stemmed words and phrases.
        ignored: Words without a meaning, in addition to those of the vocabulary.
    """
    stems = [stem(token) for token in tokens]
    sizes, ahead = _look_up(stems, lexicon)
    found, segment, i = [], Segment(), 0
    while i < len(tokens):
        size = sizes[i]
        mention = lexicon[tuple(stems[i : i + size])] if size else None
        if mention is not None and stems[i : i + size] in _PARTICLES and mention.names[0] not in segment.names:
            mention = None
        separated = mention is None and tokens[i] in SEPARATORS
        outdone = mention is None and _outdoes(segment, tokens[i], ahead[i])
        if separated or outdone or _begins_another(segment, tokens[i : i + 2], mention, ahead[i] is not None):
            found.append(segment)
            segment = Segment(joint=tokens[i]) if separated else Segment()
            if outdone and tokens[i] not in NEGATIONS:  # "more A than B" leaves B as it is
                segment = Segment(negated=True, direction=None if found[-1].preferred else found[-1].direction)
        if mention is not None:
            segment.words += tokens[i : i + size]
            if mention not in segment.mentions:
                segment.mentions.append(mention)
        elif not separated:
            size = _take(segment, tokens, i, ignored)
        i += max(size, 1)
    found.append(segment)
    return _shared(_tidy(found))


def _look_up(
    stems: Sequence[str], lexicon: Mapping[tuple[str, ...], Mention]
) -> tuple[list[int], list[Mention | None]]:
    """Look up the entries of the lexicon that begin at each token.

    Returns:
        The number of tokens of the longest entry that begins at each token, 0 if there is none; and the next entry
        between the token and the next separator.
    """
    longest = max((len(words) for words in lexicon), default=1)
    sizes = [0] * len(stems)
    named_ahead: list[Mention | None] = [None] * len(stems)
    ahead, clear = None, 0  # `clear` counts the tokens before the next separator
    for i in reversed(range(len(stems))):
        fitting = [n for n in range(min(longest, len(stems) - i), 0, -1) if tuple(stems[i : i + n]) in lexicon]
        sizes[i] = fitting[0] if fitting else 0
        clear = 0 if stems[i] in SEPARATORS else clear + 1
        whole = next((n for n in fitting if n <= clear), 0)
        ahead = lexicon[tuple(stems[i : i + whole])] if whole else ahead if clear else None
        named_ahead[i] = ahead
    return sizes, named_ahead


def _outdoes(segment: Segment, word: str, ahead: Mention | None) -> bool:
    """Return whether the next parameter is set against the segment's: "traps not melee", "more A than B"."""
    contrasted = word in NEGATIONS or (segment.preferred and word in ("over", "than"))
    contrasted |= word == "than" and segment.direction is not None
    contrasted |= word == "to" and "prefer" in segment.words
    return contrasted and bool(segment.mentions) and ahead is not None and not set(segment.names) & set(ahead.names)


def _begins_another(segment: Segment, rest: Sequence[str], mention: Mention | None, named_ahead: bool) -> bool:
    if mention is not None:
        other = bool(segment.mentions) and not set(segment.names) & set(mention.names)
        # "arms up": the option belongs to the noun before it
        return other or (mention.value is not None and segment.complete)
    word = rest[0]
    dimension = (LEVELS.get(word) or DIRECTIONS.get(word) or ("",))[0]
    if dimension and segment.dimension not in ("", dimension) and segment.number is None:
        return True  # "short fast steps"
    if not segment.complete:
        return False
    if word in NEGATIONS:
        return True
    if word in LEVELS or word in DIRECTIONS:
        # "arms up high" is one request, "arms up high speed" are two
        return segment.number is None and (named_ahead or bool(dimension))
    # A degree belongs to the next word if that is a comparative or an adjective: "shorter steps much more melee".
    return word in DEGREES and len(rest) > 1 and (rest[1] in DIRECTIONS or rest[1] in LEVELS)


def _take(segment: Segment, tokens: Sequence[str], i: int, ignored: Collection[str]) -> int:
    """Add the meaning of a word to a segment and return the number of tokens used."""
    word = tokens[i]
    segment.words.append(word)
    if word[-1].isdigit() and not math.isfinite(float(word)):
        segment.unknown.append(word)
    elif word[-1].isdigit():
        unit = stem(tokens[i + 1]) if i + 1 < len(tokens) else ""
        known = unit in PERCENT or unit in UNITS or is_own_unit(unit)
        segment.signed, segment.number = word.startswith("+"), (float(word), unit if known else "")
        segment.absolute |= i > 0 and tokens[i - 1] == "to"
        if known:
            segment.words += [] if is_own_unit(unit) else [tokens[i + 1]]
            segment.dimension = segment.dimension or UNITS.get(unit, ("", 1.0))[0]
            return 2
    elif word in NEGATIONS:
        segment.negated = not segment.negated
    elif word in DIRECTIONS:
        segment.direction = segment.direction or DIRECTIONS[word]
        segment.dimension = segment.dimension or DIRECTIONS[word][0]
        segment.repeated |= word in REPEATS
    elif word in LEVELS:
        segment.dimension, segment.level = segment.dimension or LEVELS[word][0], LEVELS[word][1]
    elif word in FACTORS:
        segment.factor = FACTORS[word]
    elif word == "possible" and segment.level is not None:
        segment.level = float(round(segment.level))
    elif word == "possible" and "as" in segment.words:
        segment.degree = STRONGLY
    else:
        _take_modifier(segment, word, ignored)
    return 1


def _take_modifier(segment: Segment, word: str, ignored: Collection[str]) -> None:
    flags = [name for name, words in _FLAGS.items() if word in words]
    for name in flags:
        setattr(segment, name, True)
    segment.degree = max(segment.degree, DEGREES.get(word, 0.0))
    if not (flags or word in DEGREES or word in FILLERS or word in ignored):
        segment.unknown.append(word)


def _tidy(found: list[Segment]) -> list[Segment]:
    """Drop empty segments and join those that a comma separates: "steps, shorter", "shorter steps, just a bit"."""
    kept: list[Segment] = []
    for segment in found:
        asks = segment.mentions or segment.unknown or segment.has_head or segment.negated or segment.preferred
        if not asks or segment.words == ["no"]:
            continue
        before = kept[-1] if kept else None
        anonymous = not (segment.mentions or segment.unknown)
        if before is not None and anonymous and segment.degree and not segment.explicit:
            before.degree = segment.degree
        elif before is not None and anonymous and before.mentions and not (before.has_head or before.complete):
            segment.mentions, segment.words = before.mentions, [*before.words, *segment.words]
            kept[-1] = segment
        else:
            kept.append(segment)
    return kept


def _shared(found: list[Segment]) -> list[Segment]:
    """Let each name of a list have what its first one has: "no fire, acid or frost", "less fuel and tyres"."""
    in_list = False  # whether the list ends with "and" or "or", which a mere comma does not tell
    listed = []
    for segment in reversed(found):
        in_list = segment.bare and segment.joint in JOINTS and (in_list or segment.joint != ",")
        listed.append(in_list)
    for is_listed, (before, segment) in zip(listed[-2::-1], pairwise(found), strict=True):
        if is_listed and before.mentions and not before.dimension and before.number is None:
            segment.negated, segment.direction, segment.level = before.negated, before.direction, before.level
            segment.factor, segment.degree = before.factor, before.degree
    return found
