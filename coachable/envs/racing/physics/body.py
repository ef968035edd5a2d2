"""Planar rigid body with forces of steered and unsteered wheels, implicit velocities and impulses."""

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
    """Return the velocity of a point of the body in the car's frame.

    Args:
        vx: Velocity forward (N,) [m/s].
        vy: Velocity to the left (N,) [m/s].
        yaw_rate: (N,) [rad/s].
        x: Place of the point, forward of the centre of gravity [m].
        y: Place of the point, to the left [m].

    Returns:
        Velocity forward and to the left [m/s].
    """
    return vx - yaw_rate * y, vy + yaw_rate * x


def rotate(x: Tensor, y: Tensor, cos: Any, sin: Any) -> tuple[Tensor, Tensor]:
    """Rotate vectors of any shape counter-clockwise by the angle whose cosine and sine are given.

    Returns:
        Both components of the rotated vector, in the same unit.
    """
    return x * cos - y * sin, x * sin + y * cos


def wheel_force(fx: Tensor, fy: Tensor, cos: Any, sin: Any, x: Any, y: Any) -> PlanarForce:
    """Return the force on the body by a wheel at (x, y) that is steered by the angle of `cos` and `sin`.

    Args:
        fx: Force along the wheel, (N,) [N].
        fy: Force across the wheel, to the left, (N,) [N].
        cos: Cosine of the steering angle.
        sin: Sine of the steering angle.
        x: Position of the wheel, forward of the centre of gravity [m].
        y: Position of the wheel, to the left [m].
    """
    bx, by = rotate(fx, fy, cos, sin)
    return PlanarForce(bx, by, x * by - y * bx)


class Damping(NamedTuple):
    """Symmetric damping matrix Σ c d dᵀ of the lateral tyre forces for (vx, vy, yaw rate)."""

    xx: Tensor
    xy: Tensor
    xr: Tensor
    yy: Tensor
    yr: Tensor
    rr: Tensor


def wheel_damping(c: Tensor, cos: Any, sin: Any, x: Any, y: Any) -> Damping:
    """Return the damping c d dᵀ of one wheel, where d is the row that gives its lateral speed.

    Args:
        c: Lateral damping (N,) [N s/m].
        cos: Cosine of the steering angle.
        sin: Sine of the steering angle.
        x: Position of the wheel, forward of the centre of gravity [m].
        y: Position of the wheel, to the left [m].
    """
    dr = x * cos + y * sin
    return Damping(c * sin * sin, -c * sin * cos, -c * sin * dr, c * cos * cos, c * cos * dr, c * dr * dr)


_Sum = TypeVar("_Sum", PlanarForce, Damping)


def sum_wheels(parts: _Sum) -> _Sum:
    """Sum every field over the wheels, its first axis, in a fixed order."""
    return type(parts)(*(reduce(operator.add, field.unbind(0)) for field in parts))


def implicit_change(
    force: PlanarForce, damping: Damping, mass: Any, inertia: Any, h: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve (M + h D) Δv = h F for the change of (vx, vy, yaw rate) in a substep.

    Lateral tyre forces are stiff at walking pace, where an explicit step would oscillate. D is positive semi-definite,
    so that the system always has a solution and dissipates energy. It is solved by elimination without pivots.

    Args:
        force: F.
        damping: D.
        mass: Mass of the car [kg].
        inertia: Moment of inertia about the vertical axis [kg m²].
        h: Substep [s].

    Returns:
        Changes of vx [m/s], vy [m/s] and the yaw rate [rad/s], (N,) each.
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
    """Change of (vx, vy, yaw rate) by a contact at a point of the body, in the car's frame, (N,) each."""

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
    """Return the impulse of an immovable wall; all vectors are in the car's frame.

    Args:
        velocity: vx [m/s], vy [m/s] and yaw rate [rad/s], (N,) each.
        point: Point of the body that touches the wall, (N,) each [m].
        normal: Unit vector from the road into the wall, (N,) each.
        touching: Whether each car touches the wall, (N,) bool.
        mass: Mass of the car [kg].
        inertia: Moment of inertia about the vertical axis [kg m²].
        restitution: Ratio of the speeds normal to the wall after and before the contact.
        friction: Largest ratio of the tangential to the normal impulse.
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
