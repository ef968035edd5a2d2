"""Tyre model with combined slip, implicit wheel spin, heat and wear."""

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
    """Return the tangent of a number or a tensor [rad]."""
    return torch.tan(angle) if isinstance(angle, Tensor) else math.tan(angle)


def slip_curve(rho: Tensor, shape: Any) -> Tensor:
    """Return the ratio of normalised force to normalised slip, sin(C atan(B ρ)) / ρ, where B puts the peak at ρ = 1.

    Args:
        rho: Normalised slip, any shape, not 0.
        shape: Shape factor C of the magic formula, above 1.

    Returns:
        Ratio of the shape of `rho`.
    """
    stiffness = tangent(math.pi / 2 / shape)
    return torch.sin(shape * torch.atan(stiffness * rho)) / rho


class WheelForces(NamedTuple):
    """Forces and spin of a wheel of N cars in the wheel's frame, (N,) each, or of four wheels, (4, N) each."""

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

    The spin settles within a fraction of a substep, so that the force is linearised as a secant, k (ωR - v). The brake
    torque is Coulomb friction: it stops the wheel exactly and never turns it backwards.

    Args:
        v_long: Speed of the wheel's centre along the wheel (N,) [m/s].
        v_lat: Speed across the wheel, to the left (N,) [m/s].
        spin: Angular speed (N,) [rad/s].
        grip_force: Largest force μ Fz (N,) [N].
        drive: Torque of the engine and the differential (N,) [N m].
        brake: Torque of everything that resists the rotation, not negative (N,) [N m].
        inertia: Moment of inertia of the wheel and of the parts that turn with it [kg m²].
        h: Substep [s].
        radius: Radius of the wheel [m].
        peak_ratio: Slip ratio of the largest force.
        peak_tangent: Tangent of the slip angle of the largest force.
        shape: Constant C of the slip curve.
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
    """Return the rate at which a tyre's temperature changes [K/s].

    Args:
        slip_power: Power of the slip [W].
        load: Vertical load [N].
        speed: Speed of the wheel's centre along the wheel, not negative [m/s].
        heat: Temperature [°C].
    """
    gain = HEAT_SHARE * slip_power + HEAT_PER_LOAD * load * speed
    return (gain - (COOLING[0] + COOLING[1] * speed) * (heat - AMBIENT)) / HEAT_CAPACITY


def heat_factor(heat: Tensor) -> Tensor:
    """Return the grip (...,) at temperatures (...,) [°C] relative to that at 90 °C."""
    return torch.clamp(1.0 - _off_best(heat), min=0.8)


def heat_loss(heat: Tensor) -> Tensor:
    """Return the share of the grip that is lost at temperatures above 90 °C, without the bound of `heat_factor`.

    Args:
        heat: Temperatures (...,) [°C].

    Returns:
        Share (...,), 0 up to 90 °C.
    """
    return _off_best(torch.clamp(heat, min=BEST_HEAT))


def _off_best(heat: Tensor) -> Tensor:
    """Return the share of the grip that is lost at temperatures below or above 90 °C."""
    off = (heat - BEST_HEAT) / 60.0
    return 0.2 * off * off


def wear_factor(wear: Tensor) -> Tensor:
    """Return the grip (...,) of worn tyres relative to new ones.

    It falls faster beyond a wear of 0.75.

    Args:
        wear: Wear (...,), 0 for a new tyre.
    """
    return 1.0 - 0.10 * wear - 0.5 * torch.clamp(wear - 0.75, min=0.0)


def friction(load: Tensor, grip: Any, grip_per_load: Any, reference_load: Any) -> Tensor:
    """Return the friction coefficient at loads [N], before the factors of compound, heat, wear and surface.

    Args:
        load: Loads on the wheels [N].
        grip: Coefficient at the reference load.
        grip_per_load: Its change per load [1/kN].
        reference_load: Reference load [N].

    Returns:
        Coefficient of the shape of `load`.
    """
    return grip + grip_per_load * 1e-3 * (load - reference_load)
