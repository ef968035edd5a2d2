"""Contact between cars as rotated rectangles, with separating axes, impulses and position correction.

Cars of B races are laid out as (A, B). Rolling the first axis by k pairs car i with car i + k, so that k = 1 to A // 2
visits every pair. For even A the last k visits its pairs twice, so that they count half.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from coachable.envs.racing.physics.body import rotate, wheel_velocity

RESTITUTION, FRICTION = 0.15, 0.3
_CORRECTION = 0.8  # share of the overlap that is removed at once
_EDGE_BLEND = 0.05  # nearly parallel sides touch with their middles, not with a corner


class Bodies(NamedTuple):
    """Rectangles (A, B) with poses, velocities in the world's frame, sizes and masses."""

    x: Tensor
    y: Tensor
    cos: Tensor
    sin: Tensor
    vx: Tensor
    vy: Tensor
    yaw_rate: Tensor
    mass: Any
    inertia: Any
    half_length: Any
    half_width: Any


class Push(NamedTuple):
    """Changes by contacts, (A, B) each, in the world's frame."""

    x: Tensor
    y: Tensor
    vx: Tensor
    vy: Tensor
    yaw_rate: Tensor


class Overlap(NamedTuple):
    """Overlap of the two rectangles of a pair, (A, B) each."""

    depth: Tensor  # [m], not positive if apart
    nx: Tensor  # unit normal, from the second to the first
    ny: Tensor
    x: Tensor  # point of contact relative to the first's centre
    y: Tensor


def partner(bodies: Bodies, k: int) -> Bodies:
    """Return the k-th next car of each car, in the same race.

    Args:
        bodies: Cars (A, B), A cars in each of B races.
        k: How many cars further.

    Returns:
        Cars (A, B).
    """
    return Bodies(*(f.roll(-k, 0) if isinstance(f, Tensor) and f.ndim else f for f in bodies))


def extent(nx: Tensor, ny: Tensor, body: Bodies) -> Tensor:
    """Return half the length of a rectangle's projection on a unit vector [m].

    Args:
        nx: Unit vector (A, B).
        ny: Unit vector (A, B).
        body: Rectangles (A, B).

    Returns:
        (A, B) [m].
    """
    along, across = rotate(nx, ny, body.cos, -body.sin)
    return along.abs() * body.half_length + across.abs() * body.half_width


def _support(nx: Tensor, ny: Tensor, body: Bodies) -> tuple[Tensor, Tensor]:
    """Return the vertex furthest along a unit vector, relative to the centre, or the middle of a side normal to it."""
    along, across = rotate(nx, ny, body.cos, -body.sin)
    along = body.half_length * torch.clamp(along / _EDGE_BLEND, -1.0, 1.0)
    across = body.half_width * torch.clamp(across / _EDGE_BLEND, -1.0, 1.0)
    return rotate(along, across, body.cos, body.sin)


def overlap(a: Bodies, b: Bodies) -> Overlap:
    """Return the overlap of two rectangles, by the separating axis of least depth, at the deepest vertex.

    Args:
        a: First rectangles (A, B).
        b: Second rectangles (A, B).
    """
    dx, dy = a.x - b.x, a.y - b.y
    depth, nx, ny, ours = None, a.cos, a.sin, None
    for owner, (ex, ey) in ((0, (a.cos, a.sin)), (0, (-a.sin, a.cos)), (1, (b.cos, b.sin)), (1, (-b.sin, b.cos))):
        centre = dx * ex + dy * ey
        overlapping = extent(ex, ey, a) + extent(ex, ey, b) - centre.abs()
        sign = torch.where(centre < 0.0, -1.0, 1.0)
        if depth is None or ours is None:
            depth, nx, ny, ours = overlapping, sign * ex, sign * ey, torch.ones_like(centre)
        else:
            less = overlapping < depth
            depth = torch.where(less, overlapping, depth)
            nx, ny = torch.where(less, sign * ex, nx), torch.where(less, sign * ey, ny)
            ours = torch.where(less, 1.0 - owner, ours)
    # The vertex belongs to the rectangle that does not own the axis; it slides to where both are.
    own_x, own_y = _support(-nx, -ny, a)
    other_x, other_y = _support(nx, ny, b)
    other_x, other_y = other_x - dx, other_y - dy
    px = torch.where(ours > 0.5, other_x, own_x)
    py = torch.where(ours > 0.5, other_y, own_y)
    tx, ty = -ny, nx
    reach_a, reach_b = extent(tx, ty, a), extent(tx, ty, b)
    centre_b = -(dx * tx + dy * ty)
    along = px * tx + py * ty
    inside = torch.minimum(torch.maximum(along, -reach_a), reach_a)
    inside = torch.minimum(torch.maximum(inside, centre_b - reach_b), centre_b + reach_b)
    return Overlap(depth, nx, ny, px + (inside - along) * tx, py + (inside - along) * ty)


def collide(bodies: Bodies, group: Tensor, impact: Tensor) -> tuple[Push, Tensor]:
    """Resolve the contacts of all pairs at once.

    Args:
        bodies: Cars (A, B).
        group: Groups (A, B); only cars of one group touch.
        impact: Largest squared relative speed of each pair's contacts so far, (A // 2, A, B) [m²/s²].

    Returns:
        The changes, and the updated `impact`.
    """
    cars = bodies.x.shape[0]
    total: Push | None = None
    impacts = []
    for k in range(1, cars // 2 + 1):
        other = partner(bodies, k)
        share = 0.5 if 2 * k == cars else 1.0
        here, there, squared = _pair(bodies, other, group == group.roll(-k, 0), share)
        impacts.append(torch.maximum(impact[k - 1], squared))
        back = Push(*(field.roll(k, 0) for field in there))
        both = Push(*(p + q for p, q in zip(here, back, strict=True)))
        total = both if total is None else Push(*(p + q for p, q in zip(total, both, strict=True)))
    assert total is not None
    return total, torch.stack(impacts)


def _pair(a: Bodies, b: Bodies, same: Tensor, share: float) -> tuple[Push, Push, Tensor]:
    """Return the changes of both cars of each pair, and the squared relative speed of those that touch."""
    o = overlap(a, b)
    touching = same & (o.depth > 0.0)
    depth = torch.where(touching, o.depth, 0.0) * (share * _CORRECTION)
    qx, qy = o.x + a.x - b.x, o.y + a.y - b.y  # point of contact relative to the second's centre
    ax, ay = wheel_velocity(a.vx, a.vy, a.yaw_rate, o.x, o.y)
    bx, by = wheel_velocity(b.vx, b.vy, b.yaw_rate, qx, qy)
    ux, uy = ax - bx, ay - by
    mass = 1.0 / a.mass + 1.0 / b.mass

    def effective(ex: Tensor, ey: Tensor) -> Tensor:
        arm_a, arm_b = o.x * ey - o.y * ex, qx * ey - qy * ex
        return mass + arm_a * arm_a / a.inertia + arm_b * arm_b / b.inertia

    closing = torch.clamp(-(ux * o.nx + uy * o.ny), min=0.0)
    normal = torch.where(touching, share * (1.0 + RESTITUTION) * closing / effective(o.nx, o.ny), 0.0)
    tx, ty = -o.ny, o.nx
    sliding = -share * (ux * tx + uy * ty) / effective(tx, ty)
    limit = FRICTION * normal
    sliding = torch.minimum(torch.maximum(sliding, -limit), limit)
    fx, fy = normal * o.nx + sliding * tx, normal * o.ny + sliding * ty
    first, second = (1.0 / a.mass) / mass, (1.0 / b.mass) / mass
    here = Push(
        depth * first * o.nx,
        depth * first * o.ny,
        fx / a.mass,
        fy / a.mass,
        (o.x * fy - o.y * fx) / a.inertia,
    )
    there = Push(
        -depth * second * o.nx,
        -depth * second * o.ny,
        -fx / b.mass,
        -fy / b.mass,
        -(qx * fy - qy * fx) / b.inertia,
    )
    return here, there, torch.where(touching, ux * ux + uy * uy, 0.0)


def body_gaps(a: Bodies, b: Bodies) -> tuple[Tensor, Tensor]:
    """Return the distances between two rectangles along and across the first one.

    Args:
        a: First rectangles (A, B).
        b: Second rectangles (A, B).

    Returns:
        Distance along and across (A, B) [m]; 0 where the projections overlap.
    """
    dx, dy = b.x - a.x, b.y - a.y
    ahead, aside = rotate(dx, dy, a.cos, -a.sin)
    long = ahead.abs() - a.half_length - extent(a.cos, a.sin, b)
    lat = aside.abs() - a.half_width - extent(-a.sin, a.cos, b)
    return torch.clamp(long, min=0.0), torch.clamp(lat, min=0.0)
