"""`StyleGrammar`: read short phrases such as "shorter steps, arms up" or "0.4 m" as style parameters.

The grammar consists of rules, the names, options and help texts of the parameters, and the words of
`coachable.coach.phrases.vocabulary`. It reports words that are not among these.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

from coachable.coach.phrases import segments
from coachable.coach.phrases.amounts import Last, amount, dimension_of, wrapped
from coachable.coach.phrases.segments import Mention, Segment
from coachable.coach.phrases.vocabulary import FILLERS, RESERVED, is_own_unit, mark_own_units, own_unit, stem, tokenise
from coachable.domain import Words
from coachable.evaluation.wording import readable, readable_number
from coachable.styles import Choice, Parameter, StyleSpace, Weight

Value = float | str
MAX_PHRASE = 2000  # characters
_ENDS = {"low": 0.0, "high": 1.0}
_SIGNS = {"+": 1, "-": -1}
_EXAMPLES = 3


@dataclass(frozen=True)
class Understanding:
    """Result of reading a phrase.

    Attributes:
        phrase: The phrase as given.
        changes: Requested value by parameter name, for `CoachSession.set`; it may lie outside the trained range.
        said: One sentence for each request that was understood.
        failed: One sentence for each part that was not understood.
        last: Parameters and direction of the last change, to which "a bit more" refers.
        examples: Phrases that would be understood, if a word was unknown.
    """

    phrase: str
    changes: dict[str, Value]
    said: tuple[str, ...]
    failed: tuple[str, ...]
    last: Last | None = None
    examples: tuple[str, ...] = ()

    def __str__(self) -> str:
        hint = [f"try: {', '.join(self.examples)}"] if self.examples else []
        return "; ".join([*self.said, *(f"not understood: {text}" for text in self.failed), *hint])


@dataclass
class _Reading:
    """State of reading a phrase."""

    values: dict[str, Value]
    changes: dict[str, Value] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    excluded: dict[str, str] = field(default_factory=dict)  # sentence by choice: an option was ruled out, none named
    last: Last | None = None


class StyleGrammar:
    """Grammar of phrases about the parameters of a style space.

    Args:
        parameters: The parameters, as a `StyleSpace` or a list of declarations.
        vocabulary: Further words and phrases by meaning: "name" for a parameter, "name=option" for an option,
            "name=low", "name=high" or "name=0.4" for a value, "+name" or "-name" for a request of more or less of it,
            such as "careful" or "aggressive" for a distance. Several names separated by spaces are changed together.
            A weight with "-" words is named after what it saves, so that "less fuel" asks for more of it. Words under
            "" are ignored. Give singular forms.
        examples: Phrases to suggest after an unknown word; phrases that are not understood are left out.

    Attributes:
        examples: Suggested phrases, all of which are understood.

    Raises:
        ValueError: If the vocabulary names a parameter or an option that does not exist, or names with different signs
            together.

    Example:
        >>> from coachable.styles import Setpoint
        >>> grammar = StyleGrammar([Setpoint("gap", 0.0, 2.0, unit="m")])
        >>> print(grammar.read("a bit more gap", {"gap": 1.0}))
        gap 1 → 1.2 m
        >>> print(grammar.read("sing louder", {"gap": 1.0}))
        not understood: 'sing louder' (unknown: sing, louder); try: more gap
    """

    def __init__(
        self,
        parameters: StyleSpace | Sequence[Parameter],
        vocabulary: Mapping[str, Sequence[str]] | None = None,
        examples: Sequence[str] = (),
    ) -> None:
        declared = parameters.parameters if isinstance(parameters, StyleSpace) else tuple(parameters)
        self.parameters: dict[str, Parameter] = {p.name: p for p in declared}
        self._defaults = {p.name: cast(Value, p.default) for p in declared}
        self.lexicon: dict[tuple[str, ...], Mention] = {}
        self._context = {p.name: {stem(w) for w in tokenise(f"{p.help} {p.name}")} for p in declared}
        self._ignored = frozenset((vocabulary or {}).get("", ()))
        self._add_help()
        self._add_names()
        for meaning, phrases in (vocabulary or {}).items():
            if not meaning:
                continue
            mention = self._mention(meaning)
            for phrase in phrases:
                self._add(phrase, mention)
        opposed = {name for mention in self.lexicon.values() if mention.sign < 0 for name in mention.names}
        self._spent = {name for name in opposed if isinstance(self.parameters[name], Weight)}
        self.examples = self._working(examples) or self._working(
            [readable(p.options[-1]) if isinstance(p, Choice) else f"more {readable(p.name)}" for p in declared]
        )

    def read(self, phrase: str, current: Mapping[str, Value], previous: Understanding | None = None) -> Understanding:
        """Read a phrase relative to the style in force.

        Args:
            phrase: The phrase, of at most 2,000 characters.
            current: Value of every parameter.
            previous: Result of the phrase before, to which "a bit more" refers.
        """
        reading = _Reading(dict(current), last=previous.last if previous is not None else None)
        if len(phrase) > MAX_PHRASE:
            problem = f"the phrase has {len(phrase):,} characters, at most {MAX_PHRASE:,} are read"
            return Understanding(phrase[:MAX_PHRASE], {}, (), (problem,), reading.last)
        marked = mark_own_units(phrase, {p.unit for p in self.parameters.values()})
        split = segments.split(tokenise(marked), self.lexicon, self._ignored)
        if not split:
            reading.failed.append(f"'{phrase.strip()}'" if phrase.strip() else "an empty phrase")
        for segment in split:
            everything = segment.default and not (segment.unknown or segment.mentions or segment.explicit)
            if everything and segment.negated:
                reading.failed.append(f"'{segment.text}' (say what instead)")
            elif everything:
                self._reset(reading)
            else:
                self._interpret(segment, reading)
        reading.failed += [text for name, text in reading.excluded.items() if name not in reading.changes]
        unknown = not split or any(segment.unknown for segment in split)
        hint = self.examples if reading.failed and unknown else ()
        return Understanding(phrase, reading.changes, tuple(reading.said), tuple(reading.failed), reading.last, hint)

    def _add(self, phrase: str, mention: Mention) -> None:
        words = tuple(stem(token) for token in tokenise(phrase))
        if words:
            self.lexicon[words] = mention

    def _add_names(self) -> None:
        named = []
        for p in self.parameters.values():
            named += [(p.name, Mention((p.name,))), *((option, Mention((p.name,), option)) for option in p.options)]
        counts = Counter(word for name, _ in named for word in set(tokenise(name)))
        for name, mention in named:
            for word in tokenise(name):
                if counts[word] == 1 and self._is_free(word):
                    self._add(word, mention)
            word, *others = tokenise(name) or [""]
            ambiguous = not others and (word in FILLERS or not word.isalpha())  # such as "on", "a" and "2"
            self._add(f"{mention.names[0]} {name}" if ambiguous else name, mention)

    def _add_help(self) -> None:
        """Add the words of the help texts that occur with one parameter only."""
        words = {p.name: {w for w in tokenise(p.help) if self._is_free(w)} for p in self.parameters.values()}
        counts = Counter(word for found in words.values() for word in found)
        for name, found in words.items():
            for word in found:
                if counts[word] == 1:
                    self._add(word, Mention((name,)))

    def _is_free(self, word: str) -> bool:
        """Return whether a word has no other meaning and may stand for a parameter."""
        return word.isalpha() and len(word) > 1 and word not in RESERVED and word not in self._ignored

    def _mention(self, meaning: str) -> Mention:
        signed, sign, value = _read_meaning(meaning)
        unknown = [name for name in signed if name not in self.parameters]
        if unknown or not signed:
            given = " ".join(unknown or signed)
            raise ValueError(f"the vocabulary has words for {given!r}: expected one of {list(self.parameters)}")
        if not value:
            return Mention(signed, sign=sign)
        for options in filter(None, (self.parameters[name].options for name in signed)):
            if value not in options:
                raise ValueError(f"the vocabulary has words for {meaning!r}: options are {list(options)}")
        p = self.parameters[signed[0]]
        if isinstance(p, Choice):
            return Mention(signed, value)
        if value in _ENDS:
            return Mention(signed, p.low + _ENDS[value] * (p.high - p.low))
        return Mention(signed, float(value))

    def _working(self, phrases: Sequence[str]) -> tuple[str, ...]:
        """Return the first few phrases that are understood."""
        self.examples: tuple[str, ...] = ()
        return tuple(phrase for phrase in phrases if not self.read(phrase, self._defaults).failed)[:_EXAMPLES]

    def _interpret(self, segment: Segment, reading: _Reading) -> None:
        for name in segment.names:  # "the warrior bow": one word is the name, the other one describes it
            segment.unknown = [word for word in segment.unknown if stem(word) not in self._context[name]]
        unknown = f"unknown: {', '.join(segment.unknown)}"
        no_unit = segment.number is not None and not segment.number[1]
        if segment.unknown and (segment.negated or no_unit):  # the negation or number may refer to the unknown word
            reading.failed.append(f"'{segment.text}' ({unknown})")
            return
        if any(mention.value is not None for mention in segment.mentions):
            self._take_values(segment, reading)
            return
        names, problem = self._target(segment, reading)
        plain = not segment.has_head and all(isinstance(self.parameters[name], Weight) for name in names)
        if segment.unknown and plain:  # the word may say the opposite: "melee off"
            reading.failed.append(f"'{segment.text}' ({unknown})")
            return
        if not names:
            reading.failed.append(f"'{segment.text}'{problem}")
            return
        name, parameter = names[0], self.parameters[names[0]]
        if isinstance(parameter, Choice):
            if segment.keep or (segment.default and not segment.negated):
                self._change(reading, name, (self._defaults if segment.default else reading.values)[name])
                return
            expected = f"{readable(name)} can be {_listed(parameter.options)}"
            reading.failed.append(f"'{segment.text}' ({f'{unknown}; ' if segment.unknown else ''}{expected})")
            return
        numeric = [p for p in map(self.parameters.__getitem__, names) if not isinstance(p, Choice)]
        values, last, spent = reading.values, reading.last, self._spent
        asked = [amount(p, segment, float(values[p.name]), last, p.name in spent) for p in numeric]
        problems = [value for value in asked if isinstance(value, str)]
        if problems:
            reading.failed.append(f"'{segment.text}' ({problems[0]})")
            return
        self._note_unknown(segment, reading)
        explained = any(mention.sign for mention in segment.mentions) or not self._spent.isdisjoint(names)
        for p, value in zip(numeric, asked, strict=True):
            self._change(reading, p.name, value, f" ({p.help})" if explained and p.help else "")
        if reading.last is not None and reading.last[0][0] in names:
            reading.last = (names, reading.last[1])

    def _take_values(self, segment: Segment, reading: _Reading) -> None:
        """Change the parameters of named options and values, or exclude these values if the segment is negated."""
        for mention in segment.mentions:
            if mention.value is None:
                continue
            fixed = not self.parameters[mention.names[0]].options
            if fixed and (segment.factor is not None or (segment.direction is not None and segment.direction[1] < 0)):
                reading.failed.append(f"'{segment.text}' (say how much instead)")  # "less grip"
                continue
            if not segment.negated:
                self._note_unknown(segment, reading)
            for name in mention.names:
                if segment.negated:
                    self._deny(name, mention.value, segment, reading)
                else:
                    self._change(reading, name, mention.value)

    def _deny(self, name: str, value: Value, segment: Segment, reading: _Reading) -> None:
        """Request any other value than this one, or ask which."""
        parameter = self.parameters[name]
        others = [option for option in parameter.options if option != value]
        if isinstance(parameter, Choice) and reading.values[name] != value:
            reading.said.append(f"{readable(name)} stays {_shown(parameter, reading.values[name])}")
        elif isinstance(parameter, Weight) and value == 0.0:
            self._change(reading, name, parameter.high)  # "do not waste fuel"
        elif len(others) == 1:
            self._change(reading, name, others[0])
        else:
            instead = f"say what instead: {_listed(others)}" if others else "say how much instead"
            reading.excluded[name] = f"'{segment.text}' ({instead})"

    def _target(self, segment: Segment, reading: _Reading) -> tuple[tuple[str, ...], str]:
        """Return the parameters that a segment refers to, and otherwise the reason why there are none."""
        if segment.mentions:
            return segment.names, ""
        if segment.unknown:
            return (), f" (unknown: {', '.join(segment.unknown)})"
        if not segment.has_head:
            return (), ""
        dimension = segment.dimension
        numeric = [n for n, p in self.parameters.items() if not isinstance(p, Choice)]
        if dimension:
            named = {n for n in numeric if dimension in tokenise(n) and not dimension_of(self.parameters[n])}
            fitting = [n for n in numeric if dimension_of(self.parameters[n]) == dimension or n in named]
            if not fitting:
                return (), f" (nothing here has a {dimension})"
        else:
            fitting = [n for n in numeric if dimension_of(self.parameters[n]) != "angle"]
        if segment.number is not None and is_own_unit(segment.number[1]):
            fitting = [n for n in numeric if own_unit(self.parameters[n].unit) == segment.number[1]] or fitting
        if segment.every:
            return tuple(fitting), ""  # "both 0.5 m"
        if reading.last is not None and (reading.last[0][0] in fitting or not dimension):
            return reading.last[0], ""
        together = any(mention.names == tuple(fitting) for mention in self.lexicon.values())
        if len(fitting) == 1 or together:
            return tuple(fitting), ""
        return (), f" (of what: {_listed(fitting)}?)"

    def _reset(self, reading: _Reading) -> None:
        changed = {name: value for name, value in self._defaults.items() if reading.values[name] != value}
        for name, value in changed.items():
            self._change(reading, name, value)
        if not changed:
            reading.said.append("everything stays at its default")

    def _change(self, reading: _Reading, name: str, value: Value, note: str = "") -> None:
        parameter, before = self.parameters[name], reading.values[name]
        if isinstance(value, float) and isinstance(before, float):
            value = float(f"{value:.6g}")
            if abs(value - before) <= 1e-6 * (parameter.high - parameter.low):
                at = "already at its " + ("highest" if value >= parameter.high else "lowest")
                ends = not parameter.low < value < parameter.high
                reading.said.append(f"{readable(name)} stays {_shown(parameter, before)}{f', {at}' if ends else ''}")
                return
            reading.last = ((name,), 1.0 if value > before else -1.0)
            value = wrapped(parameter, value)
        if value == before:
            reading.said.append(f"{readable(name)} stays {_shown(parameter, value)}")
            return
        was = readable_number(before) if isinstance(before, float) else _shown(parameter, before)
        outside = isinstance(before, float) and not parameter.low <= float(value) <= parameter.high
        bounds = f"{parameter.low:g} to {_shown(parameter, parameter.high)}"
        trained = f", outside the trained range {bounds}" if outside else ""
        reading.said.append(f"{readable(name)} {was} → {_shown(parameter, value)}{note}{trained}")
        reading.values[name] = reading.changes[name] = value

    @staticmethod
    def _note_unknown(segment: Segment, reading: _Reading) -> None:
        if segment.unknown:
            reading.failed.append(f"{', '.join(repr(word) for word in segment.unknown)} in '{segment.text}'")


def _read_meaning(meaning: str) -> tuple[tuple[str, ...], int, str]:
    """Split a meaning such as "-gap_ahead -gap_beside" or "pose=arms_up" into names, sign (0 for none) and value."""
    names, _, value = meaning.partition("=")
    signs = {_SIGNS.get(name[0], 0) for name in names.split()} or {0}
    if len(signs) > 1:
        raise ValueError(f"the vocabulary has words for {meaning!r}: expected the same sign before all names, or none")
    return tuple(name.lstrip("+-") for name in names.split()), signs.pop(), value


def fitting(words: Words, parameters: Sequence[Parameter]) -> Words:
    """Return the words and presets of a domain, without those of parameters and options that an agent does not have."""
    options = {p.name: p.options for p in parameters}

    def known(name: str, value: Any) -> bool:
        return name in options and (not options[name] or value in ("", *options[name]))

    def means(meaning: str) -> bool:
        named, _, value = _read_meaning(meaning)
        return all(known(name, value) for name in named)

    vocabulary = {meaning: phrases for meaning, phrases in words.vocabulary.items() if means(meaning)}
    presets = {name: style for name, style in words.presets.items() if all(known(*item) for item in style.items())}
    return replace(words, vocabulary=vocabulary, presets=presets)


def _listed(names: Sequence[str]) -> str:
    return " or ".join(map(readable, names))


def _shown(parameter: Parameter, value: Value) -> str:
    if isinstance(value, str):
        return readable(value)
    return f"{readable_number(value)} {parameter.unit}".rstrip()
