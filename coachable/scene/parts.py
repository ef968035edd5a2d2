"""Primitives of which scenes consist: boxes, balls and cylinders with places, sizes and colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coachable.scene.palette import Colour

Numbers = Sequence[float] | np.ndarray
"""Coordinates, sizes or a quaternion."""

BOX, BALL, CYLINDER, SECTOR = "box", "ball", "cylinder", "sector"
SHAPES = (BOX, BALL, CYLINDER, SECTOR)
"""Shapes; a box, ellipsoid or upright cylinder of size (1, 1, 1) fits into the unit cube around the origin.

A sector is the part of the cylinder's upper side that lies within `SECTOR_ANGLE` of the x axis, seen from above.
"""
SECTOR_ANGLE = math.radians(60.0)

_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Batch:
    """Primitives of one shape.

    Attributes:
        positions: Centres (N, 3) [m].
        wxyzs: Rotations as unit quaternions (N, 4).
        sizes: Sizes along the primitives' own axes (N, 3) [m].
        colours: Colours (N, 3) uint8.
    """

    positions: np.ndarray
    wxyzs: np.ndarray
    sizes: np.ndarray
    colours: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)


class Parts:
    """Growing collection of primitives.

    `box`, `ball`, `cylinder` and `sector` add one primitive. They take the position of its centre (3,) [m], its sizes
    along its own axes (3,) [m], its colour (red, green and blue, 0 to 255) and its rotation as a unit quaternion (4,).

    Example:
        >>> wheel = Parts().cylinder((0.0, 0.0, 0.3), (0.6, 0.6, 0.2), (34, 37, 43))
        >>> len(Parts().figure(wheel, (2.0, 0.0, 0.0)).figure(wheel, (4.0, 0.0, 0.0)))
        2
    """

    def __init__(self) -> None:
        self._rows: dict[str, list[Batch]] = {shape: [] for shape in SHAPES}

    def __len__(self) -> int:
        return sum(len(batch) for batches in self._rows.values() for batch in batches)

    def box(self, position: Numbers, size: Numbers, colour: Colour, wxyz: Numbers = _UPRIGHT) -> Parts:
        """Add a box and return this collection."""
        return self._add(BOX, position, size, colour, wxyz)

    def ball(self, position: Numbers, size: Numbers, colour: Colour, wxyz: Numbers = _UPRIGHT) -> Parts:
        """Add an ellipsoid, whose sizes are its diameters, and return this collection."""
        return self._add(BALL, position, size, colour, wxyz)

    def cylinder(self, position: Numbers, size: Numbers, colour: Colour, wxyz: Numbers = _UPRIGHT) -> Parts:
        """Add a cylinder along its z axis and return this collection."""
        return self._add(CYLINDER, position, size, colour, wxyz)

    def sector(self, position: Numbers, size: Numbers, colour: Colour, wxyz: Numbers = _UPRIGHT) -> Parts:
        """Add a flat sector of a disc, which opens along its x axis, and return this collection.

        Its position is its tip, which is the middle of the disc, and its sizes are the diameters of the disc and its
        height. Films show it only among the translucent primitives.
        """
        return self._add(SECTOR, position, size, colour, wxyz)

    def capsule(self, start: Numbers, end: Numbers, radius: float, colour: Colour) -> Parts:
        """Add a `rod` with a ball at each end, and return this collection."""
        self.rod(start, end, radius, colour)
        for point in (start, end):
            self.ball(point, (2 * radius,) * 3, colour)
        return self

    def rod(self, start: Numbers, end: Numbers, radius: float, colour: Colour) -> Parts:
        """Add a cylinder between two points and return this collection.

        Args:
            start: First point (3,) [m].
            end: Second point (3,) [m].
            radius: Radius [m].
            colour: Red, green and blue, 0 to 255.
        """
        first, last = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
        length = float(np.linalg.norm(last - first))
        return self.cylinder((first + last) / 2, (2 * radius, 2 * radius, length), colour, towards(last - first))

    def batch(self, shape: str, batch: Batch) -> Parts:
        """Add primitives of one shape and return this collection."""
        self._rows[shape].append(batch)
        return self

    def figure(self, figure: Parts, position: Numbers, wxyz: Numbers = _UPRIGHT) -> Parts:
        """Add a rigid figure and return this collection.

        Args:
            figure: Primitives in the figure's own frame.
            position: Place of the frame's origin [m].
            wxyz: Rotation of the frame.
        """
        turn = np.asarray(wxyz, dtype=float)
        for shape in SHAPES:
            own = figure.of(shape)
            if len(own):
                places = rotated(turn, own.positions) + np.asarray(position, dtype=float)
                self.batch(shape, Batch(places, multiplied(turn, own.wxyzs), own.sizes, own.colours))
        return self

    def of(self, shape: str) -> Batch:
        """Return all primitives of one shape, in the order in which they were added."""
        batches = self._rows[shape]
        if len(batches) != 1:
            joined = Batch(
                np.concatenate([np.zeros((0, 3)), *(b.positions for b in batches)]),
                np.concatenate([np.zeros((0, 4)), *(b.wxyzs for b in batches)]),
                np.concatenate([np.zeros((0, 3)), *(b.sizes for b in batches)]),
                np.concatenate([np.zeros((0, 3), np.uint8), *(b.colours for b in batches)]),
            )
            self._rows[shape] = [joined]
        return self._rows[shape][0]

    def _add(self, shape: str, position: Numbers, size: Numbers, colour: Colour, wxyz: Numbers) -> Parts:
        place, turn = np.array([position], dtype=float), np.array([wxyz], dtype=float)
        return self.batch(shape, Batch(place, turn, np.array([size], dtype=float), np.array([colour], np.uint8)))


@dataclass(frozen=True)
class Surface:
    """Coloured triangles that do not move.

    Attributes:
        name: Name, which is unique in a scene.
        vertices: Corners (V, 3) [m].
        faces: Indices of the corners of each triangle (F, 3), counter-clockwise seen from outside.
        colour: Colour.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    colour: Colour


def plain(name: str, low: Numbers, high: Numbers, height: float, cell: float, colour: Colour) -> Surface:
    """Return a level rectangle of small triangles, because haze is worked out at their corners.

    Args:
        name: Name of the surface.
        low: Corner with the smallest x and y (2,) [m].
        high: Opposite corner (2,) [m].
        height: Its height [m].
        cell: Largest length of the triangles along x and y [m].
        colour: Its colour.
    """
    sides = [np.linspace(a, b, 1 + max(1, math.ceil((b - a) / cell))) for a, b in zip(low, high, strict=True)]
    x, y = np.meshgrid(*sides, indexing="ij")
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return Surface(name, np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], 1), faces, colour)


def above(place: Numbers, height: float) -> np.ndarray:
    """Return the place (3,) at a height above another one [m].

    Args:
        place: Place (3,) [m].
        height: Height above it [m].
    """
    return np.asarray(place, dtype=float) + np.array([0.0, 0.0, height])


def about_z(angle: float) -> tuple[float, float, float, float]:
    """Return the rotation about the vertical axis [rad] as a quaternion."""
    return float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2))


def about_x(angle: float) -> tuple[float, float, float, float]:
    """Return the rotation about the x axis [rad] as a quaternion."""
    return float(np.cos(angle / 2)), float(np.sin(angle / 2)), 0.0, 0.0


def about_y(angle: float) -> tuple[float, float, float, float]:
    """Return the rotation about the y axis [rad] as a quaternion."""
    return float(np.cos(angle / 2)), 0.0, float(np.sin(angle / 2)), 0.0


def towards(direction: np.ndarray) -> np.ndarray:
    """Return the rotation (4,) that turns the z axis into a direction (3,)."""
    x, y, z = direction / max(float(np.linalg.norm(direction)), 1e-9)
    if z < -0.999999:
        return np.array([0.0, 1.0, 0.0, 0.0])
    turn = np.array([1.0 + z, -y, x, 0.0])
    return turn / np.linalg.norm(turn)


def rotated(wxyz: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (..., 3) rotated by unit quaternions (..., 4)."""
    twice = 2.0 * np.cross(wxyz[..., 1:], points)
    return points + wxyz[..., :1] * twice + np.cross(wxyz[..., 1:], twice)


def multiplied(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the rotations that apply `other` first and then `one`, unit quaternions (..., 4) each."""
    scalar = one[..., :1] * other[..., :1] - (one[..., 1:] * other[..., 1:]).sum(-1, keepdims=True)
    vector = one[..., :1] * other[..., 1:] + other[..., :1] * one[..., 1:] + np.cross(one[..., 1:], other[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def unit_mesh(shape: str) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (V, 3) and triangles (F, 3) of a primitive of size (1, 1, 1).

    Edges of boxes and cylinders have corners of their own on either side, so that they look sharp.
    """
    if shape == BOX:
        return _unit_box()
    if shape == SECTOR:
        return _unit_sector()
    return _unit_ball() if shape == BALL else _unit_cylinder()


def _unit_box() -> tuple[np.ndarray, np.ndarray]:
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    vertices, faces = [], []
    for axis in range(3):
        for side in (-0.5, 0.5):
            corners = np.insert(square, axis, side, axis=1)
            outward = (side > 0) != (axis == 1)  # the other two axes are in order, and the middle one reverses them
            order = [[0, 1, 2], [0, 2, 3]] if outward else [[0, 2, 1], [0, 3, 2]]
            faces.append(np.array(order) + 4 * len(vertices))
            vertices.append(corners)
    return np.concatenate(vertices), np.concatenate(faces)


def _around(rows: int, columns: int) -> np.ndarray:
    """Return the triangles between rings of points, each of `columns` points from bottom to top."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1], np.roll(index[:-1], -1, axis=1)
    d, c = index[1:], np.roll(index[1:], -1, axis=1)
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])


def _fan(middle: int, rim: np.ndarray, upwards: bool) -> np.ndarray:
    """Return the triangles between a point and a ring."""
    triangles = np.stack([np.full(len(rim), middle), rim, np.roll(rim, -1)], -1)
    return triangles if upwards else triangles[:, ::-1]


def _unit_ball(around: int = 20, rings: int = 9) -> tuple[np.ndarray, np.ndarray]:
    height = np.linspace(-np.pi / 2, np.pi / 2, rings + 2)[1:-1, None]
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)[None]
    wide = np.cos(height)
    points = np.stack([wide * np.cos(angle), wide * np.sin(angle), np.sin(height) + 0 * angle], -1).reshape(-1, 3) / 2
    poles = np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]])
    count, rim = len(points), np.arange(around)
    caps = [_fan(count, rim, False), _fan(count + 1, count - around + rim, True)]
    return np.concatenate([points, poles]), np.concatenate([_around(rings, around), *caps])


def _unit_sector(around: int = 12) -> tuple[np.ndarray, np.ndarray]:
    angle = np.linspace(-SECTOR_ANGLE, SECTOR_ANGLE, around + 1)
    rim = np.stack([np.cos(angle) / 2, np.sin(angle) / 2, np.full(around + 1, 0.5)], -1)
    index = np.arange(1, around + 1)
    return np.concatenate([[[0.0, 0.0, 0.5]], rim]), np.stack([np.zeros(around, int), index, index + 1], -1)


def _unit_cylinder(around: int = 20) -> tuple[np.ndarray, np.ndarray]:
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1) / 2
    low, high = (np.insert(ring, 2, z, axis=1) for z in (-0.5, 0.5))
    middles = np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]])
    rim = 2 * around + np.arange(around)  # of the lower cap, whose corners are not those of the side
    caps = [_fan(4 * around, rim, False), _fan(4 * around + 1, rim + around, True)]
    return np.concatenate([low, high, low, high, middles]), np.concatenate([_around(2, around), *caps])
