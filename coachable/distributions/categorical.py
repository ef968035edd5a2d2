"""Positive-part categorical heads with the regret-matching gradient, and samples from them (Appendix B).

The functions take the values of several heads, concatenated to `(..., sum of sizes)`. They compute with values padded
to `(..., heads, widest head)`, so that six gamepad heads need as many kernels as one.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from coachable.distributions.tanh_gaussian import at_least_float32

EPSILON = 1e-8
"""Mass divided among the values of a head, so that none has probability 0 (Appendix B)."""

# Preferences are clamped to this, so that the sum of a head stays finite in float32.
_LARGEST_PREFERENCE = 1e30
# Exponential draws are clamped to the rounding of a float32 uniform draw, which bounds y/pi by about 4e8.
_SMALLEST_EXPONENTIAL = 2.0**-25


class HeadLayout:
    """Layout of the values of several categorical heads in one concatenated tensor.

    Args:
        sizes: Number of values of each head, each at least 2.

    Raises:
        ValueError: If there is no head, or one has fewer than 2 values.

    Example:
        >>> layout = HeadLayout((2, 3))
        >>> layout.pad(torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0])).tolist()
        [[1.0, 2.0, 0.0], [3.0, 4.0, 5.0]]
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        self.sizes = tuple(int(size) for size in sizes)
        if not self.sizes or min(self.sizes) < 2:
            raise ValueError(f"categorical heads need at least 2 values each, got sizes {tuple(sizes)}")
        self.total = sum(self.sizes)
        self.width = max(self.sizes)
        self.uniform_width = min(self.sizes) == self.width
        self._constants: dict[tuple[torch.device, torch.dtype], tuple[Tensor, Tensor, Tensor]] = {}

    def __len__(self) -> int:
        return len(self.sizes)

    def __reduce__(self) -> tuple:  # copies and pickles leave out the cached constants
        return HeadLayout, (self.sizes,)

    def constants(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the indices for `pad` and `concatenate`, and epsilon per padded entry, 0 for padding."""
        key = (like.device, like.dtype)
        if key not in self._constants:
            into, back, epsilon, first = [], [], [], 0
            for head, size in enumerate(self.sizes):
                padding = self.width - size
                into += [*range(first, first + size), *[self.total] * padding]
                back += range(head * self.width, head * self.width + size)
                epsilon += [EPSILON / size] * size + [0.0] * padding
                first += size
            with torch.inference_mode(False):  # a later training uses them, too
                self._constants[key] = (
                    torch.tensor(into, device=like.device),
                    torch.tensor(back, device=like.device),
                    torch.tensor(epsilon, device=like.device, dtype=like.dtype).view(len(self), self.width),
                )
        return self._constants[key]

    def pad(self, values: Tensor) -> Tensor:
        """Convert concatenated `(..., total)` to `(..., heads, width)`, with zeros for narrower heads."""
        if not self.uniform_width:
            values = F.pad(values, (0, 1)).index_select(-1, self.constants(values)[0])
        return values.unflatten(-1, (len(self), self.width))

    def concatenate(self, padded: Tensor) -> Tensor:
        """Convert padded `(..., heads, width)` to concatenated `(..., total)`."""
        values = padded.flatten(-2)
        return values if self.uniform_width else values.index_select(-1, self.constants(padded)[1])


class _RegretMatching(torch.autograd.Function):
    """Function `x -> pi` whose backward pass returns the regret-matching gradient instead of the derivative."""

    @staticmethod
    def forward(ctx, x: Tensor, epsilon: Tensor) -> Tensor:
        positive = x.clamp(0.0, _LARGEST_PREFERENCE) + epsilon
        pi = positive / positive.sum(-1, keepdim=True)
        ctx.save_for_backward(pi, x < 0)
        return pi

    @staticmethod
    def backward(ctx, grad_pi: Tensor):  # type: ignore[override]
        pi, negative = ctx.saved_tensors
        # Regret of value i: the head's average loss minus that of i, because `grad_pi` is the gradient of a loss.
        regret = (grad_pi * pi).sum(-1, keepdim=True) - grad_pi
        return (-regret).masked_fill_(negative & (regret < 0), 0.0), None


def regret_matching_probabilities(x: Tensor, layout: HeadLayout) -> Tensor:
    """Return the probabilities of positive-part heads (Appendix B).

    They are `pi_i = (max(0, x_i) + eps) / sum_j (max(0, x_j) + eps)`.

    The backward pass is one regression step of regret matching instead of the derivative. Let `g` be the gradient of
    the loss with respect to the probabilities (our reading, see docs/deviations.md) and `rho_i = sum_j g_j pi_j - g_i`.
    Then `x_i` receives `-rho_i`, or 0 if `x_i < 0` and `rho_i < 0`. Therefore the probability of a value rises again
    from 0 if the value would reduce the loss.

    Args:
        x: Network outputs (..., layout.total), heads concatenated.
        layout: Layout of the heads.

    Returns:
        Probabilities (..., layout.total), float32 or wider; the sum of each head is 1.

    Example:
        >>> regret_matching_probabilities(torch.tensor([2.0, 1.0, 1.0, -1.0]), HeadLayout((4,))).tolist()
        [0.5, 0.25, 0.25, 6.2...e-10]
    """
    x = at_least_float32(x)
    epsilon = layout.constants(x)[2]
    return layout.concatenate(_RegretMatching.apply(layout.pad(x), epsilon))


def exponential_noise(like: Tensor) -> Tensor:
    """Draw standard exponential numbers E with the shape of `like` `(..., n)`, clamped away from 0.

    `-log E` is the Gumbel noise of the paper (Appendix B).
    """
    return torch.empty_like(like).exponential_().clamp_min_(_SMALLEST_EXPONENTIAL)


def relaxed_one_hots(pi: Tensor, layout: HeadLayout) -> Tensor:
    """Draw Gumbel-softmax samples at temperature 1, differentiable in `pi`.

    They are `softmax(log pi + Z)` with Z = -log E, computed as `(pi_i / E_i) / sum_j (pi_j / E_j)`. This form and its
    gradient contain neither the logarithm of a small probability nor a division by one.

    Args:
        pi: Probabilities (..., layout.total).
        layout: Layout of the heads.

    Returns:
        Relaxed one-hots (..., layout.total); the sum of each head is 1.
    """
    weights = layout.pad(pi / exponential_noise(pi))
    return layout.concatenate(weights / weights.sum(-1, keepdim=True))


def hard_one_hots(pi: Tensor, layout: HeadLayout) -> Tensor:
    """Draw exact samples without gradient: `argmax(log pi + Z)` of each head as one-hots (Gumbel-max).

    Args:
        pi: Probabilities (..., layout.total).
        layout: Layout of the heads.

    Returns:
        One-hots (..., layout.total) of the dtype of `pi`.

    Example:
        >>> hard_one_hots(torch.tensor([0.0, 1.0, 1.0, 0.0, 0.0]), HeadLayout((2, 3))).tolist()
        [0.0, 1.0, 1.0, 0.0, 0.0]
    """
    pi = pi.detach()
    return most_likely_one_hots(pi / exponential_noise(pi), layout)


def most_likely_one_hots(weights: Tensor, layout: HeadLayout) -> Tensor:
    """Return one-hots `(..., layout.total)` of each head's largest weight, of the first one if several are equal.

    Weights `(..., layout.total)` must not be negative.
    """
    padded = layout.pad(weights.detach())
    one_hots = torch.zeros_like(padded).scatter_(-1, padded.argmax(-1, keepdim=True), 1.0)
    return layout.concatenate(one_hots)


def log_probabilities(pi: Tensor) -> Tensor:
    """Return the logarithm of probabilities `(..., n)`, in the same shape.

    It stays finite for all probabilities that a head can have.
    """
    return pi.clamp_min(torch.finfo(pi.dtype).tiny).log()


def categorical_entropy(pi: Tensor) -> Tensor:
    """Return the exact entropy summed over the heads, `-sum_i pi_i log pi_i`.

    Args:
        pi: Probabilities (..., total) of one or more heads, concatenated.

    Returns:
        Entropies (...,) [nat].

    Example:
        >>> categorical_entropy(torch.tensor([0.5, 0.5, 0.25, 0.25, 0.25, 0.25])).item()  # log 2 + log 4
        2.079...
    """
    return -(pi * log_probabilities(pi)).sum(-1)
