"""`Sampler`, the base class of all distributions over theta, with a registry for serialisation."""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from functools import lru_cache
from importlib.metadata import entry_points
from typing import Any

import torch
from torch import Generator, Tensor

_CPU = torch.device("cpu")
_REGISTRY: dict[str, type["Sampler"]] = {}


@lru_cache(maxsize=256)
def constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Return a float32 constant `(n,)` on a device. The tensor is shared, so do not write to it."""
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=torch.float32, device=device)


def numbers(values: float | Sequence[float] | Tensor) -> tuple[float, ...]:
    """Return a number, a sequence of numbers or a tensor `(n,)` as a tuple of floats."""
    if isinstance(values, Tensor):
        values = values.tolist()
    return tuple(float(v) for v in values) if isinstance(values, Sequence) else (float(values),)


class Sampler:
    """Distribution over a block of `dim` style numbers.

    To define a sampler, subclass this as a frozen dataclass with `_draw` and `support`, or with `_draw` and `dim` if
    the support is not known. Its fields are serialised and must be numbers, strings, samplers or tuples of these. Draws
    may depend on each other along the last batch dimension only (`Shared`).
    """

    @property
    def dim(self) -> int:
        """Number of entries of theta that this sampler draws."""
        if (support := self.support()) is None:
            raise NotImplementedError(f"{type(self).__name__} must define dim or support")
        return len(support[0])

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        known = _REGISTRY.get(cls.__name__, cls)
        # A class may be redefined in a notebook, but another class of its name would be used for stored descriptions.
        if (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise TypeError(
                f"a sampler named {cls.__name__} exists already, in {known.__module__}: choose another name."
            )
        _REGISTRY[cls.__name__] = cls

    def sample(
        self, shape: Sequence[int] = (), generator: Generator | None = None, device: torch.device | str | None = None
    ) -> Tensor:
        """Draw styles.

        Args:
            shape: Batch shape.
            generator: Generator to draw from; None for torch's global one.
            device: Device of the result; None for that of the generator, or without one the CPU.

        Returns:
            Styles `(*shape, dim)`, float32.
        """
        target = torch.device(device) if device is not None else generator.device if generator is not None else _CPU
        source = generator.device if generator is not None else target
        drawn = self._draw(tuple(shape), generator, source)
        return drawn if source == target else drawn.to(target)

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        raise NotImplementedError(f"{type(self).__name__} must define _draw")

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Return the lowest and highest value of each entry, or None if they are not known."""
        return None

    def to_dict(self) -> dict[str, Any]:
        """Return a description that JSON can represent, for `Sampler.from_dict`.

        Raises:
            TypeError: If the sampler is not a dataclass.
        """
        if not is_dataclass(self):
            raise TypeError(f"sampler {type(self).__name__} cannot be described: make it a frozen dataclass.")
        return {"type": type(self).__name__, **{f.name: _plain(getattr(self, f.name)) for f in fields(self)}}

    @staticmethod
    def from_dict(description: dict[str, Any]) -> "Sampler":
        """Build a sampler from the description that `to_dict` returned.

        Raises:
            ValueError: If the type is unknown, for instance because the module that defines it was not imported. Those
                of the registered domains are.
        """
        arguments = dict(description)
        kind = arguments.pop("type", None)
        if kind not in _REGISTRY:
            _import_domains_of_others()
        if kind not in _REGISTRY:
            raise ValueError(
                f"unknown sampler type {kind!r}: expected one of {sorted(_REGISTRY)}. "
                "Import the module that defines a sampler of your own."
            )
        return _REGISTRY[kind](**{name: _revived(value) for name, value in arguments.items()})


def _import_domains_of_others() -> None:
    """Import the domains that other packages register, which may define samplers of their own."""
    for entry in entry_points(group="coachable.domains"):
        if not entry.value.startswith("coachable."):
            entry.load()


def _plain(value: Any) -> Any:
    if isinstance(value, Sampler):
        return value.to_dict()
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _revived(value: Any) -> Any:
    if isinstance(value, dict):
        return Sampler.from_dict(value)
    return tuple(_revived(v) for v in value) if isinstance(value, list) else value
