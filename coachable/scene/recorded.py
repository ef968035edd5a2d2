"""Recorded scenes as compressed bytes, which the exported page plays.

A file is compressed with gzip. It holds the length of a header in bytes (uint32, little-endian), the header as JSON,
and after it the arrays that `arrays` in the header lists by name, type, shape and offset from the header's end.
"""

import gzip
import json
from collections.abc import Hashable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from coachable.scene.between import alike
from coachable.scene.frame import Backdrop, Frame
from coachable.scene.palette import css
from coachable.scene.parts import SHAPES, Batch, Parts, multiplied, rotated

_RIGID = 2e-3  # [m] and of quaternions: primitives that differ less from a rigid figure belong to it
_DIGITS = 3  # of the places and sizes of marks [m]
_TURN = 32767  # of a quaternion's 1, as int16


def encode_frames(frames: Sequence[Frame], places: Mapping[Hashable, int]) -> bytes:
    """Return the recorded frames of one episode.

    Primitives that move together are stored as one figure, and marks and translucent primitives with the first and the
    last frame that shows them, so that a minute takes some hundred kilobytes.

    Args:
        frames: One frame per control step, at least one.
        places: Numbers of the backdrops by `Frame.place`.
    """
    arrays: dict[str, np.ndarray] = {
        "focus": np.array([frame.focus for frame in frames], np.float32),
        "heading": np.array([frame.heading for frame in frames], np.float32),
    }
    cuts = [0, *(i + 1 for i, pair in enumerate(pairwise(frames)) if not alike(*pair)), len(frames)]
    segments = []
    for number, (first, end) in enumerate(pairwise(cuts)):
        counts = {shape: len(frames[first].parts.of(shape)) for shape in SHAPES}
        arrays |= {f"{number}/{name}": array for name, array in _segment(frames[first:end]).items()}
        segments.append({"first": first, "frames": end - first, "counts": counts, "place": places[frames[first].place]})
    for group in ("marks", "glows"):
        arrays |= {f"{group}/{name}": array for name, array in _lasting([getattr(f, group) for f in frames]).items()}
    header: dict[str, Any] = {
        "frames": len(frames),
        "segments": segments,
        "gauges": [
            [[g.name, g.text, None if g.share is None else round(float(g.share), 3), css(g.colour)] for g in f.gauges]
            for f in frames
        ],
        "labels": [
            [[label.text, *np.round(np.asarray(label.position, dtype=float), 2).tolist()] for label in f.labels]
            for f in frames
        ],
    }
    maps = [frame.map for frame in frames]
    if maps[0] is not None:
        width = max(len(shown.places) for shown in maps if shown is not None)
        dots = [shown.scaled(100.0, 100.0)[1] if shown is not None else np.zeros((0, 2)) for shown in maps]
        arrays["map"] = np.array([np.pad(d, ((0, width - len(d)), (0, 0)), constant_values=np.nan) for d in dots], "f4")
        header["map"] = {
            "outline": np.round(maps[0].scaled(100.0, 100.0)[0], 1).tolist(),
            "colours": [css(maps[0].colours[i % len(maps[0].colours)]) for i in range(width)],
        }
    return _packed(header, arrays)


def encode_backdrop(backdrop: Backdrop) -> bytes:
    """Return what does not move."""
    arrays: dict[str, np.ndarray] = {}
    for number, surface in enumerate(backdrop.surfaces):
        arrays[f"{number}/vertices"] = surface.vertices.astype(np.float32)
        arrays[f"{number}/faces"] = surface.faces.astype(np.uint32)
    own = _joined(backdrop.parts)
    turns = _short(own.wxyzs)
    arrays |= {"positions": own.positions.astype("f4"), "turns": turns, "sizes": own.sizes.astype("f4")}
    arrays["colours"] = own.colours
    surfaces = [{"name": surface.name, "colour": css(surface.colour)} for surface in backdrop.surfaces]
    counts = {shape: len(backdrop.parts.of(shape)) for shape in SHAPES}
    return _packed({"surfaces": surfaces, "counts": counts, "travels": backdrop.travels}, arrays)


def encode_figures(figures: Sequence[Parts]) -> bytes:
    """Return rigid figures, which a page moves itself, each in its own frame.

    Args:
        figures: Primitives of each figure; a primitive's number `figure` counts them from 1.
    """
    batches = [(number, part.of(shape)) for shape in SHAPES for number, part in enumerate(figures, 1)]
    arrays = {
        "figure": np.concatenate([np.full(len(batch), number, np.uint16) for number, batch in batches]),
        "own_positions": np.concatenate([batch.positions for _, batch in batches]).astype(np.float32),
        "own_turns": np.concatenate([batch.wxyzs for _, batch in batches]).astype(np.float32),
        "sizes": np.concatenate([batch.sizes for _, batch in batches]).astype(np.float32),
        "colours": np.concatenate([batch.colours for _, batch in batches]),
    }
    counts = {shape: sum(len(figure.of(shape)) for figure in figures) for shape in SHAPES}
    return _packed({"figures": len(figures), "counts": counts}, arrays)


def _segment(frames: Sequence[Frame]) -> dict[str, np.ndarray]:
    """Return the moving primitives of frames that have equally many: rigid figures, and changes of size and colour."""
    batches = [_joined(frame.parts) for frame in frames]
    positions, turns = np.stack([b.positions for b in batches]), np.stack([b.wxyzs for b in batches])  # (F, K, .)
    sizes, colours = np.stack([b.sizes for b in batches]), np.stack([b.colours for b in batches])
    figure, own_positions, own_turns, movers = _figures(positions, turns)
    changed = (np.abs(np.diff(sizes, axis=0)) > 1e-6).any(-1) | (np.diff(colours.astype(int), axis=0) != 0).any(-1)
    at, part = np.nonzero(changed)
    return {
        "figure": figure.astype(np.uint16),
        "own_positions": own_positions.astype(np.float32),
        "own_turns": own_turns.astype(np.float32),
        "positions": positions[:, movers].astype(np.float32),
        "turns": _short(turns[:, movers]),
        "sizes": sizes[0].astype(np.float32),
        "colours": colours[0],
        "changed_at": (at + 1).astype(np.uint32),
        "changed_part": part.astype(np.uint16),
        "changed_size": sizes[at + 1, part].astype(np.float32),
        "changed_colour": colours[at + 1, part],
    }


def _figures(positions: np.ndarray, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[int]]:
    """Find the primitives that move together.

    Args:
        positions: Places (F, K, 3) [m].
        turns: Rotations (F, K, 4).

    Returns:
        The figure (K,) of each primitive, which is 0 for those that stay where they are; place (K, 3) and rotation
        (K, 4) in the figure's frame; and the primitive whose pose is the frame of each figure from 1 on.
    """
    count = positions.shape[1]
    figure, places, own = np.full(count, -1), positions[0].copy(), turns[0].copy()
    figure[_constant(positions) & _constant(_same_sign(turns))] = 0
    movers: list[int] = []
    while (free := np.flatnonzero(figure < 0)).size:
        mover = int(free[0])
        movers.append(mover)
        back = turns[:, mover] * (1.0, -1.0, -1.0, -1.0)
        relative = rotated(back[:, None], positions[:, free] - positions[:, mover, None])
        turned = _same_sign(multiplied(back[:, None], turns[:, free]))
        joins = _constant(relative) & _constant(turned)
        joins[0] = True
        members = free[joins]
        figure[members], places[members], own[members] = len(movers), relative[0, joins], turned[0, joins]
    return figure, places, own, movers


def _lasting(groups: Sequence[Parts]) -> dict[str, np.ndarray]:
    """Return primitives with the first and the last frame of which they are part, in the order of the first one."""
    alive: dict[tuple, int] = {}
    rows: list[tuple[int, int, tuple]] = []
    for index, parts in enumerate([*groups, Parts()]):
        seen = set()
        for number, shape in enumerate(SHAPES):
            batch = parts.of(shape)
            table = np.concatenate(
                [np.round(batch.positions, _DIGITS), np.round(batch.wxyzs, 4), np.round(batch.sizes, _DIGITS)], axis=1
            )
            seen |= {
                (number, *row, *colour) for row, colour in zip(table.tolist(), batch.colours.tolist(), strict=True)
            }
        for key in [key for key in alive if key not in seen]:
            rows.append((alive.pop(key), index - 1, key))
        alive |= dict.fromkeys(sorted(seen - alive.keys()), index)
    rows.sort()
    table = np.array([key for _, _, key in rows], dtype=float).reshape(-1, 14)
    return {
        "first": np.array([first for first, _, _ in rows], np.uint32),
        "last": np.array([last for _, last, _ in rows], np.uint32),
        "shape": table[:, 0].astype(np.uint8),
        "positions": table[:, 1:4].astype(np.float32),
        "turns": _short(table[:, 4:8]),
        "sizes": table[:, 8:11].astype(np.float32),
        "colours": table[:, 11:14].astype(np.uint8),
    }


def _joined(parts: Parts) -> Batch:
    """Return the primitives of all shapes, in the order of `SHAPES`."""
    batches = [parts.of(shape) for shape in SHAPES]
    fields = ("positions", "wxyzs", "sizes", "colours")
    return Batch(*(np.concatenate([getattr(batch, name) for batch in batches]) for name in fields))


def _constant(values: np.ndarray) -> np.ndarray:
    """Return which columns (K,) of values (F, K, n) do not change."""
    return np.all(np.abs(values - values[:1]) < _RIGID, axis=(0, 2))


def _same_sign(turns: np.ndarray) -> np.ndarray:
    """Return quaternions (F, K, 4), each with the sign that is nearer to the first row's."""
    return np.where((turns * turns[:1]).sum(-1, keepdims=True) < 0, -turns, turns)


def _short(turns: np.ndarray) -> np.ndarray:
    """Return unit quaternions as int16."""
    return np.round(_TURN * np.clip(turns, -1.0, 1.0)).astype(np.int16)


def _packed(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    listed, blocks, offset = [], [], 0
    for name, array in arrays.items():
        block = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()
        listed.append({"name": name, "type": array.dtype.name, "shape": array.shape, "offset": offset})
        block += bytes(-len(block) % 8)
        blocks.append(block)
        offset += len(block)
    text = json.dumps({**header, "arrays": listed}, separators=(",", ":")).encode()
    text += b" " * (-(len(text) + 4) % 8)
    return gzip.compress(len(text).to_bytes(4, "little") + text + b"".join(blocks), mtime=0)
