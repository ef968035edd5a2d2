"""Numerics of the losses in pure torch: bootstrap targets, pessimistic quantiles, quantile regression."""

import torch
from torch import Tensor

# Elements of one (rows, M, M') block of the quantile loss: 512 kB in float32 on a CPU, 64 MB on an accelerator.
_BLOCK_ELEMENTS_CPU = 1 << 17
_BLOCK_ELEMENTS_DEVICE = 1 << 24


def bootstrap_target(
    reward: Tensor, next_value: Tensor, terminated: Tensor, gamma: Tensor | float, steps: Tensor | None = None
) -> Tensor:
    """Return the TD target `R + gamma^k (1 - d) V'`.

    The value of a terminal state is replaced by 0 instead of multiplied by 0, because it may be NaN.

    Args:
        reward: Discounted sum of the rewards of `steps` steps (...,).
        next_value: Value (...,) or its quantiles (..., M) at the last state of the sum.
        terminated: Whether that state is terminal (...,), bool. A truncated step is not terminal.
        gamma: Discount per step.
        steps: Number of steps summed (...,); None for 1.

    Returns:
        The target, in the shape of `next_value`.

    Example:
        >>> value, terminated = torch.tensor([10.0, float("nan")]), torch.tensor([False, True])
        >>> bootstrap_target(torch.ones(2), value, terminated, 0.9).tolist()
        [10.0, 1.0]
    """
    discount = gamma if steps is None else torch.as_tensor(gamma**steps).to(next_value.dtype)
    if next_value.ndim > reward.ndim:
        reward, terminated = reward.unsqueeze(-1), terminated.unsqueeze(-1)
        discount = discount.unsqueeze(-1) if isinstance(discount, Tensor) and discount.ndim else discount
    return reward + torch.where(terminated, 0.0, discount * next_value)


def pessimistic_quantiles(quantiles: Tensor) -> Tensor:
    """Return all quantiles of the critic with the lowest mean, or of the first such critic.

    Args:
        quantiles: Quantiles of K critics (K, ..., M).

    Returns:
        Quantiles (..., M).

    Example:
        >>> pessimistic_quantiles(torch.tensor([[0.0, 4.0], [1.0, 2.0]])).tolist()
        [1.0, 2.0]
    """
    best = quantiles[0]
    for candidate in quantiles[1:]:  # not argmin, whose index is undefined if means are equal
        lower = candidate.mean(-1, keepdim=True) < best.mean(-1, keepdim=True)
        best = torch.where(lower, candidate, best)
    return best


def quantile_huber_loss(prediction: Tensor, target: Tensor, *, kappa: float = 1.0) -> Tensor:
    """Return the quantile Huber loss of every prediction against every target (QR-DQN, IQN).

    It is the mean over predictions and targets of `|tau_i - 1{u_ij < 0}| L_kappa(u_ij) / kappa` with
    `u_ij = target_j - prediction_i` and the midpoints `tau_i = (2i - 1) / (2M)`. Other libraries sum over predictions,
    which gives M times as much. This factor affects gradient clipping, but not Adam.

    Args:
        prediction: Predicted quantiles (..., M), which may have leading dimensions that `target` lacks.
        target: Samples or quantiles of the target (..., M'), which get no gradient.
        kappa: Error at which the loss changes from quadratic to linear; 0 for the pinball loss `|tau - 1{u < 0}| |u|`.

    Returns:
        Losses (...,).

    Raises:
        ValueError: If `kappa` is negative.

    Example:
        >>> quantile_huber_loss(torch.zeros(10), torch.ones(10)).item()
        0.25
    """
    if kappa < 0:
        raise ValueError(f"kappa must not be negative, got {kappa}")
    count = prediction.shape[-1]
    fractions = (torch.arange(count, device=prediction.device, dtype=prediction.dtype) + 0.5) / count
    scale = 1.0 / target.shape[-1] / count / (kappa or 1.0)
    needs_gradient = torch.is_grad_enabled() and prediction.requires_grad
    return _QuantileHuber.apply(prediction, target.detach(), fractions, float(kappa), scale, needs_gradient)


class _QuantileHuber(torch.autograd.Function):
    """Quantile Huber loss, computed with its gradient in one pass over blocks that fit in a cache.

    With autograd, six (..., M, M') tensors would go through main memory and take longer than a critic. Let c be the
    clipped error and h the Huber loss. Both weights are `1/2 + (tau - 1/2) sign(u)`, so that row sums are enough:
    `loss_i = sum_j h/2 + (tau_i - 1/2) sign(u) h` and `-gradient_i = sum_j c/2 + (tau_i - 1/2) |c|`.
    """

    @staticmethod
    def forward(
        ctx, prediction: Tensor, target: Tensor, fractions: Tensor, kappa: float, scale: float, needs_gradient: bool
    ) -> Tensor:
        shape = prediction.shape
        centred = (fractions - 0.5).expand(shape).reshape(-1, shape[-1])
        target = target.expand(*shape[:-1], target.shape[-1]).reshape(-1, target.shape[-1])
        flat = prediction.detach().reshape(-1, shape[-1])
        limit = _BLOCK_ELEMENTS_CPU if flat.device.type == "cpu" else _BLOCK_ELEMENTS_DEVICE
        step = max(1, limit // max(1, shape[-1] * target.shape[-1]))
        loss, gradient = flat.new_empty(flat.shape[0]), torch.empty_like(flat)
        for i in range(0, flat.shape[0], step):
            rows = slice(i, i + step)
            u = target[rows].unsqueeze(-2) - flat[rows].unsqueeze(-1)
            if kappa > 0:
                clipped = u.clamp(-kappa, kappa)
                huber = torch.sub(u, clipped, alpha=0.5).mul_(clipped)
            else:
                clipped = u.sign()
                huber = u * clipped
            even = huber.sum(-1)
            odd = huber.mul_(u.sign_()).sum(-1)
            loss[rows] = torch.addcmul(0.5 * even, centred[rows], odd).sum(-1)
            if needs_gradient:
                total = clipped.sum(-1)
                gradient[rows] = torch.addcmul(0.5 * total, centred[rows], clipped.abs_().sum(-1))
        if needs_gradient:
            ctx.save_for_backward(gradient.mul_(-scale).reshape(shape))
        return loss.mul_(scale).reshape(shape[:-1])

    @staticmethod
    def backward(ctx, grad: Tensor):  # type: ignore[override]
        (by_prediction,) = ctx.saved_tensors
        return grad.unsqueeze(-1) * by_prediction, None, None, None, None, None
