"""Rules of the player's tools, camera and stamina in closed form: one still machine, one scripted pad."""

import math

import pytest
import torch

from coachable.envs.combat import constants as c
from coachable.envs.combat.damage import BURNING, FROST
from coachable.envs.combat.tables import ELEMENTS, MACHINES, resistance
from tests.envs.combat.pressing import press
from tests.envs.combat.still_fight import NOTHING, SHOOT, act, aim_at_body, hold, part, still_fight


def test_a_berry_heals_and_takes_time():
    env = still_fight()
    env.state.hp -= 300.0
    act(env, *[press("up")] * 4)  # once: 0.8 s
    assert env.state.hp.item() == 505.0
    act(env, *[press("up")] * 8)
    assert env.state.hp.item() == 700.0
    assert env.state.berries.item() == 11.0
    act(env, *[press("up")] * 5)
    assert env.state.berries.item() == 11.0  # not at full health


@pytest.mark.parametrize("tool", range(4))
def test_traps_fire_when_a_machine_is_near_and_count_as_trap_damage(tool):
    env = still_fight("Grimhorn", 6.0)
    s = env.state
    s.tool = s.tool + tool
    components, _ = act(env, press("down"), *[NOTHING] * 5)
    assert part(components, "damage").sum().item() == 0
    assert s.inventory[tool].item() == 9
    s.enemy_position[0] = 1.2 + 1.8 + 1.5  # within R + 1.6 m
    components, _ = act(env, NOTHING)
    element = ("acid", "purgewater", "shock", None)[tool]
    factor = resistance(MACHINES["Grimhorn"])[ELEMENTS.index(element)] if element else 0.0
    expected = 60 * factor if element else 130
    # The acid trap fills the gauge of this machine, and what burns counts for it, too.
    assert part(components, "trap_damage").item() == pytest.approx(expected, abs=2.0 if element == "acid" else 1e-3)
    assert (s.trap_type == -1).all()
    assert s.hp.item() == c.PLAYER_HP - c.TRAP_SELF_DAMAGE  # it stood within 2.5 m
    if element:
        gain = 70 * factor / (45 + 1.6 * math.sqrt(1800))
        assert part(components, "buildup")[..., ELEMENTS.index(element)].item() == pytest.approx(
            min(gain, 1.0), abs=5e-3
        )


def test_lure_and_proximity_sum_to_the_last_closeness():
    env = still_fight("Grimhorn", 6.0)
    components, _ = act(env, press("down"), *[press(left=(0.0, -1.0))] * 8)
    for row, name in enumerate(("lure", "proximity")):
        assert part(components, name).sum().item() == pytest.approx(env.state.closeness[row].item(), abs=1e-5)
    assert env.state.closeness[0].item() == pytest.approx(1 - 4.8 / 8)


def test_firing_a_trap_costs_no_closeness():
    env = still_fight("Grimhorn", 6.0)
    act(env, press("down"), *[NOTHING] * 5)
    env.state.enemy_position[0] = 4.0
    components, _ = act(env, NOTHING, NOTHING)
    assert part(components, "lure")[:, 0, 0].tolist() == pytest.approx([(6.0 - 4.0) / 8, 0.0], abs=1e-5)


def test_the_stick_turns_the_camera_by_its_exponent():
    for x in (1.0, 0.5, -0.25):
        env = still_fight(assist="off")
        act(env, press(right=(x, x)))
        turned = 3.8 * 0.2 * abs(x) ** 1.7 * math.copysign(1.0, x)
        assert env.state.yaw.item() == pytest.approx(-turned, rel=1e-4)
        assert env.state.pitch.item() == pytest.approx(0.6 * turned, rel=1e-4)


@pytest.mark.parametrize(("assist", "left"), [("off", 1.0), ("full", 0.88**6), ("small", 0.7**6)])
def test_the_assist_takes_a_share_of_the_error_per_frame(assist, left):
    env = still_fight(assist=assist)
    env.state.yaw += 0.2
    act(env, press("L2"))
    assert env.state.yaw.item() == pytest.approx(0.2 * left, rel=1e-3)


def test_the_anchor_moves_only_while_the_player_nears_the_machine():
    env = still_fight("Ravager", 12.0)
    act(env, *[press(left=(0.0, 1.0))] * 3)
    torch.testing.assert_close(env.state.anchor, env.state.position)
    kept = env.state.anchor.clone()
    act(env, *[press(left=(0.0, -1.0))] * 6)
    assert torch.equal(env.state.anchor, kept)
    env.state.position[0] = kept[0] - 30.5
    components, after = act(env, NOTHING)
    assert part(components, "out_of_bounds").item() == 1.0
    assert after["terminated"].item()
    # Out of bounds and off screen by nothing else: the penalty is the paper's.
    assert after["task_reward"].item() == pytest.approx(-500.0 - part(components, "off_screen").item())


def test_smoothness_and_off_screen_reach_the_papers_ends():
    env = still_fight("Ravager", 12.0, assist="off")
    flip = [press(right=(s, s)) for s in (1.0, -1.0, 1.0)]
    components, _ = act(env, *flip)
    assert part(components, "smoothness")[:, 0, 0].tolist() == pytest.approx([2**0.5, 18**0.5, 4 * 2**0.5])
    env.state.yaw, env.state.pitch = torch.full((1,), math.pi), torch.zeros(1)
    env.state.enemy_z += c.EYE_HEIGHT - 1.4  # level with the eye
    env.traits.height = env.traits.height + c.EYE_HEIGHT - 1.4
    components, _ = act(env, NOTHING)
    assert part(components, "off_screen").item() == pytest.approx(1.87, abs=5e-3)


def test_selecting_elemental_ammo_changes_the_indicator_by_two():
    env = still_fight()
    hold(env, "Carja's Bane")
    angle = math.radians(60.0 * 1 + 45.0)  # its second section: fire
    components, _ = act(env, press("L1", right=(math.cos(angle), math.sin(angle))), NOTHING)
    assert part(components, "ammo_change")[:, 0, BURNING].tolist() == [2.0, 0.0]
    components, _ = act(env, press("L1", right=(math.cos(0.1), math.sin(0.1))))  # Icestorm, frost
    change = part(components, "ammo_change")[0, 0]
    assert (change[BURNING].item(), change[FROST].item()) == (-2.0, 2.0)


def test_zones_burn_and_pillars_stop_arrows():
    env = still_fight()
    env.state.hazard_timer[0] = 120.0
    act(env, *[NOTHING] * 5)
    assert env.state.hp.item() == pytest.approx(700.0 - 10.0, rel=1e-3)
    behind = still_fight("Ravager", 12.0, assist="off")
    behind.assign(["Ravager"], ["Shining-wastes"])
    behind.state.site = behind.state.site * 0 + 1
    behind._look_up()
    behind.traits.speed = torch.zeros_like(behind.traits.speed)
    hold(behind, "Sunscourge")
    behind.state.position = torch.tensor([[6.0], [6.0]])
    behind.state.enemy_position = torch.tensor([[18.0], [18.0]]).unsqueeze(1)
    aim_at_body(behind)
    components, _ = act(behind, SHOOT)
    assert part(components, "damage").item() == 0.0
    behind.state.position = torch.tensor([[18.0], [6.0]])
    aim_at_body(behind)
    components, _ = act(behind, *[SHOOT] * 6)
    assert part(components, "damage").sum().item() > 0.0


def test_stamina_pays_for_dodges_and_sprints():
    env = still_fight("Ravager", 20.0)
    act(env, press("square", left=(-1.0, 0.0)))
    assert env.state.stamina.item() == pytest.approx(100 - 20 + 14 * 0.2, rel=1e-4)
    assert env.state.position[1].item() == pytest.approx(10 * 0.2, rel=1e-3)
    sprinting = still_fight("Ravager", 30.0)
    act(sprinting, *[press("L3", left=(0.0, -1.0))] * 10)
    assert sprinting.state.stamina.item() == pytest.approx(100 - 6 * 2.0, rel=1e-3)
    assert sprinting.state.velocity[0].item() == pytest.approx(-8.0, rel=1e-3)
