"""The circuit in the racing scene: tarmac, lines, kerbs, run-off, walls and trees."""

import numpy as np

from coachable.envs.racing.circuit.track import Track
from coachable.scene import palette
from coachable.scene.frame import Backdrop
from coachable.scene.palette import Colour
from coachable.scene.parts import Parts, Surface, about_z, plain

GRASS, RUN_OFF, TARMAC = (126, 150, 104), (158, 156, 148), (88, 91, 97)
KERB: tuple[Colour, Colour] = (palette.VERMILION, palette.WHITE)
_WALL = (190, 194, 200)
_LINE = (0.10, 0.35)  # [m], from the edge inwards
_KERB_WIDTH, _KERB_CURVATURE = 1.3, 1.0 / 300.0  # [m], [1/m]: kerbs are where the track bends more
_WALL_HEIGHT = 0.9  # [m]
_AROUND = 400.0  # [m], grass beyond the circuit
_CELL = 60.0  # [m], of the grass
_LEVELS = {"grass": -0.15, "run_off": -0.03, "tarmac": 0.0, "lines": 0.02, "kerbs": 0.05}  # [m]
_TREES = 45.0  # [m], along the track
_TREE_GAP = (6.0, 30.0)  # [m], beyond the wall
_TRUNK, _CROWNS = (96, 78, 60), ((74, 112, 72), (88, 126, 80), (64, 100, 70))


def circuit(track: Track) -> Backdrop:
    """Return the scenery of a circuit, at its place in the world."""
    table = track.table.numpy()
    left, right, margin, curvature = table[:, 5], table[:, 6], table[:, 7], table[:, 4]
    low, high = table[:, :2].min(0) - _AROUND, table[:, :2].max(0) + _AROUND
    surfaces = [
        plain("grass", low, high, _LEVELS["grass"], _CELL, GRASS),
        _joined("run_off", RUN_OFF, _band(table, left, left + margin), _band(table, -right - margin, -right)),
        _joined("tarmac", TARMAC, _band(table, -right, left)),
        _joined(
            "lines",
            palette.WHITE,
            _band(table, left - _LINE[1], left - _LINE[0]),
            _band(table, -right + _LINE[0], -right + _LINE[1]),
        ),
        _joined("walls", _WALL, _fence(table, left + margin), _fence(table, -right - margin)),
    ]
    bends = np.abs(curvature) > _KERB_CURVATURE
    for index, colour in enumerate(KERB):
        kept = bends & (np.arange(len(table)) % 2 == index)
        if kept.any():
            sides = (_band(table, left, left + _KERB_WIDTH, kept), _band(table, -right - _KERB_WIDTH, -right, kept))
            surfaces.append(_joined("kerbs", colour, *sides, name=f"kerbs_{index}"))
    return Backdrop(surfaces, _start_line(table).figure(_trees(table, track.spacing), (0.0, 0.0, 0.0)))


def outline(track: Track) -> np.ndarray:
    """Return points (n, 2) along the centre line for a map [m], fewer than 240."""
    table = track.table.numpy()
    return table[:: max(1, len(table) // 120), :2]


def _side(table: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return the points (n, 2) at distances (n,) to the left of the centre line."""
    return table[:, :2] + offset[:, None] * np.stack([-table[:, 3], table[:, 2]], axis=1)


def _band(
    table: np.ndarray, low: np.ndarray, high: np.ndarray, kept: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (2 n, 2) and triangles of the band between two distances to the left of the centre line.

    Args:
        table: Table of the track.
        low: Distances (n,) of its right edge [m].
        high: Distances (n,) of its left edge [m].
        kept: Segments (n,) bool that are drawn, each from its point to the next one; all by default.
    """
    count = len(table)
    here = np.arange(count) if kept is None else np.flatnonzero(kept)
    there = (here + 1) % count
    corners = np.concatenate([_side(table, low), _side(table, high)])
    faces = [[here, there, there + count], [here, there + count, here + count]]
    return corners, np.concatenate([np.stack(face, axis=1) for face in faces])


def _joined(level: str, colour: Colour, *bands: tuple[np.ndarray, np.ndarray], name: str = "") -> Surface:
    """Join bands into a surface; corners without a height get that of the level."""
    vertices, faces, count = [], [], 0
    for corners, triangles in bands:
        raised = corners if corners.shape[1] == 3 else np.insert(corners, 2, _LEVELS[level], axis=1)
        vertices.append(raised)
        faces.append(triangles + count)
        count += len(raised)
    used, renamed = np.unique(np.concatenate(faces), return_inverse=True)
    return Surface(name or level, np.concatenate(vertices)[used], renamed.reshape(-1, 3), colour)


def _fence(table: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (2 n, 3) and triangles of a wall, which is seen from both sides."""
    foot = _side(table, offset)
    corners = np.concatenate([np.insert(foot, 2, z, axis=1) for z in (_LEVELS["grass"], _WALL_HEIGHT)])
    _, one = _band(table, offset, offset)  # the triangles between two rings of as many corners
    return corners, np.concatenate([one, one[:, ::-1]])


def _start_line(table: np.ndarray) -> Parts:
    """Return the chequered line where the table begins."""
    x, y, tx, ty, _, left, right, _ = table[0]
    parts, size = Parts(), 0.75  # [m]
    for row in range(2):
        for column in range(int((left + right) // size)):
            side = -right + (column + 0.5) * size
            place = (x + row * size * tx - side * ty, y + row * size * ty + side * tx, 0.02)
            colour = (palette.WHITE, palette.INK)[(row + column) % 2]
            parts.box(place, (size, size, 0.02), colour, about_z(float(np.arctan2(ty, tx))))
    return parts


def _trees(table: np.ndarray, spacing: float) -> Parts:
    """Return trees beyond the walls, always the same ones, and none where another part of the circuit is near."""
    random, parts = np.random.default_rng(0), Parts()
    reach = float((np.maximum(table[:, 5], table[:, 6]) + table[:, 7]).max())
    for node in range(0, len(table), max(1, round(_TREES / spacing))):
        for side in (-1.0, 1.0):
            gap, height, crown = random.uniform(*_TREE_GAP), random.uniform(5.0, 9.0), int(random.integers(3))
            edge = (table[node, 5] if side > 0 else table[node, 6]) + table[node, 7]
            x, y = table[node, :2] + side * (edge + gap) * np.array([-table[node, 3], table[node, 2]])
            if np.hypot(table[:, 0] - x, table[:, 1] - y).min() > reach + 3.0:
                parts.cylinder((x, y, height / 4), (0.5, 0.5, height / 2), _TRUNK)
                parts.ball((x, y, 0.7 * height), (0.55 * height, 0.55 * height, 0.75 * height), _CROWNS[crown])
    return parts
