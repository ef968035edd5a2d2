"""Choice of the numeric precision in which a device trains."""

from typing import Literal, get_args

import torch

Precision = Literal["auto", "fp32", "bf16"]


def supports_bf16(device: torch.device | str = "cpu") -> bool:
    """Return whether `device` multiplies bfloat16 matrices in hardware; otherwise bfloat16 is slower than float32.

    This is true for CPUs with AVX512-BF16 or AMX, and for CUDA devices that report bfloat16 support.
    """
    kind = torch.device(device).type
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if kind == "cpu":
        capabilities = torch.cpu.get_capabilities()
        return torch.backends.mkldnn.is_available() and any(
            bool(capabilities.get(name)) for name in ("avx512_bf16", "amx_bf16")
        )
    return False


def resolve_precision(precision: Precision, device: torch.device | str = "cpu") -> Literal["fp32", "bf16"]:
    """Return the given precision, and for `"auto"` the faster one on `device`.

    Args:
        precision: `"auto"`, `"fp32"` or `"bf16"`. The last is returned even if it is slow on `device`.
        device: Device of the parameters.

    Raises:
        ValueError: If `precision` is none of the three.

    Example:
        >>> resolve_precision("fp32")
        'fp32'
    """
    if precision not in get_args(Precision):
        raise ValueError(f"precision must be one of {get_args(Precision)}, got {precision!r}")
    if precision == "auto":
        return "bf16" if supports_bf16(device) else "fp32"
    return precision
