"""Squashed Gaussians, ``a = tanh(u)`` with ``u = loc + scale * z``: samples, densities and sampled entropies.

The density contains ``log(1 - tanh(u)^2)``, which is ``log 0`` in float32 from ``|u|`` of about 9. It is therefore
computed as ``-2 log cosh u``, where ``log cosh u = |u| - log 2 + log1p(exp(-2|u|))``.
"""

import math
from typing import cast

import torch
from torch import Tensor

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
_TWO_LOG2_E = 2.0 * math.log2(math.e)
# Elements of one temporary tensor of the sampled entropy: 1 MB in float32 on a CPU (cache), 64 MB on an accelerator.
_CHUNK_ELEMENTS_CPU = 1 << 18
_CHUNK_ELEMENTS_DEVICE = 1 << 24


def at_least_float32(x: Tensor) -> Tensor:
    """Convert half and bfloat16 tensors to float32, and return other tensors unchanged.

    Example:
        >>> at_least_float32(torch.zeros(1, dtype=torch.bfloat16)).dtype
        torch.float32
    """
    return x.float() if x.dtype in (torch.bfloat16, torch.float16) else x


def log_cosh(u: Tensor) -> Tensor:
    """Return the logarithm of cosh elementwise (any shape), without overflow.

    Example:
        >>> log_cosh(torch.tensor([0.0, 1000.0])).tolist()
        [0.0, 999.306...]
    """
    magnitude = u.abs()
    return magnitude + torch.log1p(torch.exp(-2.0 * magnitude)) - math.log(2.0)


def sample_tanh_gaussian(loc: Tensor, scale: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Draw reparameterised actions, and return them and their log-densities.

    The density is computed from the value before the tanh. From the rounded action, the entropy at a scale of e^2 would
    be -4.8 instead of -7.07.

    Args:
        loc: Location before the tanh (..., A).
        scale: Positive standard deviation before the tanh (..., A).
        noise: Standard normal numbers (..., A); None draws them.

    Returns:
        Actions (..., A) in [-1, 1] and their log-densities per axis (..., A).
    """
    loc, scale = at_least_float32(loc), at_least_float32(scale)
    noise = torch.randn_like(loc) if noise is None else noise
    u = loc + scale * noise
    log_prob = 2.0 * log_cosh(u) - 0.5 * noise.square() - scale.log() - _HALF_LOG_2PI
    return torch.tanh(u), log_prob


def tanh_gaussian_log_prob(action: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
    """Return the log-density per axis of given actions; to draw actions, use `sample_tanh_gaussian`.

    Args:
        action: Actions (..., A) in [-1, 1], clamped to one float rounding inside the bounds.
        loc: Location before the tanh (..., A).
        scale: Standard deviation before the tanh (..., A).

    Returns:
        Log-densities (..., A).
    """
    loc, scale, action = at_least_float32(loc), at_least_float32(scale), at_least_float32(action)
    border = 1.0 - torch.finfo(action.dtype).eps
    u = torch.atanh(action.clamp(-border, border))
    return 2.0 * log_cosh(u) - 0.5 * ((u - loc) / scale).square() - scale.log() - _HALF_LOG_2PI


def tanh_gaussian_entropy(loc: Tensor, scale: Tensor, num_samples: int = 1000, *, shared_noise: bool = True) -> Tensor:
    """Return the mean negative log-density of ``num_samples`` reparameterised samples per axis.

    This is RAC's regulariser for one Gaussian axis (Appendix B; 1000 samples per component). The gradient is the exact
    derivative of the estimate: ``-2 mean tanh(u)`` for the location and ``1/scale - 2 mean(z tanh(u))`` for the scale.
    It is computed together with the value, so that no tensor of samples stays in memory.

    The draws are independent between axes and samples. By default all states of a batch share them (our choice). The
    distribution of each state's estimate is the same, errors are correlated between states, and the cost is a third.

    Args:
        loc: Location before the tanh (..., A).
        scale: Positive standard deviation before the tanh (..., A).
        num_samples: Number of draws per axis, at least 1.
        shared_noise: Whether the states of the batch share their draws.

    Returns:
        Entropy estimates (..., A) [nat].

    Raises:
        ValueError: If `num_samples` is below 1.

    Example:
        >>> h = tanh_gaussian_entropy(torch.zeros(3), torch.ones(3))
        >>> bool(((h - 0.669804).abs() < 5 * 0.218 / 1000**0.5).all())
        True
    """
    if num_samples < 1:
        raise ValueError(f"num_samples must be at least 1, got {num_samples}.")
    loc, scale = at_least_float32(loc), at_least_float32(scale)
    needs_gradient = torch.is_grad_enabled() and (loc.requires_grad or scale.requires_grad)
    with torch.autocast(loc.device.type, enabled=False):  # its matrix-vector products would round to bfloat16
        return cast(Tensor, _SampledEntropy.apply(loc, scale, num_samples, shared_noise, needs_gradient))


class _SampledEntropy(torch.autograd.Function):
    """Sampled entropy, computed with both derivatives in one pass over the samples."""

    @staticmethod
    def forward(ctx, loc: Tensor, scale: Tensor, num_samples: int, shared: bool, needs_gradient: bool) -> Tensor:
        shape, axes = loc.shape, loc.shape[-1]
        # Axes first and samples last, (A, R, n), so that every reduction and product runs over contiguous memory.
        mu, sigma = loc.detach().reshape(-1, axes).T, scale.detach().reshape(-1, axes).T
        rows = mu.shape[1]
        noise = torch.randn(axes, 1, num_samples, dtype=loc.dtype, device=loc.device) if shared else None
        limit = _CHUNK_ELEMENTS_CPU if loc.device.type == "cpu" else _CHUNK_ELEMENTS_DEVICE
        step = max(1, limit // max(1, axes * num_samples))
        parts = [
            _entropy_of_rows(mu[:, i : i + step], sigma[:, i : i + step], num_samples, noise, needs_gradient)
            for i in range(0, rows, step)
        ]
        if not parts:
            parts = [(mu, mu, mu)]  # an empty batch
        value, *derivatives = (torch.cat(column, 1).T.reshape(shape) for column in zip(*parts, strict=True))
        if needs_gradient:
            ctx.save_for_backward(*derivatives)
        return value

    @staticmethod
    def backward(ctx, grad: Tensor):  # type: ignore[override]
        by_loc, by_scale = ctx.saved_tensors
        return grad * by_loc, grad * by_scale, None, None, None


def _entropy_of_rows(
    mu: Tensor, sigma: Tensor, num_samples: int, noise: Tensor | None, needs_gradient: bool
) -> tuple[Tensor, ...]:
    """Return the entropy (A, R) of a block of rows, and its derivatives if needed, in few passes over (A, R, n).

    The rows share the noise (A, 1, n), or draw their own if it is None.

    With ``v = 2 log2(e) u``, ``exp(-2|u|)`` is ``exp2(-|v|)``, which torch computes three times as fast on a CPU.
    """
    z = torch.randn(*mu.shape, num_samples, dtype=mu.dtype, device=mu.device) if noise is None else noise
    v = (sigma * _TWO_LOG2_E).unsqueeze(-1) * z
    v += (mu * _TWO_LOG2_E).unsqueeze(-1)
    magnitude = v.abs()
    mean_magnitude = magnitude.sum(-1).div_(_TWO_LOG2_E * num_samples)
    q = magnitude.neg_().exp2_().add_(1.0)  # 1 + exp(-2|u|), in (1, 2]
    log_cosh_mean = mean_magnitude + _log_of_product(q) / num_samples - math.log(2.0)
    half_square = z.square().mean(-1).mul_(0.5)  # (A, 1) if shared, else (A, R)
    value = sigma.log() + _HALF_LOG_2PI + half_square - 2.0 * log_cosh_mean
    if not needs_gradient:
        return (value,)
    tanh = q.reciprocal_().mul_(2.0).sub_(1.0).mul_(v.sign_())
    by_loc = tanh.mean(-1).mul_(-2.0)
    if noise is not None:
        # One matrix-vector product per axis, because the batched form is ten times slower on a CPU.
        z_tanh = torch.stack([torch.mv(t, row[0]) for t, row in zip(tanh, z, strict=True)])
    else:
        z_tanh = tanh.mul_(z).sum(-1)
    return value, by_loc, sigma.reciprocal() - z_tanh.mul_(2.0 / num_samples)


def _log_of_product(q: Tensor) -> Tensor:
    """Return the sum of log q over the last axis for q in (1, 2], with an eighth as many logarithms."""
    remainder = 0.0
    for _ in range(3):
        n = q.shape[-1]
        if n % 2:
            remainder = remainder + q[..., -1].log()
        q = q[..., : n // 2] * q[..., n // 2 : 2 * (n // 2)]
    return q.log_().sum(-1) + remainder
