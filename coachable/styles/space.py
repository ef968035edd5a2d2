"""`StyleSpace`, the declaration of what can be coached.

Samplers, networks, sliders, export metadata, checkpoints and reports all read this object.
"""

import json
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import torch
from torch import Generator, Tensor
from torch.nn.functional import one_hot

from coachable.styles.difference import differences
from coachable.styles.parameters import Choice, Parameter, Setpoint, Weight
from coachable.styles.samplers import Product, Sampler, Uniform, UniformChoice
from coachable.styles.validation import StyleRangeWarning, violations
from coachable.styles.view import StyleView

SCHEMA_VERSION = 1
_KINDS: dict[str, type] = {"weight": Weight, "setpoint": Setpoint, "choice": Choice}


class StyleSpace:
    """Ordered set of style parameters with their training distribution and encoding.

    Theta is a float32 tensor `(..., dim)`, in the units of the parameters. The space maps names to parameters like a
    dictionary: `space["pose"]`, `"pose" in space`, `for name in space`.

    Attributes:
        parameters: Declarations, in the order of theta's entries.
        names: Names of the parameters.
        dim: Number of entries of theta.
        low: Lower bounds `(dim,)`, float32. Do not write to them.
        high: Upper bounds `(dim,)`, float32. Do not write to them.
        slices: Slices of theta by parameter name.
        columns: Indices into theta by parameter name: an integer for a `Weight` or `Setpoint`, a slice for a `Choice`.
        sampler: Training distribution.

    Args:
        parameters: `Weight`, `Setpoint` and `Choice` declarations, in the order of theta's entries.
        sampler: Training distribution over theta; by default parameters are independent and uniform over their ranges.
        name: Name of the space, for reports and error messages.

    Raises:
        ValueError: If names repeat, or the sampler's dimension, range or one-hots do not fit the parameters.

    Examples:
        >>> space = StyleSpace([Choice("pose", ("front", "t_pose")), Setpoint("step_length", 0.3, 0.6, unit="m")])
        >>> space.make(pose="t_pose", step_length=0.5)
        tensor([0.0000, 1.0000, 0.5000])
        >>> space.encode(space.make(step_length=0.3))
        tensor([1.0000, 0.0000, 0.5000])
    """

    def __init__(self, parameters: Sequence[Parameter], sampler: Sampler | None = None, name: str = "") -> None:
        self.parameters: tuple[Parameter, ...] = tuple(parameters)
        self.name = name
        self.names: tuple[str, ...] = tuple(p.name for p in self.parameters)
        if not self.names or len(set(self.names)) < len(self.names):
            raise ValueError(f"StyleSpace has the parameters {self.names}: expected at least one, with distinct names.")
        self.slices: dict[str, slice] = {}
        low, high, shift, scale, default = [], [], [], [], []
        for p in self.parameters:
            self.slices[p.name] = slice(len(low), len(low) + p.width)
            low += [p.low] * p.width
            high += [p.high] * p.width
            affine = p.encoding == "range"
            shift += [(p.low + p.high) / 2 if affine else 0.0] * p.width
            scale += [(p.high - p.low) / 2 if affine else max(abs(p.low), abs(p.high))] * p.width
            default += [float(o == p.default) for o in p.options] if isinstance(p, Choice) else [p.default]
        self.dim = len(low)
        vectors = (low, high, default, shift, scale)
        tensors = (torch.tensor(vector, dtype=torch.float32, device="cpu") for vector in vectors)
        self.low, self.high, self._default, *encoding = tensors
        self._encoding: dict[torch.device, tuple[Tensor, Tensor]] = {torch.device("cpu"): (encoding[0], encoding[1])}
        self.columns: dict[str, int | slice] = {
            p.name: self.slices[p.name] if isinstance(p, Choice) else self.slices[p.name].start for p in self.parameters
        }
        self._columns_of: dict[tuple[str, ...], slice | list[int] | None] = {}
        self.sampler: Sampler = _uniform_over(self.parameters) if sampler is None else sampler
        self._check_sampler()

    def __getitem__(self, name: str) -> Parameter:
        """Return the parameter of a name."""
        if name not in self.slices:
            raise KeyError(f"no style parameter named {name}: expected {', '.join(self.names)}")
        return self.parameters[self.names.index(name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __contains__(self, name: object) -> bool:
        return name in self.slices

    def __repr__(self) -> str:
        lines = "".join(f"\n    {p}," for p in self.parameters)
        return f"StyleSpace({self.name!r}, dim={self.dim},{lines}\n    sampler={self.sampler})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StyleSpace) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.name, self.parameters))

    @property
    def default(self) -> Tensor:
        """Style `(dim,)` of the parameters' defaults."""
        return self._default.clone()

    def sample(
        self, shape: Sequence[int] = (), generator: Generator | None = None, device: torch.device | str | None = None
    ) -> Tensor:
        """Draw training styles `(*shape, dim)`, float32, not encoded; see `Sampler.sample` for the arguments."""
        return self.sampler.sample(shape, generator, device)

    def with_sampler(self, sampler: Sampler) -> "StyleSpace":
        """Return a space of the same parameters with another training distribution."""
        return StyleSpace(self.parameters, sampler, self.name)

    def encode(self, theta: Tensor) -> Tensor:
        """Scale theta for the networks: `theta / max(|low|, |high|)` (paper's f), affine for "range" set-points.

        Args:
            theta: Styles `(..., dim)`.

        Returns:
            Encoded styles `(..., dim)`, in [-1, 1] for styles inside the range. One-hots do not change.
        """
        tensors = self._encoding.get(theta.device)
        shift, scale = self._encoding_on(theta.device) if tensors is None else tensors
        return (theta - shift) / scale

    def _encoding_on(self, device: torch.device) -> tuple[Tensor, Tensor]:
        with torch.inference_mode(False):
            shift, scale = (t.to(device) for t in self._encoding[torch.device("cpu")])
        if not torch.compiler.is_compiling():  # a traced tensor must not be used after its trace
            self._encoding[device] = (shift, scale)
        return shift, scale

    def make(self, /, strict: bool = False, **values: float | str) -> Tensor:
        """Return one style from named values.

        Args:
            strict: Whether to raise instead of clamping with a warning if a number lies outside its range.
            **values: A number per `Weight` or `Setpoint`, an option's name per `Choice`; the others have their default.

        Returns:
            Theta `(dim,)`, float32.

        Raises:
            ValueError: If a name or option is unknown, a value is NaN or not a number, or out of range with `strict`.
        """
        theta = self.default
        for name, value in values.items():
            if name not in self.slices:
                raise ValueError(f"unknown style parameter {name!r}: expected some of {list(self.names)}.")
            parameter = self[name]
            if isinstance(parameter, Choice):
                if value not in parameter.options:
                    raise ValueError(f"{name} = {value!r} is not an option: expected one of {list(parameter.options)}.")
                theta[self.slices[name]] = torch.tensor([float(o == value) for o in parameter.options])
            else:
                try:
                    largest = torch.finfo(theta.dtype).max  # torch does not convert larger ones; NaN stays
                    theta[self.slices[name]] = min(max(float(value), -largest), largest)
                except (TypeError, ValueError, OverflowError):
                    raise ValueError(
                        f"{name} = {value!r} is not a number: expected one in [{parameter.low}, {parameter.high}]."
                    ) from None
        return self.clamp(theta, strict=strict)

    def make_all(self, styles: Iterable[Mapping[str, Any]]) -> Tensor:
        """Return several styles from named values.

        Args:
            styles: Values by parameter name of each style, as in `make`.

        Returns:
            Theta `(number of styles, dim)`, float32.

        Raises:
            ValueError: If a name or option is unknown, or a value is not a number or out of range.
        """
        return torch.stack([self.make(strict=True, **style) for style in styles])

    def clamp(self, theta: Tensor, strict: bool = False) -> Tensor:
        """Clamp theta to the trained range, with a `StyleRangeWarning` that names the changed parameters.

        A `Choice` block that is not a one-hot becomes the one-hot of its largest entry.

        Args:
            theta: Styles `(..., dim)`.
            strict: Whether to raise instead of changing theta.

        Returns:
            Styles `(..., dim)`, float32, in a new tensor.

        Raises:
            ValueError: If the shape is wrong, a value is NaN, or theta is out of range with `strict`.
        """
        clauses = violations(self.parameters, self.low, self.high, theta)
        if not clauses:
            return theta.to(torch.float32, copy=True)
        message = f"style {'; '.join(clauses)}."
        if strict:
            raise ValueError(f"{message} Pass strict=False to clamp instead.")
        warnings.warn(f"{message} Clamped to the trained range.", StyleRangeWarning, stacklevel=2)
        theta = theta.to(torch.float32)
        clamped = theta.clamp(self.low.to(theta.device), self.high.to(theta.device))
        for p in self.parameters:
            if isinstance(p, Choice):
                block = self.slices[p.name]
                clamped[..., block] = one_hot(theta[..., block].argmax(-1), p.width).to(torch.float32)
        return clamped

    def validate(self, theta: Tensor) -> None:
        """Check the shape and the values of theta.

        Args:
            theta: Styles `(..., dim)`, not encoded.

        Raises:
            ValueError: If the shape is wrong, a value is NaN or out of range, or a `Choice` block is not a one-hot.
        """
        if clauses := violations(self.parameters, self.low, self.high, theta):
            raise ValueError(f"style {'; '.join(clauses)}.")

    def view(self, theta: Tensor) -> StyleView:
        """Return a mapping of names to columns of theta `(..., dim)`, sliced lazily."""
        return StyleView(self.columns, self.columns_of, theta)

    def columns_of(self, names: tuple[str, ...]) -> slice | list[int] | None:
        """Return the columns of several parameters in that order: a slice if adjacent, or None for all of theta."""
        if names not in self._columns_of:
            indices = [i for name in names for i in range(self.slices[name].start, self.slices[name].stop)]
            adjacent = indices == list(range(indices[0], indices[0] + len(indices)))
            found = slice(indices[0], indices[-1] + 1) if adjacent else indices
            self._columns_of[names] = None if adjacent and len(indices) == self.dim else found
        return self._columns_of[names]

    def describe(self, theta: Tensor) -> dict[str, float | str]:
        """Return numbers and option names of one style `(dim,)` by name, from which `make` builds it again.

        Raises:
            ValueError: If theta is not a single style of this space.
        """
        if tuple(theta.shape) != (self.dim,):
            raise ValueError(f"style has shape {tuple(theta.shape)}: expected ({self.dim},), one style.")
        values = theta.detach().to("cpu", torch.float32)
        return {
            p.name: p.options[int(values[self.slices[p.name]].argmax())]
            if isinstance(p, Choice)
            else values[self.slices[p.name]].item()
            for p in self.parameters
        }

    def to_dict(self) -> dict[str, Any]:
        """Return a description of the space and its sampler that JSON can represent."""
        return {
            "version": SCHEMA_VERSION,
            "name": self.name,
            "parameters": [{"kind": p.kind, **asdict(p, dict_factory=_plain)} for p in self.parameters],
            "sampler": self.sampler.to_dict(),
        }

    @classmethod
    def from_dict(cls, description: Mapping[str, Any]) -> "StyleSpace":
        """Build a space from the description that `to_dict` returned.

        Raises:
            ValueError: If the schema version, a kind of parameter or a sampler is unknown.
        """
        if description.get("version") != SCHEMA_VERSION:
            raise ValueError(
                f"style space has schema version {description.get('version')!r}: "
                f"this release reads version {SCHEMA_VERSION}."
            )
        parameters = []
        for entry in description["parameters"]:
            arguments = {k: tuple(v) if isinstance(v, list) else v for k, v in entry.items() if k != "kind"}
            if entry.get("kind") not in _KINDS:
                raise ValueError(f"style parameter of kind {entry.get('kind')!r}: expected one of {sorted(_KINDS)}.")
            parameters.append(_KINDS[entry["kind"]](**arguments))
        sampler = None if description["sampler"] is None else Sampler.from_dict(description["sampler"])
        return cls(parameters, sampler, description.get("name", ""))

    def to_json(self) -> str:
        """Return the description of `to_dict` as a JSON string."""
        return json.dumps(self.to_dict(), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> "StyleSpace":
        """Build a space from the string that `to_json` returned."""
        return cls.from_dict(json.loads(text))

    def difference(self, other: "StyleSpace") -> list[str]:
        """List the differences between this space ("here") and `other` ("there") as sentences."""
        found = differences(self.parameters, other.parameters)
        if self.name != other.name:
            found.insert(0, f"The space is called {self.name!r} here, {other.name!r} there.")
        if self.sampler != other.sampler:
            found.append(f"Styles are drawn from {self.sampler} here, from {other.sampler} there.")
        return found

    def encodes_like(self, other: "StyleSpace") -> bool:
        """Return whether the entries of both spaces and their encoding are equal, so that networks can be reused."""
        ours, theirs = (
            [(p.name, p.kind, p.options, p.encoding, p.low, p.high) for p in space.parameters]
            for space in (self, other)
        )
        return ours == theirs

    def _check_sampler(self) -> None:
        if self.sampler.dim != self.dim:
            raise ValueError(
                f"the sampler draws {self.sampler.dim} numbers, the parameters {list(self.names)} need {self.dim}: "
                f"{self.sampler}."
            )
        # Draws show a wrong order of components, and wrong ranges of samplers without `support`.
        trial = self.sampler.sample((64,), torch.Generator().manual_seed(0))
        for theta in [trial, *self._corners()]:
            try:
                self.validate(theta)
            except ValueError as error:
                raise ValueError(f"the sampler does not fit the parameters: it draws a {error}") from None

    def _corners(self) -> list[Tensor]:
        """Return the styles of lowest and highest values of the sampler's support, with choices at their default."""
        support = self.sampler.support()
        if support is None:
            return []
        corners = [torch.tensor(bounds, dtype=torch.float32) for bounds in support]
        for p in self.parameters:
            if isinstance(p, Choice):
                for corner in corners:
                    corner[self.slices[p.name]] = self._default[self.slices[p.name]]
        return corners


def _uniform_over(parameters: Sequence[Parameter]) -> Sampler:
    return Product([UniformChoice(p.width) if isinstance(p, Choice) else Uniform(p.low, p.high) for p in parameters])


def _plain(fields: list[tuple[str, Any]]) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in fields}
