"""Tracks, which are closed centre lines with curvature and widths, sampled at equal distances."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from coachable.envs.racing.physics.surface import Arc, locate

SPACING = 4.0  # [m], about, between nodes
WIDTH_MIN = 3.0  # [m], half-width, below which cars do not fit
COLUMNS = ("x", "y", "tx", "ty", "curvature", "left", "right", "margin")
_CLOSURE = 1.0  # [m], gap between the ends of a centre line that still counts as closed
_FINE = 0.25  # [m], step of the integration
_LENGTHS = (100.0, 30_000.0)  # [m]; the checks compare all points with each other
_MARGIN_MIN = 1.0  # [m]
_FAR = 1e6  # [m], beyond which single precision does not resolve centimetres


@dataclass(frozen=True)
class Track:
    """A circuit as a table of points along its centre line.

    Attributes:
        name: Name in reports and error messages.
        table: Tensor (n, 8) float64 with rows at equal distances along the centre line and the columns of `COLUMNS`:
            position [m], unit tangent, curvature (positive to the left) [1/m], half-widths to the left and right [m],
            distance from the edge to the wall [m].
        spacing: Distance between rows [m].
    """

    name: str
    table: Tensor
    spacing: float

    def __post_init__(self) -> None:
        _check(self)

    @property
    def length(self) -> float:
        """Length of the centre line [m]."""
        return self.spacing * len(self.table)

    @classmethod
    def from_csv(cls, path: str | Path, name: str | None = None, margin: float = 10.0) -> Track:
        """Read a circuit from a file with the columns x, y, w_right, w_left [m] and a line per point.

        Lines that start with # are comments. A periodic cubic spline joins the points.

        Args:
            path: File to read.
            name: Name of the circuit; by default the file's name without its suffix.
            margin: Distance from the edge of the track to the wall [m].

        Raises:
            ValueError: If the file is not text, a line does not hold four finite numbers, or the track is open, crosses
                itself, is too narrow or too long.
        """
        path = Path(path)
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except UnicodeDecodeError:
            raise ValueError(f"{path} is not a text file: expected lines of x, y, w_right, w_left in metres") from None
        rows = []
        for number, line in enumerate(lines, start=1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            try:
                values = [float(value) for value in line.split(",")[:4]]
            except ValueError:
                if not rows and not re.search(r"(^|,)\s*[-+.\d]", line):  # a header
                    continue
                values = []
            if len(values) != 4 or not all(abs(v) < _FAR for v in values):
                raise ValueError(
                    f"{path}, line {number}: got {line[:80]!r}, expected x, y, w_right, w_left in metres, separated by "
                    f"commas, each below {_FAR:g}; of larger coordinates subtract those of one point"
                )
            rows.append(values)
        if len(rows) < 8:
            raise ValueError(
                f"{path} has {len(rows)} points: expected at least 8 on a closed centre line, each in a line of x, y, "
                "w_right, w_left in metres, separated by commas"
            )
        points = np.array(rows)
        return cls.from_points(points[:, :2], points[:, 3], points[:, 2], name or path.stem, margin)

    @classmethod
    def from_points(
        cls, points: np.ndarray, left: np.ndarray, right: np.ndarray, name: str = "track", margin: float = 10.0
    ) -> Track:
        """Make a circuit whose centre line is a periodic cubic spline through points.

        Args:
            points: Points (n, 2) of the centre line [m].
            left: Distances (n,) from the centre line to the left edge [m].
            right: Distances (n,) from the centre line to the right edge [m].
            name: Name of the circuit.
            margin: Distance from the edge of the track to the wall [m]; it is less inside tight corners, where the wall
                would otherwise lie beyond the centre of the turn.

        Raises:
            ValueError: If the track is open, crosses itself, is too narrow, too short or too long.
        """
        from scipy.interpolate import CubicSpline  # slow to import, and needed here only

        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        while len(points) > 1 and np.linalg.norm(points[0] - points[-1]) < 0.25 * np.median(steps):
            points, left, right = points[:-1], left[:-1], right[:-1]  # the first point repeated, perhaps rounded
        ends, steps = np.linalg.norm(points[0] - points[-1]), steps[: len(points) - 1]
        if ends > max(3.0 * steps.max(), _CLOSURE):
            raise ValueError(f"track {name!r} is open: {ends:.1f} m between its ends, expected a closed centre line")
        if not steps.all():
            twice = int(steps.argmin())
            raise ValueError(
                f"track {name!r}: points {twice + 1} and {twice + 2} are the same, expected different ones"
            )
        low, high = _LENGTHS
        if not low <= steps.sum() + ends <= high:
            raise ValueError(f"track {name!r} is {steps.sum() + ends:.0f} m long: expected {low:.0f} to {high:.0f} m")
        closed = np.vstack([points, points[:1]])
        knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        spline = CubicSpline(knots, closed, bc_type="periodic")
        fine = np.linspace(0.0, knots[-1], 1 + math.ceil(knots[-1] / _FINE))
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(spline(fine), axis=0), axis=1))])
        count = max(8, round(arc[-1] / SPACING))
        at = np.interp(np.arange(count) * arc[-1] / count, arc, fine)
        velocity, bend = spline(at, 1), spline(at, 2)
        speed = np.linalg.norm(velocity, axis=1)
        curvature = (velocity[:, 0] * bend[:, 1] - velocity[:, 1] * bend[:, 0]) / speed**3
        widths = [np.interp(at, knots, np.append(w, w[:1])) for w in (left, right)]
        inner = np.where(curvature > 0, *widths)
        room = 0.94 / np.maximum(np.abs(curvature), 1e-9) - inner
        margins = np.clip(room, min(_MARGIN_MIN, margin), margin)
        columns = [*spline(at).T, *(velocity / speed[:, None]).T, curvature, *widths, margins]
        return cls(name, torch.from_numpy(np.stack(columns, axis=1)), float(arc[-1] / count))

    @classmethod
    def from_turns(
        cls,
        turns: Sequence[tuple[float, float, float]],
        *,
        solve: tuple[int, int] | None = None,
        width: float = 12.0,
        margin: float = 10.0,
        name: str = "track",
    ) -> Track:
        """Make a circuit of straights and turns whose curvature rises and falls linearly.

        Args:
            turns: Length of the straight before the turn [m], angle [deg, positive to the left] and radius [m] of each
                turn; the angles add up to ±360.
            solve: Indices of the two turns whose straights are adjusted so that the track closes.
            width: Width of the track [m].
            margin: Distance from the edge to the wall [m].
            name: Name of the circuit.

        Raises:
            ValueError: If the angles do not add up to ±360, no such straights exist, or the track crosses itself.
        """
        total = sum(angle for _, angle, _ in turns)
        if abs(abs(total) - 360.0) > 1e-6:
            raise ValueError(f"track {name!r} is open: its turns add up to {total:g} degrees, expected 360 or -360")
        straights = [straight for straight, _, _ in turns]
        if solve is not None:
            straights = _close(turns, straights, solve, name)
        pieces = []
        for straight, (_, angle, radius) in zip(straights, turns, strict=True):
            pieces += [(straight, 0.0, 0.0), *turn_pieces(angle, radius)]
        points, headings, curvatures, arc = _integrate(pieces)
        if np.linalg.norm(points[-1] - points[0]) > 1e-3:
            gap = np.linalg.norm(points[-1] - points[0])
            raise ValueError(f"track {name!r} is open: {gap:.2f} m between its ends; name two straights to `solve`")
        count = round(arc[-1] / SPACING)
        at = np.arange(count) * arc[-1] / count
        x, y, heading, curvature = (
            np.interp(at, arc, values) for values in (points[:, 0], points[:, 1], headings, curvatures)
        )
        half = np.full(count, width / 2)
        columns = [x, y, np.cos(heading), np.sin(heading), curvature, half, half, np.full(count, margin)]
        return cls(name, torch.from_numpy(np.stack(columns, axis=1)), float(arc[-1] / count))


def turn_pieces(angle: float, radius: float) -> list[tuple[float, float, float]]:
    """Return ramp, arc and ramp of a turn as (length [m], curvature at the start, curvature at the end [1/m]).

    The angle is positive to the left [deg]; the radius is that of the arc [m].
    """
    arc = radius * math.radians(abs(angle))
    ramp = min(0.45 * arc, 45.0)
    curvature = math.copysign(1.0 / radius, angle)
    return [(ramp, 0.0, curvature), (arc - ramp, curvature, curvature), (ramp, curvature, 0.0)]


def _integrate(pieces: list[tuple[float, float, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, headings, curvatures and distances at most `_FINE` apart along pieces of linear curvature."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    position, heading, distance = np.zeros(2), 0.0, 0.0
    points, headings = [position[None]], [np.zeros(1)]
    curvatures: list[np.ndarray] = [np.array([pieces[0][1]])]
    distances: list[np.ndarray] = [np.zeros(1)]
    for length, first, last in pieces:
        if length <= 0.0:
            continue
        count = math.ceil(length / _FINE)
        h, slope = length / count, (last - first) / length
        start = h * np.arange(count)
        inner = start[:, None] + h * (nodes + 1) / 2
        direction = heading + first * inner + slope * inner**2 / 2
        steps = h / 2 * np.stack([np.cos(direction) @ weights, np.sin(direction) @ weights], axis=1)
        along = start + h
        points.append(position + np.cumsum(steps, axis=0))
        headings.append(heading + first * along + slope * along**2 / 2)
        curvatures.append(first + slope * along)
        distances.append(distance + along)
        position, heading, distance = points[-1][-1], headings[-1][-1], distances[-1][-1]
    return tuple(np.concatenate(parts) for parts in (points, headings, curvatures, distances))  # type: ignore


def _close(
    turns: Sequence[tuple[float, float, float]], straights: list[float], solve: tuple[int, int], name: str
) -> list[float]:
    """Return the lengths of the straights with two of them changed so that the track ends where it starts."""
    pieces, headings, heading = [], [], 0.0
    for index, (_, angle, radius) in enumerate(turns):
        headings.append(heading)
        pieces += [(0.0 if index in solve else straights[index], 0.0, 0.0), *turn_pieces(angle, radius)]
        heading += math.radians(angle)
    gap = _integrate(pieces)[0][-1]
    directions = np.array([[math.cos(headings[i]), math.sin(headings[i])] for i in solve]).T
    if abs(np.linalg.det(directions)) < 1e-3:
        raise ValueError(f"track {name!r}: the straights {solve} are parallel, name two others to `solve`")
    lengths = np.linalg.solve(directions, -gap)
    if lengths.min() < 0.0:
        raise ValueError(
            f"track {name!r} does not close: straights {solve} would be {lengths.round(1).tolist()} m long"
        )
    closed = list(straights)
    closed[solve[0]], closed[solve[1]] = lengths.tolist()
    return closed


def clearance(track: Track, apart: float = 60.0) -> float:
    """Return the smallest distance between points of the centre line that are far from each other along the track [m].

    Args:
        track: Circuit.
        apart: Distance along the track from which two points count as far from each other [m]; it is limited to a
            quarter of the length.
    """
    points = track.table[:, :2]
    distance = torch.cdist(points, points)
    index = torch.arange(len(points))
    along = (index[:, None] - index).abs()
    along = torch.minimum(along, len(points) - along) * track.spacing
    return float(distance[along >= min(apart, track.length / 4)].min())


def _check(track: Track) -> None:
    table, name = track.table, track.name
    if table.ndim != 2 or table.shape[1] != len(COLUMNS) or len(table) < 8:
        raise ValueError(f"track {name!r} has a table of shape {tuple(table.shape)}: expected (n, {len(COLUMNS)})")
    if not torch.isfinite(table).all():
        raise ValueError(f"track {name!r} holds NaN or infinite numbers")
    left, right, margin, curvature = table[:, 5], table[:, 6], table[:, 7], table[:, 4]
    narrow = float(torch.minimum(left, right).min())
    if narrow < WIDTH_MIN:
        raise ValueError(f"track {name!r} is {narrow:.2f} m wide on one side: expected at least {WIDTH_MIN} m")
    inner = torch.where(curvature > 0, left, right) + margin
    node = int((inner * curvature.abs()).argmax())
    if inner[node] * curvature[node].abs() > 0.95:
        raise ValueError(
            f"track {name!r}: the inner wall of the turn at x {table[node, 0]:.1f}, y {table[node, 1]:.1f} is "
            f"{inner[node]:.1f} m from the centre line, which has a radius of {1 / curvature[node].abs():.1f} m there: "
            "reduce width or margin, or smooth points that are rounded"
        )
    gap = table[0, :2] - (table[-1, :2] + track.spacing * table[-1, 2:4])
    if float(gap.norm()) > track.spacing:
        raise ValueError(f"track {name!r} is open: {float(gap.norm()):.1f} m between its ends")
    widest = float((left + right).max())
    if clearance(track) < widest:
        raise ValueError(f"track {name!r} crosses itself, or comes within {widest:.1f} m of itself")


class Course(torch.nn.Module):
    """Tables of one or several circuits on a device, with conversions between positions and distances along the track.

    With several circuits, each of N cars is on one of them, and the methods take tensors whose last dimension is N.
    With one circuit they take tensors of any shape. Nodes are rows of the joint table.

    Args:
        tracks: Circuit, or several of them.
        device: Device of the table.
        dtype: Type of the table.

    Attributes:
        tracks: The circuits.
        length: Length of the circuit [m], or of each car's circuit (N,).
    """

    def __init__(
        self,
        tracks: Track | Sequence[Track],
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        tracks = (tracks,) if isinstance(tracks, Track) else tuple(tracks)
        self.tracks = tracks
        self.register_buffer("table", torch.cat([track.table for track in tracks]).to(device, dtype).contiguous())
        self.table: Tensor
        counts = torch.tensor([len(track.table) for track in tracks], device=device)
        lengths = torch.tensor([track.length for track in tracks], device=device, dtype=dtype)
        spacings = torch.tensor([track.spacing for track in tracks], device=device, dtype=dtype)
        self._each = (lengths, spacings, counts, counts.cumsum(0) - counts)
        self.length: float | Tensor = tracks[0].length
        self.spacing: float | Tensor = tracks[0].spacing
        self.count: int | Tensor = len(tracks[0].table)
        self.first: int | Tensor = 0

    def assign(self, circuit: Tensor) -> None:
        """Put each of N cars on one of several circuits.

        Args:
            circuit: Number of the circuit of each car (N,) int64.
        """
        if len(self.tracks) > 1:
            self.length, self.spacing, self.count, self.first = (values[circuit] for values in self._each)

    def race_length(self, cars: int) -> float | Tensor:
        """Return the length of the circuit of each race (B,) [m], or of the only circuit, for races of `cars` cars."""
        return self.length[: len(self.length) // cars] if isinstance(self.length, Tensor) else self.length

    def node(self, s: Tensor) -> Tensor:
        """Return the node (...,) nearest to distances along the track (...,) [m]."""
        return torch.remainder(torch.round(s / self.spacing).to(torch.int64), self.count) + self.first

    def distance(self, node: Tensor) -> Tensor:
        """Return the distances of nodes (...,) along their track (...,) [m]."""
        return (node - self.first) * self.spacing

    def frame(self, node: Tensor) -> Tensor:
        """Return the rows of the table at nodes (...), as (8, ...)."""
        return torch.stack([self.table[:, column][node] for column in range(8)])

    def project(self, x: Tensor, y: Tensor, s: Tensor) -> tuple[Tensor, Arc, Tensor]:
        """Project points on the centre line, starting from an estimate.

        Each of two look-ups projects the points on the arc at a node; the first finds the node of the second.

        Args:
            x: Positions (N,) [m].
            y: Positions (N,) [m].
            s: Estimates (N,) of the distance along the track, within a few dozen metres of the result [m].

        Returns:
            The distance along the track (N,) in [0, length) [m], the position relative to the arc, and the frame
            (8, N) of the nearest node.
        """
        node = self.node(s)
        frame = self.frame(node)
        arc = locate(x, y, *frame[:5].unbind(0))
        node = self.node(self.distance(node) + arc.ahead.clamp(-40.0, 40.0))
        frame = self.frame(node)
        arc = locate(x, y, *frame[:5].unbind(0))
        ahead = torch.clamp(arc.ahead, -self.spacing, self.spacing)  # pyright: ignore[reportCallIssue, reportArgumentType]
        return torch.remainder(self.distance(node) + ahead, self.length), arc, frame

    def place(self, s: Tensor, offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the positions of points beside the centre line, and the direction of the track there.

        Args:
            s: Distances (...) along the track [m].
            offset: Distances (...) from the centre line to the left [m].

        Returns:
            x and y [m] and the heading of the track [rad], (...) each.
        """
        node = self.node(s)
        x, y, tx, ty, curvature = self.frame(node)[:5].unbind(0)
        ahead = self.past(node, s)
        angle = curvature * ahead
        # Along the arc: chord by the series of sine and versine, which is exact enough within half a spacing.
        forward = ahead * (1 - angle * angle / 6)
        side = 0.5 * angle * ahead
        cos, sin = torch.cos(angle), torch.sin(angle)
        dx, dy = forward - offset * sin, side + offset * cos
        return x + dx * tx - dy * ty, y + dx * ty + dy * tx, torch.atan2(ty, tx) + angle

    def past(self, node: Tensor, s: Tensor) -> Tensor:
        """Return how far (N,) [m] distances along the track (N,) [m] are past nodes (N,) near them, negative before."""
        half = self.length / 2
        return torch.remainder(s - self.distance(node) + half, self.length) - half
