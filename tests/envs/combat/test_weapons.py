"""Rules of shots and swings in closed form: one still machine, one scripted pad."""

import math

import pytest
import torch

from coachable.envs.combat import constants as c
from coachable.envs.combat.state import AIR, DODGE, MELEE, SLIDE
from coachable.envs.combat.tables import ALL_MACHINES, AMMO, ELEMENTS, WEAPONS, load_table, resistance
from tests.envs.combat.pressing import press
from tests.envs.combat.still_fight import SHOOT, act, aim_at_body, hold, part, still_fight


@pytest.mark.parametrize(("weapon", "section"), [(w, i) for w, names in enumerate(AMMO) for i in range(len(names))])
def test_every_ammo_is_selected_in_one_step_and_the_camera_rests(weapon, section):
    env = still_fight()
    hold(env, WEAPONS[(weapon + 1) % 6])
    angle = math.radians(60.0 * (weapon + (section + 0.5) / len(AMMO[weapon])))
    components, _ = act(env, press("L1", right=(math.cos(angle), math.sin(angle))))
    assert (env.state.weapon.item(), env.state.section.item()) == (weapon, section)
    assert (env.state.yaw.item(), env.state.pitch.item()) == (0.0, 0.0)
    assert part(components, "wheel").item() == 1.0


@pytest.mark.parametrize("machine", ["Widemaw", "Apex Thunderjaw"])
@pytest.mark.parametrize(("weapon", "section"), [(w, i) for w, names in enumerate(AMMO) for i in range(len(names))])
def test_one_shot_does_impact_and_resisted_elemental_damage_and_builds_up(machine, weapon, section):
    env = still_fight(machine)
    hold(env, WEAPONS[weapon], section)
    aim_at_body(env)
    row, table = AMMO[weapon][section], load_table("weapons")
    element = table.rows[row]["element"]
    shots = math.ceil(6 / max(1, math.ceil(table.number(row, "interval") * 30)))  # within one step
    factor = resistance(ALL_MACHINES[machine])[ELEMENTS.index(element)] if element else 1.0
    damage = table.number(row, "impact") + table.number(row, "elemental") * factor
    components, _ = act(env, SHOOT)
    assert part(components, "damage").item() == pytest.approx(shots * damage, rel=1e-4)
    assert part(components, "weapon_damage")[0, 0, weapon].item() == pytest.approx(shots * damage, rel=1e-4)
    if element:
        threshold = 45 + 1.6 * math.sqrt(ALL_MACHINES[machine].hp)
        gain = shots * table.number(row, "buildup") * factor / threshold
        found = part(components, "buildup")[0, 0, ELEMENTS.index(element)].item()
        assert found == pytest.approx(gain, abs=0.02 * 0.2 + 1e-4)


def test_a_magazine_empties_and_reloads_by_itself():
    env = still_fight("Slaughterspine")
    hold(env, "Carja's Bane")
    aim_at_body(env)
    # A shot every 17 frames (0.55 s); the eighth empties the magazine, 48 frames later it is full again.
    components, _ = act(env, *[SHOOT] * 31)
    assert part(components, "damage").sum().item() == 20 * (8 + 1 + (31 * 6 - 1 - (7 * 17 + 48)) // 17)


def test_the_technique_doubles_one_shot():
    env = still_fight("Slaughterspine")
    hold(env, "Skykiller")
    aim_at_body(env)
    components, _ = act(env, press("L2", "R1"), *[SHOOT] * 10)
    assert env.state.weapon_stamina.item() == pytest.approx(50 + 4 * 11 * 0.2, abs=0.1)
    assert part(components, "damage").sum().item() == pytest.approx(300 + 150)


def test_nothing_is_hit_beyond_the_range_or_beside_the_body():
    for distance, yaw in ((41.5, 0.0), (12.0, 0.2)):
        env = still_fight("Ravager", distance, assist="off")
        hold(env, "Carja's Bane")
        aim_at_body(env)
        env.state.yaw += yaw
        components, _ = act(env, SHOOT)
        assert part(components, "damage").item() == 0.0


def test_overkill_is_clipped_before_it_is_attributed():
    env = still_fight("Burrower")
    hold(env, "Skykiller")
    aim_at_body(env)
    components, after = act(env, SHOOT)
    assert part(components, "damage").item() == 95.0
    assert part(components, "weapon_damage").sum().item() == 95.0
    assert after["terminated"].item()


def test_a_fight_ends_with_the_first_who_falls():
    """In the frames that the step has left, a shot in flight hurts no winner, and a dead player does not strike."""
    for hp, machine_hp, landing, swing in ((10.0, 5.0, 4.0, 0.0), (10.0, 90.0, 1.0, 3.0)):
        env = still_fight("Ravager", 1.5)
        s = env.state
        s.hp, s.enemy_hp[0] = torch.full_like(s.hp, hp), machine_hp
        s.land_timer[0], s.shot_damage[0] = landing, 50.0
        s.timers[MELEE] = swing
        components, after = act(env, press("R1"))
        won = landing > 1.0
        assert (part(components, "death").item(), part(components, "damage").item() > 0) == (0.0 if won else 1.0, won)
        assert after["terminated"].item()


def test_the_dead_do_nothing():
    """Eight players: one each eats, sets a trap, dodges, slides, jumps, swings, swings hard, and shoots."""
    pads = [press(button) for button in ("up", "down", "square", "circle", "cross", "R1", "R2")]
    for hp in (400.0, 0.0):
        env = still_fight("Ravager", 3.0, num_envs=8)
        s = env.state
        s.hp = torch.full_like(s.hp, hp)
        hold(env, "Carja's Bane")
        aim_at_body(env)
        components, _ = act(env, torch.stack([*pads, SHOOT]))
        started = torch.stack((c.BERRIES - s.berries, s.trap_type.amax(0) + 1, *s.timers[[DODGE, SLIDE, AIR]])) > 0
        did = [*started.diagonal().tolist(), *(part(components, "damage")[0, 5:, 0] > 0).tolist()]
        assert did == [hp > 0.0] * 8
        assert (s.hp > 0).tolist() == [hp > 0.0] * 8


def test_light_swings_hit_every_13_frames():
    env = still_fight("Ravager", 3.0)
    components, _ = act(env, *[press("R1")] * 10)
    assert part(components, "melee_damage").sum().item() == 5 * 12.0
    heavy = still_fight("Ravager", 3.0)
    components, _ = act(heavy, *[press("R2")] * 10)  # every 29 frames
    assert part(components, "melee_damage").sum().item() == 3 * 30.0


def test_a_swing_lunges_to_a_near_machine_and_not_at_one_behind():
    env = still_fight("Ravager", 5.0)
    act(env, press("R1"))
    assert env.state.position[0].item() == pytest.approx(1.6)
    behind = still_fight("Ravager", 5.0)
    behind.state.yaw += math.pi
    components, _ = act(behind, press("R1"))
    assert behind.state.position.abs().max().item() == 0.0
    assert part(components, "damage").item() == 0.0
