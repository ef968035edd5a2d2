"""Actions of the gamepad from names of buttons."""

import torch

from coachable.envs.combat.gamepad import GAMEPAD, HEADS


def press(*buttons, left=None, right=None):
    """Action (24,) of buttons such as "cross" or "L1", and of sticks (x, y); a stick that is given has its thumb."""
    modes = {
        "left_mode": "joystick" if left is not None or "L3" in buttons else "buttons",
        "right_mode": "joystick" if right is not None else "buttons",
    }
    choice = dict.fromkeys(HEADS, "none") | modes
    for button in buttons:
        [head] = [head for head, values in HEADS.items() if button in values]
        assert choice[head] == "none", f"{choice[head]} and {button} share a finger"
        choice[head] = button
    indices = torch.tensor([HEADS[head].index(value) for head, value in choice.items()])
    return GAMEPAD.from_choices(indices, torch.tensor([*(left or (0.0, 0.0)), *(right or (0.0, 0.0))]))
