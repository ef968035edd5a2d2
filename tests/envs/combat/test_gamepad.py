"""The gamepad: 864 raw combinations are 315 legal ones (paper), each reached and read as it should be."""

from itertools import product

import pytest
import torch

from coachable.envs.combat.gamepad import GAMEPAD, HEADS, WheelDirection, canonical_rows, read_pad
from tests.envs.combat.pressing import press


def canonical(action):
    return canonical_rows(action.movedim(-1, 0)).movedim(0, -1)


def all_raw() -> torch.Tensor:
    """Every raw combination (864, 24) with both sticks pushed."""
    choices = torch.tensor(list(product(*(range(len(values)) for values in HEADS.values()))))
    return GAMEPAD.from_choices(choices, torch.full((len(choices), 4), 0.5))


def test_864_raw_combinations_are_315_legal_ones():
    raw = all_raw()
    legal, counts = torch.unique(canonical(raw), dim=0, return_counts=True)
    assert (len(raw), len(legal)) == (864, 315)
    assert (counts.min(), counts.max()) == (1, 20)


def test_216_sets_of_pressed_buttons():
    assert len(torch.unique(canonical(all_raw())[:, :16], dim=0)) == 216  # four button heads, thumbs left out


def test_canonical_is_idempotent_and_still_a_valid_action():
    raw = all_raw()
    once = canonical(raw)
    assert torch.equal(canonical(once), once)
    assert GAMEPAD.spec((864,)).is_in(once)
    assert torch.equal(canonical(raw.reshape(4, 216, 24)), once.reshape(4, 216, 24))


def test_the_virtual_hand_holds_in_every_combination():
    pad = read_pad(canonical_rows(all_raw().T))
    left, right = pad.left_stick.abs().amax(0) > 0, pad.right_stick.abs().amax(0) > 0
    arrows = pad.up + pad.down + pad.left + pad.right
    assert not (left & (arrows > 0)).any()
    assert not (right & (pad.cross + pad.circle + pad.square > 0)).any()
    assert not (~left & (pad.l3 > 0)).any()
    for pair in ((pad.l1, pad.l2), (pad.r1, pad.r2)):
        assert (pair[0] + pair[1]).max() == 1


def test_sticks_pass_through_while_their_thumb_is_on_them():
    action = press("L3", left=(0.25, -1.0), right=(1.0, 0.0))
    assert canonical(action)[20:].tolist() == [0.25, -1.0, 1.0, 0.0]
    resting = action.clone()
    resting[16:20] = torch.tensor([1.0, 0.0, 1.0, 0.0])  # both thumbs on the buttons
    assert canonical(resting)[20:].tolist() == [0.0, 0.0, 0.0, 0.0]
    assert canonical(resting)[9] == 0.0  # L3 is out of reach, too


def test_a_stick_cannot_be_pushed_beyond_its_rim():
    action = press("L3", left=(0.5, 0.5), right=(0.5, 0.5))
    action[20:] = torch.tensor([1.5, -1.7, 1.9, -1.2])
    assert canonical(action)[20:].tolist() == [1.0, -1.0, 1.0, -1.0]
    pad = read_pad(canonical_rows(action[:, None]))
    assert (pad.left_stick[:, 0].tolist(), pad.right_stick[:, 0].tolist()) == ([1.0, -1.0], [1.0, -1.0])


def test_the_direction_on_the_wheel_as_harmonics():
    angle = torch.linspace(-3.0, 3.0, 50)
    actions = torch.stack([press("L1", right=(x, y)) for x, y in zip(angle.cos(), angle.sin(), strict=True)])
    harmonics = WheelDirection(4)(actions)
    assert harmonics.shape == (50, 8)
    orders = torch.arange(1, 5)
    turned = orders * angle[:, None]
    expected = torch.stack((turned.cos(), turned.sin()), -1) * 1.01 ** (-0.5 * orders[:, None])
    torch.testing.assert_close(harmonics, expected.flatten(-2))


def test_no_direction_without_the_wheel_or_with_the_thumb_on_the_buttons():
    stick = (0.6, -0.8)
    assert WheelDirection()(press("L1", right=stick)).abs().min() > 0
    thumb_up = torch.cat((press("L1")[:-2], torch.tensor(stick)))
    for action in (press(right=stick), press("L2", right=stick), thumb_up):
        assert WheelDirection()(action).abs().max() == 0


def test_the_direction_on_the_wheel_is_differentiable_at_rest():
    action = GAMEPAD.from_choices(torch.zeros(1, 6, dtype=torch.long), torch.zeros(1, 4))
    action[:, [11, 19]] = 0.5  # as in relaxed actions
    action.requires_grad_()
    (gradient,) = torch.autograd.grad(WheelDirection()(action).sum(), action)
    assert gradient.isfinite().all()
    assert gradient[0, 22] > 0
    with pytest.raises(ValueError, match="orders of WheelDirection"):
        WheelDirection(0)
