"""`StyleGrammar`: short phrases such as "shorter steps, arms up" or "0.4 m" into style parameters.

A convenience built from the declarations, not language understanding: it knows names, options, words of the help texts
and the words of `coachable.coach.phrases.vocabulary`. What it does not know, it says.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import cast

from coachable.coach.phrases import segments
from coachable.coach.phrases.amounts import Last, amount, dimension_of, wrapped
from coachable.coach.phrases.segments import Mention, Segment
from coachable.coach.phrases.vocabulary import RESERVED, stem, tokenise
from coachable.styles import Choice, Parameter, StyleSpace, Weight

Value = float | str
MAX_PHRASE = 2000  # characters
_ENDS = {"low": 0.0, "high": 1.0}
_SIGNS = {"+": 1, "-": -1}
_EXAMPLES = 3


@dataclass(frozen=True)
class Understanding:
    """What a phrase was taken to mean.

    Attributes:
        phrase: as given.
        changes: value by parameter name, to be handed to `CoachSession.set`; it may lie outside the trained range.
        said: one sentence per request that was understood.
        failed: one sentence per piece that was not.
        last: parameters and direction of the last change, for "a bit more".
        examples: phrases that would be understood, if a word was not known.
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
    """A phrase while it is being read."""

    values: dict[str, Value]
    changes: dict[str, Value] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    excluded: dict[str, str] = field(default_factory=dict)  # by parameter: an option was ruled out, none was named
    last: Last | None = None


class StyleGrammar:
    """Reads phrases about the parameters of a style space.

    Args:
        parameters: what can be asked for; a `StyleSpace` or any list of declarations.
        vocabulary: further words and phrases by meaning: "name" for a parameter, "name=option" for an option,
            "name=low", "name=high" or "name=0.4" for a value, "+name" or "-name" for what asks for more or less of it,
            such as "careful" or "aggressive" for a distance. Several names, separated by spaces, are meant together.
            A weight with "-" words is named after what it saves, so that "less fuel" asks for more of it. Words under
            "" ask for nothing. Singular forms suffice.
        examples: phrases to suggest where a word is not known; those that are not understood are left out.

    Attributes:
        examples: phrases that are understood here.

    Raises:
        ValueError: if the vocabulary names something that does not exist.

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
            [_words(p.options[-1]) if isinstance(p, Choice) else f"more {_words(p.name)}" for p in declared]
        )

    def read(self, phrase: str, current: Mapping[str, Value], previous: Understanding | None = None) -> Understanding:
        """Understand a phrase, relative to the style in force.

        Args:
            phrase: what the coach said, at most 2,000 characters.
            current: value of every parameter.
            previous: what was understood before, to which "a bit more" refers.
        """
        reading = _Reading(dict(current), last=previous.last if previous is not None else None)
        if len(phrase) > MAX_PHRASE:
            problem = f"the phrase has {len(phrase):,} characters, at most {MAX_PHRASE:,} are read"
            return Understanding(phrase[:MAX_PHRASE], {}, (), (problem,), reading.last)
        split = segments.split(tokenise(phrase), self.lexicon, self._ignored)
        if not split:
            reading.failed.append(f"'{phrase.strip()}'" if phrase.strip() else "an empty phrase")
        for segment in split:
            if segment.default and not segment.unknown and not segment.mentions:
                self._reset(reading)
            else:
                self._interpret(segment, reading)
        reading.failed += [text for name, text in reading.excluded.items() if name not in reading.changes]
        unknown = not split or any(segment.unknown for segment in split)
        hint = self.examples if reading.failed and unknown else ()
        return Understanding(phrase, reading.changes, tuple(reading.said), tuple(reading.failed), reading.last, hint)

    # -- lexicon ---------------------------------------------------------------------------------------------------

    def _add(self, phrase: str, mention: Mention) -> None:
        words = tuple(stem(token) for token in tokenise(phrase))
        if words:
            self.lexicon[words] = mention

    def _add_names(self) -> None:
        named = []
        for p in self.parameters.values():
            named += [(p.name, Mention((p.name,))), *((option, Mention((p.name,), option)) for option in _options(p))]
        counts = Counter(word for name, _ in named for word in set(tokenise(name)))
        for name, mention in named:
            for word in tokenise(name):
                if counts[word] == 1 and self._is_free(word):
                    self._add(word, mention)
            self._add(name, mention)

    def _add_help(self) -> None:
        """Content words of the help texts that belong to one parameter alone."""
        words = {p.name: {w for w in tokenise(p.help) if self._is_free(w)} for p in self.parameters.values()}
        counts = Counter(word for found in words.values() for word in found)
        for name, found in words.items():
            for word in found:
                if counts[word] == 1:
                    self._add(word, Mention((name,)))

    def _is_free(self, word: str) -> bool:
        """Whether a word has no other meaning, so that alone it may stand for a parameter."""
        return word.isalpha() and len(word) > 1 and word not in RESERVED and word not in self._ignored

    def _mention(self, meaning: str) -> Mention:
        signed, sign, value = read_meaning(meaning)
        unknown = [name for name in signed if name not in self.parameters]
        if unknown or not signed:
            given = " ".join(unknown or signed)
            raise ValueError(f"the vocabulary has words for {given!r}: expected one of {list(self.parameters)}")
        if not value:
            return Mention(signed, sign=sign)
        for options in filter(None, (_options(self.parameters[name]) for name in signed)):
            if value not in options:
                raise ValueError(f"the vocabulary has words for {meaning!r}: options are {list(options)}")
        p = self.parameters[signed[0]]
        if isinstance(p, Choice):
            return Mention(signed, value)
        if value in _ENDS:
            return Mention(signed, p.low + _ENDS[value] * (p.high - p.low))
        return Mention(signed, float(value))

    def _working(self, phrases: Sequence[str]) -> tuple[str, ...]:
        """The first few phrases that are understood."""
        self.examples: tuple[str, ...] = ()
        return tuple(phrase for phrase in phrases if not self.read(phrase, self._defaults).failed)[:_EXAMPLES]

    # -- meaning ---------------------------------------------------------------------------------------------------

    def _interpret(self, segment: Segment, reading: _Reading) -> None:
        for name in segment.names:  # "the warrior bow": one word names it, the other describes it
            segment.unknown = [word for word in segment.unknown if stem(word) not in self._context[name]]
        if segment.negated and segment.unknown:  # what is denied is not known
            reading.failed.append(f"'{segment.text}' (unknown: {', '.join(segment.unknown)})")
            return
        values = [mention for mention in segment.mentions if mention.value is not None]
        if values:
            self._take_values(segment, values, reading)
            return
        names, problem = self._target(segment, reading)
        if not names:
            reading.failed.append(f"'{segment.text}'{problem}")
            return
        parameter = self.parameters[names[0]]
        if isinstance(parameter, Choice):
            self._choose(parameter, segment, reading)
            return
        numeric = [p for p in map(self.parameters.__getitem__, names) if not isinstance(p, Choice)]
        asked = [
            amount(p, segment, float(reading.values[p.name]), reading.last, p.name in self._spent) for p in numeric
        ]
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

    def _choose(self, parameter: Choice, segment: Segment, reading: _Reading) -> None:
        """A choice without an option that was named."""
        name = parameter.name
        if segment.keep or segment.default:
            self._change(reading, name, (self._defaults if segment.default else reading.values)[name])
            return
        unknown = f"unknown: {', '.join(segment.unknown)}; " if segment.unknown else ""
        reading.failed.append(f"'{segment.text}' ({unknown}{_words(name)} can be {_listed(parameter.options)})")

    def _take_values(self, segment: Segment, values: list[Mention], reading: _Reading) -> None:
        """Options of choices, and values that the vocabulary gives a name."""
        for mention in values:
            assert mention.value is not None
            if not segment.negated:
                self._note_unknown(segment, reading)
            for name in mention.names:
                if segment.negated:
                    self._deny(name, mention.value, segment, reading)
                else:
                    self._change(reading, name, mention.value)

    def _deny(self, name: str, value: Value, segment: Segment, reading: _Reading) -> None:
        """Any value but this one."""
        parameter = self.parameters[name]
        others = [option for option in _options(parameter) if option != value]
        if isinstance(parameter, Choice) and reading.values[name] != value:
            reading.said.append(f"{_words(name)} stays {_shown(parameter, reading.values[name])}")
        elif isinstance(parameter, Weight) and value == 0.0:
            self._change(reading, name, parameter.high)  # "do not waste fuel"
        elif len(others) == 1:
            self._change(reading, name, others[0])
        else:
            instead = f"say what instead: {_listed(others)}" if others else "say how much instead"
            reading.excluded[name] = f"'{segment.text}' ({instead})"

    def _target(self, segment: Segment, reading: _Reading) -> tuple[tuple[str, ...], str]:
        """The parameters that a segment is about, or why there is none."""
        if segment.mentions:
            return segment.names, ""
        if segment.unknown:
            return (), f" (unknown: {', '.join(segment.unknown)})"
        if not segment.has_head:
            return (), ""
        dimension = segment.dimension
        numeric = [n for n, p in self.parameters.items() if not isinstance(p, Choice)]
        if dimension:
            fitting = [n for n in numeric if dimension_of(self.parameters[n]) == dimension]
            if not fitting:
                return (), f" (nothing here has a {dimension})"
        else:
            fitting = [n for n in numeric if dimension_of(self.parameters[n]) != "angle"]
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

    # -- echo ------------------------------------------------------------------------------------------------------

    def _change(self, reading: _Reading, name: str, value: Value, note: str = "") -> None:
        parameter, before = self.parameters[name], reading.values[name]
        if isinstance(value, float) and isinstance(before, float):
            value = float(f"{value:.6g}")
            if abs(value - before) <= 1e-6 * (parameter.high - parameter.low):
                at = "already at its " + ("highest" if value >= parameter.high else "lowest")
                ends = not parameter.low < value < parameter.high
                reading.said.append(f"{_words(name)} stays {_shown(parameter, before)}" + (f", {at}" if ends else ""))
                return
            reading.last = ((name,), 1.0 if value > before else -1.0)
            value = wrapped(parameter, value)
        if value == before:
            reading.said.append(f"{_words(name)} stays {_shown(parameter, value)}")
            return
        was = readable_number(before) if isinstance(before, float) else _shown(parameter, before)
        outside = isinstance(before, float) and not parameter.low <= float(value) <= parameter.high
        trained = f", outside the trained range {parameter.low:g} to {parameter.high:g}" if outside else ""
        reading.said.append(f"{_words(name)} {was} → {_shown(parameter, value)}{note}{trained}")
        reading.values[name] = reading.changes[name] = value

    @staticmethod
    def _note_unknown(segment: Segment, reading: _Reading) -> None:
        if segment.unknown:
            reading.failed.append(f"{', '.join(repr(word) for word in segment.unknown)} in '{segment.text}'")


def read_meaning(meaning: str) -> tuple[tuple[str, ...], int, str]:
    """Names, sign and value of a meaning of the vocabulary, such as "-longitudinal -lateral" or "pose=arms_up"."""
    names, _, value = meaning.partition("=")
    signs = {_SIGNS.get(name[0], 0) for name in names.split()}
    return tuple(name.lstrip("+-") for name in names.split()), signs.pop() if signs else 0, value


def _options(parameter: Parameter) -> tuple[str, ...]:
    return tuple(parameter.options) if isinstance(parameter, Choice) else ()


def _words(name: str) -> str:
    return name.replace("_", " ")


def _listed(names: Sequence[str]) -> str:
    return " or ".join(map(_words, names))


def _shown(parameter: Parameter, value: Value) -> str:
    if isinstance(value, str):
        return _words(value)
    return f"{readable_number(value)} {parameter.unit}".rstrip()


def readable_number(value: float) -> str:
    """Three digits, however large."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
