"""Readable differences between two style spaces, for checkpoints that were trained on another one."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from coachable.styles.parameters import Parameter
    from coachable.styles.space import StyleSpace

_WORDS = {
    "default": "defaults to",
    "encoding": "is encoded by",
    "evaluation": "is evaluated over",
    "help": "says",
    "options": "offers",
    "unit": "has the unit",
}


def differences(here: "StyleSpace", there: "StyleSpace") -> list[str]:
    """Sentences on how `there` differs from `here`; empty if the spaces are equal."""
    found = []
    if here.name != there.name:
        found.append(f"The space is called {here.name!r} here, {there.name!r} there.")
    found += [f"{name} exists only here." for name in here.names if name not in there]
    found += [f"{name} exists only there." for name in there.names if name not in here]
    shared = [name for name in here.names if name in there]
    order = [name for name in there.names if name in here]
    if shared != order:
        found.append(f"The parameters are ordered {', '.join(shared)} here, {', '.join(order)} there.")
    for name in shared:
        found += _between(here[name], there[name])
    if here.sampler != there.sampler:
        found.append(f"Styles are drawn from {here.sampler} here, from {there.sampler} there.")
    return found


def _between(here: "Parameter", there: "Parameter") -> list[str]:
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


def _range(parameter: "Parameter") -> str:
    return f"[{parameter.low:g}, {parameter.high:g}]{' ' + parameter.unit if parameter.unit else ''}"


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value) + "]"
    return f"{value:g}" if isinstance(value, float) else repr(value)
