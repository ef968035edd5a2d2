"""Differences between the parameters of two style spaces, for checkpoints that were trained on another one."""

from collections.abc import Sequence
from typing import Any

from coachable.styles.parameters import Parameter

_WORDS = {
    "default": "defaults to",
    "encoding": "is encoded by",
    "evaluation": "is evaluated over",
    "help": "says",
    "options": "offers",
    "unit": "has the unit",
}


def differences(here: Sequence[Parameter], there: Sequence[Parameter]) -> list[str]:
    """List the differences between parameters, called "here" and "there", as sentences; none if they are equal."""
    ours, theirs = {p.name: p for p in here}, {p.name: p for p in there}
    found = [f"{name} exists only here." for name in ours if name not in theirs]
    found += [f"{name} exists only there." for name in theirs if name not in ours]
    shared = [name for name in ours if name in theirs]
    order = [name for name in theirs if name in ours]
    if shared != order:
        found.append(f"The parameters are ordered {', '.join(shared)} here, {', '.join(order)} there.")
    for name in shared:
        found += _between(ours[name], theirs[name])
    return found


def _between(here: Parameter, there: Parameter) -> list[str]:
    if here.kind != there.kind:
        return [f"{here.name} is a {here.kind} here, a {there.kind} there."]
    found = []
    if (here.low, here.high) != (there.low, there.high):
        found.append(f"{here.name} ranges over {_range(here)} here, over {_range(there)} there.")
    for attribute, verb in _WORDS.items():
        ours, theirs = getattr(here, attribute, None), getattr(there, attribute, None)
        if ours != theirs:
            found.append(f"{here.name} {verb} {_shown(ours)} here, {_shown(theirs)} there.")
    return found


def _range(parameter: Parameter) -> str:
    return f"[{parameter.low:g}, {parameter.high:g}]{' ' + parameter.unit if parameter.unit else ''}"


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value) + "]"
    return f"{value:g}" if isinstance(value, float) else repr(value)
