"""Shipped circuits and a generator of random ones. All were made for this library and use no third-party data."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from coachable.envs.racing.circuit.track import Track, clearance

# (straight before [m], angle [deg, positive to the left], radius [m]) of each turn, from the start line on.
_LAKESIDE = (
    (750.0, -90.0, 60.0),
    (240.0, 60.0, 90.0),
    (330.0, -110.0, 35.0),
    (430.0, -50.0, 160.0),
    (220.0, 100.0, 45.0),
    (200.0, -75.0, 80.0),
    (782.5, -150.0, 28.0),
    (610.0, 70.0, 120.0),
    (584.5, -60.0, 70.0),
    (210.0, -55.0, 110.0),
)
_RIDGE = (
    (184.8, -43.22, 105.5),
    (141.5, -73.9, 139.2),
    (352.5, -43.54, 84.4),
    (524.5, 36.51, 29.1),
    (248.4, -50.21, 62.5),
    (427.6, -51.71, 74.3),
    (115.8, -72.76, 45.2),
    (571.7, -33.8, 56.1),
    (581.1, -27.37, 58.7),
)
_ENDURANCE = (
    (998.0, -164.55, 130.0),
    (558.0, 73.5, 55.0),
    (1782.0, -105.79, 61.0),
    (1909.0, -100.96, 101.0),
    (1714.0, 95.55, 56.0),
    (696.0, 24.2, 207.0),
    (399.0, -169.14, 236.0),
    (1438.0, -101.03, 156.0),
    (642.0, 88.22, 183.0),
)
_APART = 60.0  # [m], between sections of a generated track


def ring(radius: float = 200.0, width: float = 12.0) -> Track:
    """Return a circle driven to the left, for tests.

    Args:
        radius: Radius of the centre line [m].
        width: Width of the track [m].
    """
    import torch

    count = max(8, round(2 * math.pi * radius / 4.0))
    angle = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    one = torch.ones_like(angle)
    columns = [radius * angle.sin(), radius * (1 - angle.cos()), angle.cos(), angle.sin()]
    columns += [one / radius, one * width / 2, one * width / 2, one * 10.0]
    return Track("ring", torch.stack(columns, dim=1), 2 * math.pi * radius / count)


def oval(straight: float = 600.0, radius: float = 120.0, width: float = 12.0) -> Track:
    """Return a circuit of two straights and two half circles driven to the left, for tests.

    Args:
        straight: Length of each straight [m].
        radius: Radius of the half circles [m].
        width: Width of the track [m].
    """
    turns = [(straight / 2, 180.0, radius), (straight, 180.0, radius), (straight / 2, 0.0, radius)]
    return Track.from_turns(turns, width=width, name="oval")


def lakeside() -> Track:
    """Return a circuit of 5.7 km with long straights and slow corners, for tyre and fuel saving."""
    return Track.from_turns(_LAKESIDE, solve=(6, 8), name="lakeside")


def ridge() -> Track:
    """Return a circuit of 4.1 km with flowing corners, for drifting."""
    return Track.from_turns(_RIDGE, solve=(4, 8), width=14.0, name="ridge")


def endurance() -> Track:
    """Return a fast circuit of 13.6 km, for races."""
    return Track.from_turns(_ENDURANCE, solve=(4, 8), width=14.0, name="endurance")


_BUILDERS = {"lakeside": lakeside, "ridge": ridge, "endurance": endurance, "ring": ring, "oval": oval}
CIRCUITS = tuple(_BUILDERS)


@lru_cache
def load_track(name: str) -> Track:
    """Return a shipped circuit.

    Args:
        name: One of `CIRCUITS`.

    Raises:
        ValueError: If there is no such circuit.
    """
    if name not in _BUILDERS:
        raise ValueError(f"unknown track {name!r}: expected one of {', '.join(_BUILDERS)}, or a Track")
    return _BUILDERS[name]()


def generate_track(
    seed: int, length: float = 5000.0, *, width: float = 12.0, name: str | None = None, attempts: int = 5000
) -> Track:
    """Generate a random circuit of about a given length whose sections keep clear of each other.

    Args:
        seed: Seed of the circuit.
        length: Length, 2,000 to 14,000; the circuit's differs by less than 10 % [m].
        width: Width of the track [m].
        name: Name of the circuit; by default it is made from the seed.
        attempts: Number of candidates to try.

    Raises:
        ValueError: If the length is out of range.
        RuntimeError: If no candidate fits.
    """
    if not 2000.0 <= length <= 14000.0:
        raise ValueError(f"length is {length:g} m: expected 2000 to 14000")
    name = name or f"generated-{seed}"
    random = np.random.default_rng(seed)
    turns = int(np.clip(round(length / 450.0), 7, 22))
    for _ in range(attempts):
        candidate = _candidate(random, turns, length)
        try:
            track = Track.from_turns(candidate, solve=(turns // 2, turns - 1), width=width, name=name)
        except ValueError:
            continue
        if abs(track.length / length - 1.0) < 0.1 and clearance(track, apart=150.0) > _APART:
            return track
    raise RuntimeError(f"no circuit of {length:g} m in {attempts} attempts with seed {seed}: try another seed")


def _candidate(random: np.random.Generator, turns: int, length: float) -> list[tuple[float, float, float]]:
    """Draw sections (straight [m], angle [deg], radius [m]) of a closed circuit, most of which turn the same way."""
    sign = random.choice([-1.0, 1.0])
    angles = random.uniform(30.0, 130.0, turns) * np.where(random.random(turns) < 0.68, 1.0, -1.0)
    angles *= 1.0 - 0.4 * (angles < 0)
    if angles.sum() <= 0.0:
        return [(0.0, 0.0, 1.0)]
    angles *= 360.0 / angles.sum() * np.ones(turns)
    if np.abs(angles).max() > 170.0 or np.abs(angles).min() < 15.0:
        return [(0.0, 0.0, 1.0)]
    angles[-1] += 360.0 - angles.sum()
    radii = np.exp(random.uniform(math.log(28.0), math.log(160.0), turns))
    arcs = radii * np.radians(np.abs(angles)) + 30.0
    straights = random.uniform(0.3, 2.0, turns)
    straights *= max(length - arcs.sum(), 0.3 * length) / straights.sum()
    return [(float(s), float(sign * a), float(r)) for s, a, r in zip(straights, angles, radii, strict=True)]
