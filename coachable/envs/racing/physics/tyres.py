"""Tyres: combined slip, implicit wheel spin, heat and wear."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

SLIP_SPEED = 3.0  # [m/s], keeps slip finite at rest
HEAT_CAPACITY = 4000.0  # [J/K]
HEAT_SHARE = 0.55  # of the slip power that heats the tyre
HEAT_PER_LOAD = 0.004  # rolling loss, of load times speed
COOLING = (30.0, 0.9)  # [W/K] and [W s/(K m)]
AMBIENT = 30.0  # [°C]
HEAT_MAX = 160.0  # [°C]; without it, sustained wheelspin reached 360 °C
BEST_HEAT = 90.0  # [°C], of the largest grip
WEAR_ENERGY = 1e8  # [J] of slip for wear 1


def tangent(angle: Any) -> Any:
    """Tangent of a number or a tensor."""
    return torch.tan(angle) if isinstance(angle, Tensor) else math.tan(angle)


def slip_curve(rho: Tensor, shape: Any) -> Tensor:
    """Normalised force over normalised slip, sin(C atan(B ρ)) / ρ; B puts the peak at ρ = 1."""
    stiffness = tangent(math.pi / 2 / shape)
    return torch.sin(shape * torch.atan(stiffness * rho)) / rho


class WheelForces(NamedTuple):
    """Of one wheel of N cars, in the wheel's frame."""

    spin: Tensor  # [rad/s] at the end of the substep
    fx: Tensor  # [N]
    fy: Tensor  # [N]
    lateral_damping: Tensor  # -fy over lateral speed [N s/m]
    slip_power: Tensor  # [W]


def roll_wheel(
    v_long: Tensor,
    v_lat: Tensor,
    spin: Tensor,
    grip_force: Tensor,
    drive: Any,
    brake: Tensor,
    inertia: Any,
    h: float,
    radius: Any,
    peak_ratio: Any,
    peak_tangent: Any,
    shape: Any,
) -> WheelForces:
    """Advance a wheel's spin implicitly and return the tyre's forces.

    The spin settles within a fraction of a substep, so the force is linearised as a secant, k (ωR - v). Brake torque is
    Coulomb friction: it stops the wheel exactly and never turns it backwards.

    Args:
        v_long: (N,) speed of the wheel's centre along the wheel [m/s].
        v_lat: (N,) across the wheel, to the left [m/s].
        spin: (N,) [rad/s].
        grip_force: (N,) largest force, μ Fz [N].
        drive: (N,) torque of the engine and the differential [N m].
        brake: (N,) torque of everything that resists the rotation, not negative [N m].
        inertia: of the wheel and what turns with it [kg m²].
        h: substep [s].
        radius: [m].
        peak_ratio: slip ratio of the largest force.
        peak_tangent: tangent of the slip angle of the largest force.
        shape: C of the curve.
    """
    den = torch.sqrt(v_long * v_long + SLIP_SPEED * SLIP_SPEED)
    sy = v_lat / (den * peak_tangent)
    sy2 = sy * sy + 1e-8
    ratio_scale = 1.0 / (den * peak_ratio)

    def curve(omega: Tensor) -> Tensor:
        sx = (omega * radius - v_long) * ratio_scale
        return slip_curve(torch.sqrt(sx * sx + sy2), shape)

    def spin_with(secant: Tensor) -> Tensor:
        total = inertia / h + radius * radius * secant
        free = (inertia / h * spin + drive + radius * secant * v_long) / total
        return torch.sign(free) * torch.clamp(free.abs() - brake / total, min=0.0)

    force_scale = grip_force * ratio_scale
    before = curve(spin)
    after = curve(spin_with(force_scale * before))
    level = 0.5 * (before + after)
    secant = force_scale * level
    new_spin = spin_with(secant)
    slip_speed = new_spin * radius - v_long
    fx = secant * slip_speed
    damping = grip_force * level / (den * peak_tangent)
    fy = -damping * v_lat
    return WheelForces(new_spin, fx, fy, damping, (fx * slip_speed).abs() + (fy * v_lat).abs())


def heat_rate(slip_power: Tensor, load: Tensor, speed: Tensor, heat: Tensor) -> Tensor:
    """Rate of a tyre's temperature [K/s]; `speed` is that of its centre along the wheel, not negative."""
    gain = HEAT_SHARE * slip_power + HEAT_PER_LOAD * load * speed
    return (gain - (COOLING[0] + COOLING[1] * speed) * (heat - AMBIENT)) / HEAT_CAPACITY


def heat_factor(heat: Tensor) -> Tensor:
    """Grip at a temperature, relative to that at 90 °C."""
    return torch.clamp(1.0 - _off_best(heat), min=0.8)


def heat_loss(heat: Tensor) -> Tensor:
    """Share of its grip that a tyre loses by being hotter than 90 °C, without the bound of `heat_factor`."""
    return _off_best(torch.clamp(heat, min=BEST_HEAT))


def _off_best(heat: Tensor) -> Tensor:
    """Share of the grip that is lost at a temperature, hot or cold."""
    off = (heat - BEST_HEAT) / 60.0
    return 0.2 * off * off


def wear_factor(wear: Tensor) -> Tensor:
    """Grip of a worn tyre, relative to a new one; falls faster beyond 75 %."""
    return 1.0 - 0.10 * wear - 0.5 * torch.clamp(wear - 0.75, min=0.0)


def friction(load: Tensor, grip: Any, grip_per_load: Any, reference_load: Any) -> Tensor:
    """Friction coefficient at a load, before the factors of compound, heat, wear and surface."""
    return grip + grip_per_load * 1e-3 * (load - reference_load)
