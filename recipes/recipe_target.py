"""Functions and classes that a configuration names under `_target_`, with their arguments."""

import difflib
from collections.abc import Callable, Iterable
from inspect import Parameter, isclass, signature
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate


class Target(dict[str, Any]):
    """Arguments of a function or class, and its name under `_target_`; the arguments are attributes, too."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"{self.get('_target_')} is given no {name!r}.{choices(name, self)}") from None

    def build(self, *args: Any, **arguments: Any) -> Any:
        """Call the function or class with the arguments of the configuration, and with further ones.

        Raises:
            ValueError: If it cannot be imported, takes no such argument or needs others, an argument is `true` or
                `false` and the value is not, or the configuration has an argument that the recipe gives itself.
        """
        try:
            made = instantiate(self, _convert_="all", _partial_=True)
        except InstantiationException as error:
            why = " ".join(str(error.__cause__ or error).splitlines())
            raise ValueError(f"_target_={self['_target_']} or one inside it cannot be used: {why}") from error
        known = _arguments_of(made.func)
        for name, value in made.keywords.items():
            if name not in known and not any(argument.kind is Parameter.VAR_KEYWORD for argument in known.values()):
                valid = [other for other in known if other not in ("self", "args", "space")]
                raise ValueError(f"{self['_target_']} takes no {name!r}.{choices(name, valid)}")
            if name in known and known[name].annotation in (bool, "bool") and not isinstance(value, bool):
                raise ValueError(f"{name}={value} of {self['_target_']}: expected true or false")
            if name in arguments and name != "num_envs":  # one environment, for example, shows the sizes
                raise ValueError(f"{name}={value} of {self['_target_']}: the recipe sets it, expected no {name} here")
        method = made.func.__init__ if isclass(made.func) else made.func  # TorchRL's classes seem to take any argument
        try:
            signature(method).bind(*[None] * isclass(made.func), *args, **{**made.keywords, **arguments})
        except TypeError as error:
            raise ValueError(f"{self['_target_']} does not take what the recipe gives it: {error}") from error
        try:
            return made(*args, **arguments)
        except TypeError as error:  # of a function to which the target passes its further arguments on
            for name in made.keywords:
                if f"unexpected keyword argument {name!r}" in str(error):
                    raise ValueError(f"{self['_target_']} takes no {name!r}: {error}") from error
            raise


def choices(given: str, valid: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the closest valid name, and all valid ones."""
    valid = list(valid)
    close = difflib.get_close_matches(given, valid, n=1)
    guess = f" Did you mean {close[0]}?" if close else ""
    return f"{guess} Valid: {', '.join(valid) or 'none'}"


def _arguments_of(function: Callable[..., Any]) -> dict[str, Parameter]:
    """Return the arguments of a function, and for a class or its factory also those passed on by `**options`."""
    kind = function if isclass(function) else getattr(function, "__self__", None)
    known = {} if isclass(function) else dict(signature(function).parameters)
    for base in kind.__mro__ if isclass(kind) else ():
        options = [name for name, argument in known.items() if argument.kind is Parameter.VAR_KEYWORD]
        if known and not options:
            break
        for name in options:
            del known[name]
        known = {**signature(base.__init__).parameters, **known}
    return known
