"""Components of a mixed discrete-continuous action, and the TorchRL spec of its tensor."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.data.tensor_specs import ContinuousBox

from coachable.distributions.categorical import HeadLayout, hard_one_hots, most_likely_one_hots


@dataclass(frozen=True)
class ActionHeads:
    """Components of an action in one tensor: the one-hots of the categorical heads, then the axes.

    Args:
        categorical: Number of values of each categorical head; empty for a purely continuous action.
        axes: Number of tanh-Gaussian axes in [-1, 1]; 0 for a purely discrete action.

    Raises:
        ValueError: If there is no component, a head has fewer than 2 values, or `axes` is negative.

    Example:
        >>> gamepad = ActionHeads(categorical=(4, 6, 3, 3, 2, 2), axes=4)
        >>> gamepad.action_dim, gamepad.num_parameters
        (24, 28)
        >>> gamepad.spec((5,)).rand().shape
        torch.Size([5, 24])
    """

    categorical: tuple[int, ...] = ()
    axes: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "categorical", tuple(int(size) for size in self.categorical))
        if self.axes < 0:
            raise ValueError(f"axes must not be negative, got {self.axes}")
        if not self.categorical and not self.axes:
            raise ValueError("an action needs at least one categorical head or one axis, got neither")
        if self.categorical:
            _ = self.layout  # raises on heads of fewer than 2 values

    @cached_property
    def layout(self) -> HeadLayout:
        """Layout of the categorical heads in the tensor."""
        return HeadLayout(self.categorical)

    @property
    def num_categorical(self) -> int:
        """Total width of the one-hots."""
        return sum(self.categorical)

    @property
    def action_dim(self) -> int:
        """Width of the action tensor."""
        return self.num_categorical + self.axes

    @property
    def num_parameters(self) -> int:
        """Number of outputs of a policy: one per categorical value, location and scale per axis."""
        return self.num_categorical + 2 * self.axes

    def split(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Split `(..., action_dim)` into the one-hots `(..., num_categorical)` and the axes `(..., axes)`."""
        return action[..., : self.num_categorical], action[..., self.num_categorical :]

    def choices(self, action: Tensor) -> Tensor:
        """Return the index chosen in every categorical head: `(..., action_dim)` to `(..., heads)` int64.

        Example:
            >>> ActionHeads((2, 3)).choices(torch.tensor([0.0, 1.0, 1.0, 0.0, 0.0])).tolist()
            [1, 0]
        """
        one_hots, _ = self.split(action)
        return torch.stack([part.argmax(-1) for part in one_hots.split(self.categorical, -1)], -1)

    def from_choices(self, choices: Tensor, axes: Tensor | None = None) -> Tensor:
        """Build an action; the inverse of `choices`.

        Args:
            choices: Index of each head `(..., heads)`.
            axes: Axes `(..., axes)` in [-1, 1]; None without axes.

        Returns:
            Action `(..., action_dim)` float32.

        Example:
            >>> ActionHeads((2, 3)).from_choices(torch.tensor([1, 0])).tolist()
            [0.0, 1.0, 1.0, 0.0, 0.0]
        """
        heads = zip(choices.long().unbind(-1), self.categorical, strict=True)
        parts = [torch.nn.functional.one_hot(choice, size).float() for choice, size in heads]
        return torch.cat([*parts, axes] if axes is not None else parts, -1)

    def spec(self, batch_shape: Sequence[int] = (), device: torch.device | str | None = None) -> TensorSpec:
        """Return the action spec `(*batch_shape, action_dim)`: `Bounded` for axes only, else `MixedActionSpec`."""
        shape = torch.Size((*batch_shape, self.action_dim))
        if not self.categorical:
            return Bounded(-1.0, 1.0, shape=shape, device=device, dtype=torch.float32)
        return MixedActionSpec(self, shape, device=device)


class MixedActionSpec(TensorSpec):
    """Spec of concatenated one-hots and axes.

    TorchRL's `Bounded` would draw actions that are not one-hots, and its `MultiOneHot` has no axes.

    Args:
        heads: Components of the action.
        shape: Shape whose last dimension is `heads.action_dim`. That dimension can be neither indexed nor moved.
        device: Device of the samples.
        dtype: Floating point type of the samples.
    """

    def __init__(
        self,
        heads: ActionHeads,
        shape: Sequence[int] | None = None,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        shape = torch.Size((heads.action_dim,) if shape is None else shape)
        if not shape or shape[-1] != heads.action_dim:
            raise ValueError(f"the last dimension must be {heads.action_dim} for {heads}, got shape {tuple(shape)}")
        self.heads = heads
        device = torch.device("cpu" if device is None else device)
        high = torch.ones(shape, device=device, dtype=dtype)
        low = torch.cat((torch.zeros_like(heads.split(high)[0]), -heads.split(high)[1]), -1)
        super().__init__(
            shape=shape, space=ContinuousBox(low, high, device=device), device=device, dtype=dtype, domain="mixed"
        )
        self.encode = self._encode_eager

    def _with_shape(self, reshape: Callable[[Tensor], Tensor]) -> MixedActionSpec:
        shape = reshape(torch.empty(self.shape, device="meta")).shape
        if not shape or shape[-1] != self.heads.action_dim:
            raise ValueError(f"the last dimension of {type(self).__name__} must remain {self.heads.action_dim}")
        return MixedActionSpec(self.heads, shape, device=self.device, dtype=self.dtype)

    def rand(self, shape: Sequence[int] | None = None) -> Tensor:
        """Draw actions `(*shape, ..., action_dim)`, every head and every axis uniformly and independently."""
        full = torch.Size((*(() if shape is None else shape), *self.shape))
        action = torch.empty(full, device=self.device, dtype=self.dtype)
        one_hots, axes = self.heads.split(action)
        one_hots.copy_(hard_one_hots(torch.ones_like(one_hots), self.heads.layout))
        axes.uniform_(-1.0, 1.0)
        return action

    def is_in(self, val: Tensor) -> bool:
        """Return whether every head of actions `(..., action_dim)` is a one-hot and every axis is in [-1, 1]."""
        if val.shape[-len(self.shape) :] != self.shape or val.dtype != self.dtype:
            return False
        one_hots, axes = self.heads.split(val)
        binary = bool(((one_hots == 0) | (one_hots == 1)).all())
        single = bool((self.heads.layout.pad(one_hots).sum(-1) == 1).all())
        return binary and single and bool((axes.abs() <= 1).all())

    def _project(self, val: Tensor) -> Tensor:
        one_hots, axes = self.heads.split(val)
        weights = one_hots - one_hots.amin(-1, keepdim=True) + 1.0
        return torch.cat((most_likely_one_hots(weights, self.heads.layout), axes.clamp(-1.0, 1.0)), -1)

    def cardinality(self) -> float:
        """Return the number of distinct actions, which is infinite with axes."""
        return math.inf if self.heads.axes else math.prod(self.heads.categorical)

    def enumerate(self, use_mask: bool = False) -> Tensor:
        """Return all actions of purely categorical heads, `(cardinality, action_dim)`."""
        if self.heads.axes:
            raise NotImplementedError("an action with axes cannot be enumerated")
        choices = torch.cartesian_prod(*(torch.arange(size) for size in self.heads.categorical))
        choices = choices.reshape(-1, len(self.heads.categorical))
        return self.heads.from_choices(choices).to(device=self.device, dtype=self.dtype)

    def index(self, index: Any, tensor_to_index: Tensor) -> Tensor:
        """Raise a `NotImplementedError`, because mixed actions cannot index tensors."""
        raise NotImplementedError(f"{type(self).__name__} cannot index tensors")

    def expand(self, *shape: Any) -> MixedActionSpec:
        """Expand the leading dimensions."""
        return self._with_shape(lambda x: x.expand(*shape))

    def squeeze(self, dim: int | None = None) -> MixedActionSpec:
        """Drop one leading dimension of size 1, or all."""
        return self._with_shape(lambda x: x.squeeze() if dim is None else x.squeeze(dim))

    def unsqueeze(self, dim: int) -> MixedActionSpec:
        """Insert a leading dimension."""
        return self._with_shape(lambda x: x.unsqueeze(dim))

    def unbind(self, dim: int = 0) -> tuple[MixedActionSpec, ...]:
        """Return one spec per element of a leading dimension.

        Raises:
            ValueError: If `dim` is not a leading dimension.
        """
        if not -self.ndim <= dim < self.ndim - 1 or dim == -1:
            raise ValueError(f"cannot unbind dimension {dim} of shape {tuple(self.shape)}")
        return tuple(self._with_shape(lambda x: x.select(dim, 0)) for _ in range(self.shape[dim]))

    def _reshape(self, shape: torch.Size) -> MixedActionSpec:
        return self._with_shape(lambda x: x.reshape(shape))

    def _unflatten(self, dim: int, sizes: tuple[int, ...]) -> MixedActionSpec:
        return self._with_shape(lambda x: x.unflatten(dim, sizes))

    def __getitem__(self, idx: Any) -> MixedActionSpec:
        return self._with_shape(lambda x: x[idx])

    def to(self, dest: torch.device | str | int | torch.dtype | None) -> MixedActionSpec:
        """Change device or floating point type."""
        if dest is None:
            return self
        change = {"dtype": dest} if isinstance(dest, torch.dtype) else {"device": torch.device(dest)}
        return MixedActionSpec(self.heads, self.shape, **{"device": self.device, "dtype": self.dtype, **change})

    def clone(self) -> MixedActionSpec:
        """Return a copy."""
        return MixedActionSpec(self.heads, self.shape, device=self.device, dtype=self.dtype)

    def __eq__(self, other: object) -> bool:
        names = ("heads", "shape", "device", "dtype")
        return isinstance(other, MixedActionSpec) and all(getattr(self, n) == getattr(other, n) for n in names)

    def __hash__(self) -> int:
        return hash((self.heads, self.shape, self.dtype))
