"""PlayStation-like gamepad with policy heads, and the constraints of a virtual hand.

An action is one tensor `(..., 24)` of the one-hots of six heads and the four stick axes (paper, Table "Policy head
outputs"). The 864 raw combinations of the heads have 315 different meanings, because a thumb is either on its stick or
on its buttons. `canonical_rows` maps every raw action to the one that the game uses.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from coachable.distributions.action_heads import ActionHeads
from coachable.ranges import COUNT
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

_ROWS: dict[str, int] = {}  # "face.cross": 1, ... rows of the transposed action tensor
for _head, _values in HEADS.items():
    for _value in _values:
        _ROWS[f"{_head}.{_value}"] = len(_ROWS)


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
    """Return the actions that the game uses; the operation is idempotent.

    The mode heads decide where the thumbs are. Buttons out of their reach become "none", and a stick without a thumb
    becomes 0.

    Args:
        rows: Actions of exact one-hots and axes, whose components come first, `(24, ...)`.

    Returns:
        Canonical actions `(24, ...)`.
    """
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


def read_pad(rows: Tensor) -> Pad:
    """Name the rows of a canonical action `(24, ...)`."""
    names = (
        *("face.cross", "face.circle", "face.square", "dpad.up", "dpad.down", "dpad.left", "dpad.right", "dpad.L3"),
        *("left_shoulder.L1", "left_shoulder.L2", "right_shoulder.R1", "right_shoulder.R2"),
    )
    return Pad(*(rows[_ROWS[name]] for name in names), left_stick=rows[20:22], right_stick=rows[22:24])


class WheelDirection:
    """Features for critics (ours): where the right stick points on the weapon wheel, while L1 keeps the wheel open.

    One of 17 kinds of ammunition takes 20 or 30 degrees of the wheel. From the stick's two axes alone a critic learns
    late that its value changes there. The features are `L1 Re(z^k)` and `L1 Im(z^k)` for k = 1..K with
    `z = (x + iy) / sqrt(x^2 + y^2 + 0.01)`, where the stick counts as (0, 0) while its thumb is on the buttons. They
    are defined and differentiable for relaxed actions, too.

    Args:
        orders: K; the highest order tells directions half a period, 180 / K degrees, apart.

    Raises:
        ValueError: If `orders` is not positive.

    Example:
        >>> action = torch.zeros(24)
        >>> action[[11, 19, 23]] = 1.0  # L1, thumb on the joystick, upwards
        >>> [round(value, 1) for value in WheelDirection(2)(action).tolist()]
        [0.0, 1.0, -1.0, 0.0]
    """

    def __init__(self, orders: int = 9) -> None:
        COUNT.check("orders of WheelDirection", orders)
        self.width = 2 * orders

    def __call__(self, action: Tensor) -> Tensor:
        """Return the features `(..., 2 K)` of actions `(..., 24)`."""
        open_, mode = action[..., _ROWS["left_shoulder.L1"]], action[..., _ROWS["right_mode.joystick"]]
        x, y = (action[..., -2:] * mode.unsqueeze(-1)).unbind(-1)
        shrink = (x.square() + y.square() + 0.01).rsqrt()
        x, y = x * shrink, y * shrink
        powers = [(x, y)]
        for _ in range(self.width // 2 - 1):
            real, imaginary = powers[-1]
            powers.append((real * x - imaginary * y, real * y + imaginary * x))
        return torch.stack([part for power in powers for part in power], -1) * open_.unsqueeze(-1)
