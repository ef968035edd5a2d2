"""`StyleSpace`, the single declaration of what can be coached.

Samplers, networks (encoding), sliders, export metadata, checkpoints and reports all read this object.
"""

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import torch
from torch import Generator, Tensor

from coachable.styles.parameters import Choice, Parameter, Setpoint, Weight
from coachable.styles.samplers import Product, Sampler, Uniform, UniformChoice

__all__ = ["Choice", "Parameter", "Setpoint", "StyleRangeWarning", "StyleSpace", "StyleView", "Weight"]

SCHEMA_VERSION = 1
_KINDS: dict[str, type] = {"weight": Weight, "setpoint": Setpoint, "choice": Choice}


class StyleRangeWarning(UserWarning):
    """A requested style lies outside the range that the agent was trained on."""


class StyleView(Mapping[str, Tensor]):
    """Named, lazily sliced columns of theta: what reward terms receive as `style`.

    `view["step_length"]` is `(...,)` for a `Weight` or `Setpoint` and `(..., n_options)` for a `Choice`. Slicing only what
    is read keeps a term library cheap in spaces of many parameters.
    """

    __slots__ = ("_columns", "theta")

    def __init__(self, theta: Tensor, columns: Mapping[str, int | slice]) -> None:
        self.theta = theta
        self._columns = columns

    def __getitem__(self, name: str) -> Tensor:
        return self.theta[..., self._columns[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)


class StyleSpace:
    """An ordered set of style parameters, their training distribution and their encoding.

    Theta is a float32 tensor `(..., dim)`, in the units of the parameters. Tensors on the space (`low`, `high`) are shared:
    do not write to them.

    Args:
        parameters: `Weight`, `Setpoint` and `Choice` declarations, in the order of theta's entries.
        sampler: Training distribution over theta; by default every parameter is uniform over its range, independent.
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
        self.low = torch.tensor(low, dtype=torch.float32, device="cpu")
        self.high = torch.tensor(high, dtype=torch.float32, device="cpu")
        self._default = torch.tensor(default, dtype=torch.float32, device="cpu")
        self._encoding = {
            torch.device("cpu"): (
                torch.tensor(shift, dtype=torch.float32, device="cpu"),
                torch.tensor(scale, dtype=torch.float32, device="cpu"),
            )
        }
        self._columns: dict[str, int | slice] = {
            p.name: self.slices[p.name] if isinstance(p, Choice) else self.slices[p.name].start for p in self.parameters
        }
        self.sampler: Sampler = _uniform_over(self.parameters) if sampler is None else sampler
        self._check_sampler()

    def __getitem__(self, name: str) -> Parameter:
        """Parameter of that name."""
        if name not in self.slices:
            raise KeyError(f"no style parameter {name!r}: expected one of {list(self.names)}")
        return self.parameters[self.names.index(name)]

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
        """The style when the coach asks for nothing, `(dim,)`."""
        return self._default.clone()

    def sample(
        self,
        shape: Sequence[int] = (),
        generator: Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draws training styles, `(*shape, dim)` float32; see `Sampler.sample`."""
        return self.sampler.sample(shape, generator, device)

    def encode(self, theta: Tensor) -> Tensor:
        """Scales theta for the networks: `f(theta) = theta / max(|low|, |high|)` (paper), or affine for "range" set-points.

        Args:
            theta: `(..., dim)`, raw.

        Returns:
            `(..., dim)`, within `[-1, 1]` for styles inside the range. One-hots stay as they are.
        """
        tensors = self._encoding.get(theta.device)
        shift, scale = self._encoding_on(theta.device) if tensors is None else tensors
        return (theta - shift) / scale

    def _encoding_on(self, device: torch.device) -> tuple[Tensor, Tensor]:
        with torch.inference_mode(False):
            shift, scale = (t.to(device) for t in self._encoding[torch.device("cpu")])
        if not torch.compiler.is_compiling():  # a traced tensor must not outlive its trace
            self._encoding[device] = (shift, scale)
        return shift, scale

    def make(self, strict: bool = False, **values: float | str) -> Tensor:
        """Builds one style from named values.

        Args:
            strict: Raise instead of clamping with a warning when a number lies outside its range.
            **values: A number per `Weight` or `Setpoint`, an option's name per `Choice`; missing ones take their default.

        Returns:
            Theta, `(dim,)` float32.

        Raises:
            ValueError: If a name or option is unknown, a value is NaN or no number, or `strict` and out of range.
        """
        theta = self.default
        for name, value in values.items():
            if name not in self.slices:
                raise ValueError(f"unknown style parameter {name!r}: expected some of {list(self.names)}.")
            parameter = self[name]
            if isinstance(parameter, Choice):
                if value not in parameter.options:
                    raise ValueError(f"{name} = {value!r} is no option: expected one of {list(parameter.options)}.")
                theta[self.slices[name]] = torch.tensor([float(o == value) for o in parameter.options])
            else:
                try:
                    theta[self.slices[name]] = float(value)
                except (TypeError, ValueError):
                    raise ValueError(
                        f"{name} = {value!r} is no number: expected one in [{parameter.low}, {parameter.high}]."
                    ) from None
        return self.clamp(theta, strict=strict)

    def clamp(self, theta: Tensor, strict: bool = False) -> Tensor:
        """Brings theta into the trained range, with a `StyleRangeWarning` that names what was changed.

        A `Choice` block that is no one-hot becomes the one-hot of its largest entry.

        Args:
            theta: `(..., dim)`.
            strict: Raise instead of changing anything.

        Returns:
            `(..., dim)` float32, a new tensor.

        Raises:
            ValueError: If the shape is wrong, a value is NaN, or `strict` and something would be changed.
        """
        problems = self._problems(theta)
        if not problems:
            return theta.to(torch.float32, copy=True)
        if strict:
            raise ValueError(_sentence(problems) + " Pass strict=False to clamp instead.")
        warnings.warn(_sentence(problems) + " Clamped to the trained range.", StyleRangeWarning, stacklevel=2)
        theta = theta.to(torch.float32)
        clamped = theta.clamp(self.low.to(theta.device), self.high.to(theta.device))
        for p in self.parameters:
            if isinstance(p, Choice):
                block = theta[..., self.slices[p.name]]
                clamped[..., self.slices[p.name]] = torch.nn.functional.one_hot(block.argmax(-1), p.width).to(
                    theta.dtype
                )
        return clamped

    def validate(self, theta: Tensor) -> None:
        """Raises a ValueError that lists what is wrong with theta: shape, NaN, range or one-hot."""
        problems = self._problems(theta)
        if problems:
            raise ValueError(_sentence(problems))

    def _problems(self, theta: Tensor) -> list[str]:
        """Range and one-hot violations, one clause per parameter. Wrong shapes and NaN raise at once."""
        if theta.ndim < 1 or theta.shape[-1] != self.dim or not theta.is_floating_point():
            raise ValueError(
                f"style has shape {tuple(theta.shape)} and type {theta.dtype}: "
                f"expected (..., {self.dim}) floating point, for {list(self.names)}."
            )
        theta = theta.to(torch.float32)
        if bool(theta.isnan().any()):
            columns = theta.isnan().reshape(-1, self.dim).any(0)
            bad = [n for n, s in self.slices.items() if bool(columns[s].any())]
            raise ValueError(f"style is NaN in {bad}: expected numbers.")
        outside = (
            ((theta < self.low.to(theta.device)) | (theta > self.high.to(theta.device))).reshape(-1, self.dim).any(0)
        )
        problems = []
        for p in self.parameters:
            block = theta[..., self.slices[p.name]]
            if isinstance(p, Choice):
                if not bool((((block == 0) | (block == 1)).all(-1) & (block.sum(-1) == 1)).all()):
                    problems.append(f"{p.name} is no one-hot of its {p.width} options {list(p.options)}")
            elif bool(outside[self.slices[p.name]].any()):
                values = sorted({f"{v:g}" for v in (block.min().item(), block.max().item())}, key=float)
                problems.append(
                    f"{p.name} = {' to '.join(values)}{_unit(p)} lies outside [{p.low:g}, {p.high:g}]{_unit(p)}"
                )
        return problems

    def view(self, theta: Tensor) -> dict[str, Tensor]:
        """Named blocks of theta: `(...,)` for a `Weight` or `Setpoint`, `(..., n_options)` for a `Choice`."""
        return {name: theta[..., column] for name, column in self._columns.items()}

    def lazy_view(self, theta: Tensor) -> StyleView:
        """Like `view`, but each block is sliced only when read."""
        return StyleView(theta, self._columns)

    def describe(self, theta: Tensor) -> dict[str, float | str]:
        """Numbers and option names of one style `(dim,)`; `make(**describe(theta))` gives it back."""
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
        """JSON-ready description, sampler included."""
        return {
            "version": SCHEMA_VERSION,
            "name": self.name,
            "parameters": [{"kind": p.kind, **asdict(p)} for p in self.parameters],
            "sampler": self.sampler.to_dict(),
        }

    @classmethod
    def from_dict(cls, description: Mapping[str, Any]) -> "StyleSpace":
        """Rebuilds a space from `to_dict`.

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
        return cls(parameters, Sampler.from_dict(description["sampler"]), description.get("name", ""))

    def to_json(self) -> str:
        """The description of `to_dict` as a JSON string."""
        return json.dumps(self.to_dict())

    @classmethod
    def from_json(cls, text: str) -> "StyleSpace":
        """Rebuilds a space from `to_json`."""
        return cls.from_dict(json.loads(text))

    def difference(self, other: "StyleSpace") -> list[str]:
        """Readable sentences on how `other` differs from this space; empty if equal."""
        return [] if self == other else ["spaces differ"]

    def _check_sampler(self) -> None:
        if self.sampler.dim != self.dim:
            raise ValueError(
                f"sampler has dimension {self.sampler.dim}, the parameters {list(self.names)} need {self.dim} numbers."
            )


def _uniform_over(parameters: Sequence[Parameter]) -> Sampler:
    return Product([UniformChoice(p.width) if isinstance(p, Choice) else Uniform(p.low, p.high) for p in parameters])


def _unit(parameter: Parameter) -> str:
    return f" {parameter.unit}" if parameter.unit else ""


def _sentence(problems: list[str]) -> str:
    return "style " + "; ".join(problems) + "."
