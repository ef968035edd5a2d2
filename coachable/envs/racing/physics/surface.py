"""The road near a car, with signed distances to an arc of the centre line, surfaces beside the track and walls."""

from typing import NamedTuple

import torch
from torch import Tensor

KERB_WIDTH = 1.5  # [m] beyond the edge of the track
RUN_OFF_WIDTH = 5.0  # [m] from the edge of the track to the grass
GRIP = {"track": 1.0, "kerb": 0.95, "run_off": 0.75, "grass": 0.45}
RUN_OFF_ROLLING, GRASS_ROLLING = 0.04, 0.10  # rolling resistance, of the load (the run-off's is our choice)
WALL_RESTITUTION, WALL_FRICTION = 0.2, 0.3


class Arc(NamedTuple):
    """Position of points relative to arcs of the centre line, (N,) each."""

    ahead: Tensor  # distance along the arc [m]
    offset: Tensor  # distance from the arc, positive to the left [m]
    nx: Tensor  # unit normal to the left, at the foot of the perpendicular
    ny: Tensor


def locate(x: Tensor, y: Tensor, node_x: Tensor, node_y: Tensor, tx: Tensor, ty: Tensor, curvature: Tensor) -> Arc:
    """Project points on arcs, exactly and without cancellation where an arc is nearly straight.

    Args:
        x: Positions of the points (N,) [m].
        y: Positions of the points (N,) [m].
        node_x: Positions of one point of each arc (N,) [m].
        node_y: Positions of one point of each arc (N,) [m].
        tx: Unit tangents at these points (N,).
        ty: Unit tangents at these points (N,).
        curvature: Curvatures, positive to the left (N,) [1/m].
    """
    dx, dy = x - node_x, y - node_y
    u = dx * tx + dy * ty
    v = dy * tx - dx * ty
    q = curvature * (u * u + v * v) - 2.0 * v
    radial = torch.sqrt(torch.clamp(1.0 + curvature * q, min=1e-6))  # 1 - curvature * offset
    offset = -q / (1.0 + radial)
    a, b = -curvature * u / radial, (1.0 - curvature * v) / radial  # normal in the node's frame
    z = u / (1.0 - curvature * v).clamp(min=1e-3)
    angle = curvature * z
    # atan(angle) / curvature, by its series where the angle is small
    small = angle.abs() < 0.03
    safe = torch.where(small, torch.ones_like(angle), angle)
    ahead = z * torch.where(small, 1.0 - angle * angle / 3.0, torch.atan(safe) / safe)
    return Arc(ahead, offset, a * tx - b * ty, a * ty + b * tx)


def beyond(offset: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """Return the distance of points beyond the edge of the track, negative on it [m].

    Args:
        offset: Distance to the left of the centre line (N,) [m].
        left: Distance of the left edge (N,) [m].
        right: Distance of the right edge (N,) [m].

    Returns:
        (N,) [m].
    """
    return torch.maximum(offset - left, -offset - right)


def surface_grip(outside: Tensor) -> Tensor:
    """Return the grip factor (...,) of the surface at distances beyond the edge of the track (...,) [m]."""
    grip = torch.where(outside > 0.0, GRIP["kerb"], GRIP["track"])
    grip = torch.where(outside > KERB_WIDTH, GRIP["run_off"], grip)
    return torch.where(outside > RUN_OFF_WIDTH, GRIP["grass"], grip)


def surface_rolling(outside: Tensor) -> Tensor:
    """Return the rolling resistance (...,) that the surface adds to that of tarmac.

    Args:
        outside: Distances beyond the edge of the track (...,) [m], negative on the track.

    Returns:
        Coefficient of the same shape, relative to the weight.
    """
    drag = torch.where(outside > KERB_WIDTH, RUN_OFF_ROLLING, 0.0)
    return torch.where(outside > RUN_OFF_WIDTH, GRASS_ROLLING, drag)
