"""Circuits by name. All were made for this library and use no third-party data."""

import math
from collections.abc import Sequence
from functools import lru_cache

from coachable.envs.racing.circuit.generator import numbered_track
from coachable.envs.racing.circuit.track import Track

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
SHIPPED = ("lakeside", "ridge", "endurance")
# Of the numbers from 128 to 999, the 32 circuits that turn the most per kilometre, by 197 to 242 degrees. Only one in
# twenty of the others turns by more than 195.
# fmt: off
_TWISTY = (
    128, 193, 259, 310, 319, 338, 403, 406, 421, 463, 470, 501, 508, 517, 546, 550, 570, 600, 613, 662, 673,
    677, 716, 735, 759, 796, 863, 880, 904, 967, 968, 997,
)
# fmt: on
TRAINED = tuple(f"circuit-{number}" for number in (*range(128), *_TWISTY))
HELD_OUT = tuple(f"circuit-{number}" for number in range(1000, 1008))
SETS = {"training": (*SHIPPED, *TRAINED), "held_out": HELD_OUT}


@lru_cache
def load_track(name: str) -> Track:
    """Return a circuit by its name.

    Args:
        name: One of `CIRCUITS`, or "circuit-N" with a whole number N for a generated one.

    Raises:
        ValueError: If there is no such circuit.
    """
    if name in _BUILDERS:
        return _BUILDERS[name]()
    number = name.removeprefix("circuit-")
    if number == name or not number.isdecimal():
        known = ", ".join(_BUILDERS)
        raise ValueError(f"unknown track {name!r}: expected one of {known}, circuit-N with a number N, or a Track")
    return numbered_track(int(number))


def load_tracks(tracks: str | Track | Sequence[str | Track]) -> tuple[Track, ...]:
    """Return one or several circuits.

    Args:
        tracks: A circuit or its name, several of them, or the name of a set: "training" (the shipped ones and
            `TRAINED`) or "held_out" (`HELD_OUT`, on which no preset trains).

    Raises:
        ValueError: If there is no such circuit, or none is given.
    """
    if isinstance(tracks, str):
        tracks = SETS.get(tracks, (tracks,))
    chosen = (tracks,) if isinstance(tracks, Track) else tuple(tracks)
    if not chosen:
        raise ValueError("no track given: expected at least one")
    return tuple(load_track(track) if isinstance(track, str) else track for track in chosen)
