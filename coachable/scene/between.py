"""Frames between two control steps, so that slow control steps are drawn smoothly."""

import math
from dataclasses import replace

import numpy as np

from coachable.scene.frame import Frame
from coachable.scene.parts import SHAPES, Batch, Parts

_JUMP = 20.0  # [m]; an agent that moved farther than this was put somewhere else


def alike(before: Frame, after: Frame) -> bool:
    """Return whether two frames show the same primitives in one episode and place."""
    same = all(len(before.parts.of(shape)) == len(after.parts.of(shape)) for shape in SHAPES)
    return same and (before.episode, before.place) == (after.episode, after.place)


def continues(before: Frame, after: Frame) -> bool:
    """Return whether a frame shows the primitives of the one before, moved."""
    near = float(np.linalg.norm(np.subtract(after.focus, before.focus))) < _JUMP
    return near and alike(before, after)


def between(before: Frame, after: Frame, share: float) -> Frame:
    """Return the frame between two frames that continue each other; only places and rotations are mixed.

    Args:
        before: Frame at share 0.
        after: Frame at share 1, whose colours, sizes, labels and gauges are used.
        share: Share of the way.

    Returns:
        Frame whose positions are mixed linearly, and whose rotations are mixed along the shorter way and normalised.
    """
    parts = Parts()
    for shape in SHAPES:
        one, other = before.parts.of(shape), after.parts.of(shape)
        if len(other):
            places = one.positions + share * (other.positions - one.positions)
            nearer = np.where((one.wxyzs * other.wxyzs).sum(1, keepdims=True) < 0, -other.wxyzs, other.wxyzs)
            turns = one.wxyzs + share * (nearer - one.wxyzs)
            turns = turns / np.linalg.norm(turns, axis=1, keepdims=True)
            parts.batch(shape, Batch(places, turns, other.sizes, other.colours))
    turned = math.remainder(after.heading - before.heading, 2 * math.pi)
    focus = np.asarray(before.focus) + share * np.subtract(after.focus, before.focus)
    return replace(after, parts=parts, focus=focus, heading=before.heading + share * turned)
