"""Planar rigid body: forces of steered and unsteered wheels, implicit velocities, impulses."""

from __future__ import annotations

import operator
from functools import reduce
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor


class PlanarForce(NamedTuple):
    """Force and yaw moment in the car's frame, (N,) each."""

    x: Tensor  # [N]
    y: Tensor  # [N]
    yaw: Tensor  # [N m]


def wheel_velocity(vx: Tensor, vy: Tensor, yaw_rate: Tensor, x: Any, y: Any) -> tuple[Tensor, Tensor]:
    """Velocity of the point (x, y) of the body, in the car's frame [m/s]."""
    return vx - yaw_rate * y, vy + yaw_rate * x


def rotate(x: Tensor, y: Tensor, cos: Any, sin: Any) -> tuple[Tensor, Tensor]:
    """A vector turned counter-clockwise by the angle of `cos` and `sin`."""
    return x * cos - y * sin, x * sin + y * cos


def wheel_force(fx: Tensor, fy: Tensor, cos: Any, sin: Any, x: Any, y: Any) -> PlanarForce:
    """What a wheel at (x, y), steered by the angle of `cos` and `sin`, does to the body."""
    bx, by = rotate(fx, fy, cos, sin)
    return PlanarForce(bx, by, x * by - y * bx)


class Damping(NamedTuple):
    """Symmetric matrix Σ c d dᵀ of how lateral tyre forces resist (vx, vy, yaw rate)."""

    xx: Tensor
    xy: Tensor
    xr: Tensor
    yy: Tensor
    yr: Tensor
    rr: Tensor


def wheel_damping(c: Tensor, cos: Any, sin: Any, x: Any, y: Any) -> Damping:
    """Of one wheel with lateral damping c [N s/m]; d is the row that gives its lateral speed."""
    dr = x * cos + y * sin
    return Damping(c * sin * sin, -c * sin * cos, -c * sin * dr, c * cos * cos, c * cos * dr, c * dr * dr)


_Sum = TypeVar("_Sum", PlanarForce, Damping)


def sum_wheels(parts: _Sum) -> _Sum:
    """Add up the wheels, the first axis of every field, first to last."""
    return type(parts)(*(reduce(operator.add, field.unbind(0)) for field in parts))


def implicit_change(
    force: PlanarForce, damping: Damping, mass: Any, inertia: Any, h: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Change of (vx, vy, yaw rate) in a substep: (M + h D) Δv = h F.

    Lateral tyre forces are stiff at walking pace, where an explicit step would chatter. D is positive semi-definite, so
    the system always has a solution and dissipates. It is solved by elimination without pivots.
    """
    a, b, c = mass + h * damping.xx, h * damping.xy, h * damping.xr
    d, e = mass + h * damping.yy, h * damping.yr
    f = inertia + h * damping.rr
    px, py, pr = h * force.x, h * force.y, h * force.yaw
    l1, l2 = b / a, c / a
    d1, e1, py1 = d - l1 * b, e - l1 * c, py - l1 * px
    l3 = e1 / d1
    f1 = f - l2 * c - l3 * e1
    pr1 = pr - l2 * px - l3 * py1
    dr = pr1 / f1
    dy = (py1 - e1 * dr) / d1
    dx = (px - b * dy - c * dr) / a
    return dx, dy, dr


class Impulse(NamedTuple):
    """Change of (vx, vy, yaw rate) by a contact at a point of the body, in the car's frame."""

    vx: Tensor
    vy: Tensor
    yaw_rate: Tensor


def wall_impulse(
    velocity: tuple[Tensor, Tensor, Tensor],
    point: tuple[Tensor, Tensor],
    normal: tuple[Tensor, Tensor],
    touching: Tensor,
    mass: Any,
    inertia: Any,
    restitution: float,
    friction: float,
) -> Impulse:
    """Impulse of an immovable wall; everything in the car's frame.

    Args:
        velocity: vx, vy and yaw rate.
        point: of the body that touches.
        normal: out of the road, into the wall.
        touching: (N,) bool.
        mass: of the car [kg].
        inertia: of the car about the vertical axis [kg m²].
        restitution: share of the approach speed that returns.
        friction: largest tangential over normal impulse.
    """
    (px, py), (nx, ny) = point, normal
    ux, uy = wheel_velocity(*velocity, px, py)
    arm_n = px * ny - py * nx
    arm_t = px * nx + py * ny
    approach = torch.where(touching, torch.clamp(ux * nx + uy * ny, min=0.0), 0.0)
    push = (1.0 + restitution) * approach / (1.0 / mass + arm_n * arm_n / inertia)
    limit = friction * push
    sliding = (uy * nx - ux * ny) / (1.0 / mass + arm_t * arm_t / inertia)
    sliding = torch.minimum(torch.maximum(sliding, -limit), limit)
    # Both parts oppose the motion: against n, and against the sliding along (-ny, nx).
    fx = -push * nx + sliding * ny
    fy = -push * ny - sliding * nx
    return Impulse(fx / mass, fy / mass, (px * fy - py * fx) / inertia)
