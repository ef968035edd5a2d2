"""Selection of a domain's words that fit an agent's styles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from coachable.coach.phrases.grammar import read_meaning
from coachable.domain import Words
from coachable.styles import Parameter


def fitting(words: Words, parameters: Sequence[Parameter]) -> Words:
    """Leave out the words and presets of parameters and options that an agent does not have.

    Args:
        words: Words of the domain.
        parameters: Parameters of the agent's style space and of the live controls.

    Returns:
        The words of the domain that name only these parameters and their options.
    """
    options = {p.name: p.options for p in parameters}

    def known(name: str, value: Any) -> bool:
        return name in options and (not options[name] or value in ("", *options[name]))

    def means(meaning: str) -> bool:
        named, _, value = read_meaning(meaning)
        return all(known(name, value) for name in named)

    vocabulary = {meaning: phrases for meaning, phrases in words.vocabulary.items() if means(meaning)}
    presets = {name: style for name, style in words.presets.items() if all(known(*item) for item in style.items())}
    return replace(words, vocabulary=vocabulary, presets=presets)
