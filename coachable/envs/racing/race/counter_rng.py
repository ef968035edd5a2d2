"""Random numbers that are a function of a race's seed and episode, independent of the other races."""

import math

import torch
from torch import Tensor

# Constants of the splitmix64 generator, as signed 64-bit numbers: products wrap around.
_STEP, _MIX1, _MIX2 = -0x61C8864680B583EB, -0x40A7B892E31B1A47, -0x6B2FB644ECCEEE15
_RACE, _EPISODE = 0x2545F4914F6CDD1D, 0x5851F42D4C957F2D


def _shift(value: Tensor, bits: int) -> Tensor:
    """Shift to the right logically, without copies of the sign bit."""
    return (value >> bits) & ((1 << (64 - bits)) - 1)


def uniforms(seed: Tensor, episode: Tensor, rows: int, cars: int) -> Tensor:
    """Draw uniform numbers in [0, 1).

    Args:
        seed: Seed of each race (B,) int64.
        episode: Number of episodes that each race has started (B,) int64.
        rows: Count of numbers per car.
        cars: Number A of cars in a race.

    Returns:
        Numbers (rows, A, B) float32.
    """
    counter = torch.arange(1, rows * cars + 1, device=seed.device).reshape(rows, cars, 1)
    z = (seed * _RACE) ^ (episode * _EPISODE)
    z = _finish(_finish(z) + counter * _STEP)
    return _shift(z, 40).to(torch.float32) / float(1 << 24)


def _finish(z: Tensor) -> Tensor:
    z = (z ^ _shift(z, 30)) * _MIX1
    z = (z ^ _shift(z, 27)) * _MIX2
    return z ^ _shift(z, 31)


def normal(u1: Tensor, u2: Tensor) -> Tensor:
    """Transform two uniform numbers to a standard normal one (Box and Muller 1958).

    Args:
        u1: Numbers in [0, 1), any shape.
        u2: Numbers in [0, 1) of the same shape.

    Returns:
        Numbers of the same shape.
    """
    return torch.sqrt(-2.0 * torch.log1p(-u1)) * torch.cos(2.0 * math.pi * u2)
