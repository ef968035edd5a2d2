"""Generator of random circuits, from which trainings and held-out evaluations take theirs."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from coachable.envs.racing.circuit.track import Track, clearance, turn_pieces

_APART = 60.0  # [m], between sections of a generated track
_STRAIGHT_MIN = 15.0  # [m]
_BATCH = 256  # candidates that are drawn at once
_BATCHES = 100
_GAUSS = np.polynomial.legendre.leggauss(12)  # points and weights of the integral along a piece
_LENGTHS, _WIDTHS = (2500.0, 6500.0), (10.0, 15.0)  # [m], of numbered circuits


class _Candidates(NamedTuple):
    """Sections of C circuits of T turns, (C, T) each."""

    straight: np.ndarray  # before the turn [m]
    angle: np.ndarray  # [deg], positive to the left
    radius: np.ndarray  # [m]


def numbered_track(number: int) -> Track:
    """Return the generated circuit of a number, whose length and width depend on the number, too.

    Args:
        number: Number of the circuit, at least 0. Equal numbers give equal circuits.
    """
    random = np.random.default_rng((number, 1))
    length, width = random.uniform(*_LENGTHS), random.uniform(*_WIDTHS)
    return generate_track(number, length, width=width, name=f"circuit-{number}")


def generate_track(seed: int, length: float = 5000.0, *, width: float = 12.0, name: str | None = None) -> Track:
    """Generate a random circuit of about a given length whose sections keep clear of each other.

    Turns and straights are drawn at random. The straights are then changed as little as possible (least squares) so
    that the circuit closes.

    Args:
        seed: Seed of the circuit.
        length: Length, 2,000 to 14,000; the circuit's differs by less than 10 % [m].
        width: Width of the track [m].
        name: Name of the circuit; by default it is made from the seed.

    Raises:
        ValueError: If the length is out of range.
        RuntimeError: If no candidate fits.
    """
    if not 2000.0 <= length <= 14000.0:
        raise ValueError(f"length is {length:g} m: expected 2000 to 14000")
    name = name or f"generated-{seed}"
    random = np.random.default_rng(seed)
    turns = int(np.clip(round(length / 450.0), 7, 22))
    for _ in range(_BATCHES):
        for sections, solve in _closed(_draw(random, turns, length), length):
            try:
                track = Track.from_turns(sections, solve=solve, width=width, name=name)
            except ValueError:
                continue
            if abs(track.length / length - 1.0) < 0.1 and clearance(track, apart=150.0) > _APART:
                return track
    raise RuntimeError(f"no circuit of {length:g} m among {_BATCH * _BATCHES} with seed {seed}: try another seed")


def _draw(random: np.random.Generator, turns: int, length: float) -> _Candidates:
    """Draw circuits that turn by 360 degrees, most of whose turns go the same way."""
    shape = _BATCH, turns
    sign = random.choice([-1.0, 1.0], (_BATCH, 1))
    angle = random.uniform(30.0, 130.0, shape) * np.where(random.random(shape) < 0.68, 1.0, -0.6)
    total = angle.sum(1, keepdims=True)
    angle *= 360.0 / np.where(total > 60.0, total, np.inf)  # the others do not turn at all and are left out
    radius = np.exp(random.uniform(math.log(28.0), math.log(160.0), shape))
    straight = random.uniform(0.3, 2.0, shape)
    arcs = (radius * np.radians(np.abs(angle)) + 30.0).sum(1, keepdims=True)
    straight *= np.maximum(length - arcs, 0.3 * length) / straight.sum(1, keepdims=True)
    size = np.abs(angle)
    fit = (size.max(1) < 170.0) & (size.min(1) > 15.0)
    return _Candidates(straight[fit], (sign * angle)[fit], radius[fit])


def _closed(drawn: _Candidates, length: float) -> Iterator[tuple[list[tuple[float, float, float]], tuple[int, int]]]:
    """Yield the candidates that can be closed and seem to keep clear of themselves.

    Each comes as its turns (straight, angle, radius) and the two turns whose straights `Track.from_turns` may adjust.
    """
    for straight, angle, radius in zip(*drawn, strict=True):
        heading = np.radians(np.cumsum(angle) - angle)
        pieces = [turn_pieces(float(a), float(r)) for a, r in zip(angle, radius, strict=True)]
        steps = np.array([_displacement(turn, float(h)) for turn, h in zip(pieces, heading, strict=True)])
        directions = np.stack([np.cos(heading), np.sin(heading)])  # (2, T)
        gap = directions @ straight + steps.sum(0)
        straight = straight - directions.T @ np.linalg.solve(directions @ directions.T, gap)
        arcs = sum(piece[0] for turn in pieces for piece in turn)
        if straight.min() < _STRAIGHT_MIN or abs((straight.sum() + arcs) / length - 1.0) > 0.09:
            continue
        if not _seems_clear(straight, directions.T, steps):
            continue
        first = int(straight.argmax())
        second = int(np.abs(np.sin(heading - heading[first])).argmax())
        turns = list(zip(straight.tolist(), angle.tolist(), radius.tolist(), strict=True))
        yield turns, (first, second)


def _displacement(pieces: list[tuple[float, float, float]], heading: float) -> np.ndarray:
    """Return the displacement (2,) [m] along pieces of linear curvature, from a heading [rad] on."""
    nodes, weights = _GAUSS
    total = np.zeros(2)
    for length, first, last in pieces:
        along = length * (nodes + 1) / 2
        angle = heading + first * along + (last - first) / length * along**2 / 2
        total += length / 2 * np.array([np.cos(angle) @ weights, np.sin(angle) @ weights])
        heading += (first + last) / 2 * length
    return total


def _seems_clear(straight: np.ndarray, directions: np.ndarray, steps: np.ndarray) -> bool:
    """Return whether no two straights that are not neighbours cross; the rest is checked on the finished track."""
    leaves = np.cumsum(straight[:, None] * directions + np.roll(steps, 1, axis=0), axis=0) - steps[-1]
    starts = leaves - straight[:, None] * directions
    for i in range(len(straight) - 2):
        others = slice(i + 2, len(straight) - (i == 0))
        if _cross(starts[i], leaves[i], starts[others], leaves[others]).any():
            return False
    return True


def _cross(a: np.ndarray, b: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return whether the segment from a to b (2,) crosses each of the others (n, 2)."""

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])

    return (side(a, b, starts) * side(a, b, ends) < 0) & (side(starts, ends, a) * side(starts, ends, b) < 0)
