"""PlayStation-like gamepad with policy heads, constraints of a virtual hand, and names for actions.

An action is one tensor `(..., 24)` of the one-hots of six heads and the four stick axes (paper, Table "Policy head
outputs"). The 864 raw combinations of the heads have 315 different meanings, because a thumb is either on its stick or
on its buttons. `canonical` maps every raw action to the one that the game uses.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from coachable.distributions.action_heads import ActionHeads
from coachable.signals import Signal

FACE = ("none", "cross", "circle", "square")
DPAD = ("none", "up", "down", "left", "right", "L3")
LEFT_SHOULDER = ("none", "L1", "L2")
RIGHT_SHOULDER = ("none", "R1", "R2")
MODE = ("buttons", "joystick")

HEADS = {
    "face": FACE,
    "dpad": DPAD,
    "left_shoulder": LEFT_SHOULDER,
    "right_shoulder": RIGHT_SHOULDER,
    "left_mode": MODE,
    "right_mode": MODE,
}
"""Values of each head, in the order of the action tensor. The order is ours, the heads are the paper's."""

AXES = ("left_x", "left_y", "right_x", "right_y")
"""Sticks, in [-1, 1]; x to the right, y up or forward."""

GAMEPAD = ActionHeads(categorical=tuple(len(values) for values in HEADS.values()), axes=len(AXES))
"""Components of the action tensor, for policies and specs."""

ACTION_GROUPS = (
    *(Signal(head, len(values), "", values) for head, values in HEADS.items()),
    Signal("sticks", len(AXES), "full deflection", AXES),
)
"""Blocks of the action tensor, in order."""

_SYMBOLS: dict[str, str] = {
    "cross": "✕",
    "circle": "○",
    "square": "□",
    "up": "↑",
    "down": "↓",
    "left": "←",
    "right": "→",
}
_ROWS: dict[str, int] = {}  # "face.cross": 1, ... rows of the transposed action tensor
for _head, _values in HEADS.items():
    for _value in _values:
        _ROWS[f"{_head}.{_value}"] = len(_ROWS)


def _legal(face: str, dpad: str, left_mode: str, right_mode: str) -> bool:
    """Return whether the thumbs reach the buttons; a thumb on its stick reaches only L3, which needs the left thumb."""
    left = dpad in ("none", "L3") if left_mode == "joystick" else dpad != "L3"
    return left and (face == "none" or right_mode == "buttons")


class Pad(NamedTuple):
    """Fields of a canonical action: buttons `(...,)`, 0 or 1, and sticks `(2, ...)`, x and y.

    A stick is 0 while its thumb is on the buttons.
    """

    cross: Tensor
    circle: Tensor
    square: Tensor
    up: Tensor
    down: Tensor
    left: Tensor
    right: Tensor
    l3: Tensor
    l1: Tensor
    l2: Tensor
    r1: Tensor
    r2: Tensor
    left_stick: Tensor
    right_stick: Tensor


def canonical_rows(rows: Tensor) -> Tensor:
    """Return `canonical` of actions whose components come first, `(24, ...)`."""
    left_joystick, right_joystick = rows[_ROWS["left_mode.joystick"]], rows[_ROWS["right_mode.joystick"]]
    left_buttons, right_buttons = 1.0 - left_joystick, 1.0 - right_joystick
    face = rows[1:4] * right_buttons
    arrows = rows[5:9] * left_buttons
    l3 = rows[9:10] * left_joystick
    no_face = 1.0 - face.sum(0, keepdim=True)
    no_dpad = 1.0 - arrows.sum(0, keepdim=True) - l3
    left_stick = rows[20:22].clamp(-1.0, 1.0) * left_joystick
    right_stick = rows[22:24].clamp(-1.0, 1.0) * right_joystick
    return torch.cat([no_face, face, no_dpad, arrows, l3, rows[10:20], left_stick, right_stick])


def canonical(action: Tensor) -> Tensor:
    """Return the action that the game uses; the operation is idempotent.

    The mode heads decide where the thumbs are. Buttons out of their reach become "none", and a stick without a thumb
    becomes 0.

    Args:
        action: Actions `(..., 24)` of exact one-hots and axes.

    Returns:
        Canonical actions `(..., 24)`.
    """
    return canonical_rows(action.movedim(-1, 0)).movedim(0, -1)


def read_pad(rows: Tensor) -> Pad:
    """Name the rows of a canonical action `(24, ...)`."""
    names = (
        *("face.cross", "face.circle", "face.square", "dpad.up", "dpad.down", "dpad.left", "dpad.right", "dpad.L3"),
        *("left_shoulder.L1", "left_shoulder.L2", "right_shoulder.R1", "right_shoulder.R2"),
    )
    return Pad(*(rows[_ROWS[name]] for name in names), left_stick=rows[20:22], right_stick=rows[22:24])


def press(*buttons: str, left: tuple[float, float] | None = None, right: tuple[float, float] | None = None) -> Tensor:
    """Return an action `(24,)` from names of buttons, for scripts and tests.

    Args:
        *buttons: Names in `HEADS`, such as "cross", "L1", "up".
        left: x and y of the left stick, which put its thumb on the stick, as L3 does. By default it is on the buttons.
        right: x and y of the right stick, likewise.

    Raises:
        ValueError: If a name is unknown or the hand cannot press this combination.

    Example:
        >>> describe(press("L2", "R2", left=(0.0, 1.0), right=(0.5, 0.0)))
        'L2 R2 | left stick (+0.00, +1.00) | right stick (+0.50, +0.00)'
    """
    modes = {
        "left_mode": "joystick" if left is not None or "L3" in buttons else "buttons",
        "right_mode": "joystick" if right is not None else "buttons",
    }
    choice: dict[str, str] = dict.fromkeys(HEADS, "none") | modes
    for button in buttons:
        heads = [head for head, values in HEADS.items() if button in values and button != "none" and "mode" not in head]
        if not heads:
            raise ValueError(f"unknown button {button!r}: expected some of {[v for h in HEADS.values() for v in h]}")
        if choice[heads[0]] != "none":
            raise ValueError(f"{choice[heads[0]]} and {button} share a finger: press one of them")
        choice[heads[0]] = button
    if not _legal(choice["face"], choice["dpad"], choice["left_mode"], choice["right_mode"]):
        raise ValueError(f"the virtual hand cannot press {buttons} with left stick {left} and right stick {right}")
    indices = torch.tensor([HEADS[head].index(value) for head, value in choice.items()])
    return GAMEPAD.from_choices(indices, torch.tensor([*(left or (0.0, 0.0)), *(right or (0.0, 0.0))]))


def describe(action: Tensor) -> str:
    """Describe an action in words.

    Args:
        action: Raw or canonical action `(24,)`.

    Raises:
        ValueError: If it is not a single action.

    Example:
        >>> describe(press("L1", right=(0.0, 1.0)))
        'L1 | right stick (+0.00, +1.00)'
    """
    if tuple(action.shape) != (GAMEPAD.action_dim,):
        raise ValueError(f"expected one action of shape ({GAMEPAD.action_dim},), got {tuple(action.shape)}")
    action = canonical(action)
    names: list[str] = [values[int(i)] for values, i in zip(HEADS.values(), GAMEPAD.choices(action), strict=True)]
    face, dpad, left_shoulder, right_shoulder, left_mode, right_mode = names
    pressed = [_SYMBOLS.get(n, n) for n in (left_shoulder, right_shoulder, dpad, face) if n != "none"]
    parts = [" ".join(pressed)] if pressed else []
    for side, mode, first in (("left", left_mode, 20), ("right", right_mode, 22)):
        if mode == "joystick":
            x, y = action[first : first + 2].tolist()
            parts.append(f"{side} stick ({x + 0.0:+.2f}, {y + 0.0:+.2f})")
    return " | ".join(parts) or "nothing"
