"""Rules of the fight in closed form: one still machine, one scripted pad."""

import math

import pytest
import torch
from tensordict import TensorDict

from coachable.envs.combat import CombatEnv
from coachable.envs.combat import constants as c
from coachable.envs.combat.damage import ACID, BURNING, FROST, PLASMA, SHOCK, Totals, damage_parts
from coachable.envs.combat.gamepad import press
from coachable.envs.combat.rewards import COMPONENT_SLICES
from coachable.envs.combat.state import ACTIVE, AIR, DODGE, IDLE, RECOVER, SAFE, SLIDE, STAGGER, STAGGERED, TELEGRAPH
from coachable.envs.combat.tables import ALL_MACHINES, AMMO, ELEMENTS, MACHINES, WEAPONS, load_table, resistance
from coachable.envs.combat.traits import DAMAGE, KIND, MACHINE_NAMES, SPREAD

NOTHING = press()
NEVER = 1e6  # frames


def still_fight(machine="Ravager", distance=12.0, num_envs=1, parts=False, **options):
    """The machine neither moves nor attacks, straight ahead of the player at the centre; arrows fly straight."""
    env = CombatEnv(num_envs, seed=0, machines=[machine], sites=["Ice-lake"], components=True, **options)
    env.reset()
    s, one = env.state, torch.ones(num_envs)
    s.position, s.velocity = torch.zeros(2, num_envs), torch.zeros(2, num_envs)
    s.anchor, s.distance = s.position.clone(), distance * one
    s.yaw, s.pitch = 0.0 * one, 0.0 * one
    s.enemy_position = torch.stack((distance * one, 0.0 * one)).unsqueeze(1).repeat(1, env.num_enemies, 1)
    s.enemy_yaw = torch.full_like(s.enemy_yaw, math.pi)
    s.enemy_velocity = torch.zeros_like(s.enemy_velocity)
    s.pause = torch.full_like(s.pause, NEVER)
    if not parts:
        s.count = torch.zeros_like(s.count)
    env.traits.speed = torch.zeros_like(env.traits.speed)
    env._ammo[:, SPREAD] = 0.0
    return env


def hold(env, weapon, section=0):
    env.state.weapon = torch.full_like(env.state.weapon, WEAPONS.index(weapon))
    env.state.section = torch.full_like(env.state.section, section)


def aim_at_body(env):
    """Camera at the centre of the first machine's body."""
    s = env.state
    x, y = s.enemy_position[:, 0] - s.position
    rise = s.enemy_z[0] + env.traits.radius[0] - c.EYE_HEIGHT
    s.yaw, s.pitch = torch.atan2(y, x), torch.atan2(rise, (x * x + y * y).sqrt())


def act(env, *actions):
    """Components of each step, (steps, N, 44), and the last transition's `next`."""
    seen, after = [], None
    for action in actions:
        td = TensorDict({"action": action.expand(env.num_envs, 24).clone()}, [env.num_envs])
        after = env._step(td)
        seen.append(after["components"])
    return torch.stack(seen), after


def part(components, name):
    return components[..., COMPONENT_SLICES[name]]


SHOOT = press("L2", "R2")


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


@pytest.mark.parametrize(("element", "rate", "seconds"), [(ACID, 5, 4), (BURNING, 9, 3)])
def test_damage_over_time_counts_for_the_state_and_for_its_source(element, rate, seconds):
    env = still_fight("Grimhorn")  # weak to acid, strong to fire
    env.state.state_timer[element] = seconds * 30.0
    env.state.source[element] = WEAPONS.index("Sunscourge")
    components, _ = act(env, *[NOTHING] * (seconds * 5 + 3))
    factor = resistance(MACHINES["Grimhorn"])[element]
    assert part(components, "damage").sum().item() == pytest.approx(rate * seconds * factor, rel=1e-3)
    assert part(components, "state_damage")[..., element].sum().item() == pytest.approx(
        rate * seconds * factor, rel=1e-3
    )
    assert part(components, "weapon_damage")[..., WEAPONS.index("Sunscourge")].sum().item() == pytest.approx(
        rate * seconds * factor, rel=1e-3
    )


def test_plasma_stores_35_percent_and_releases_it_at_the_end():
    env = still_fight("Slaughterspine")
    hold(env, "Skykiller", 1)
    aim_at_body(env)
    env.state.state_timer[PLASMA] = 30.0
    env.state.source[PLASMA] = WEAPONS.index("Icestorm")
    components, _ = act(env, SHOOT, *[NOTHING] * 5)
    assert part(components, "damage")[:, 0, 0].tolist() == pytest.approx([110, 0, 0, 0, 0.35 * 110, 0])
    assert part(components, "state_damage")[..., PLASMA].sum().item() == pytest.approx(1.35 * 110)
    assert part(components, "weapon_damage")[..., WEAPONS.index("Icestorm")].sum().item() == pytest.approx(0.35 * 110)


@pytest.mark.parametrize(("element", "factor"), [(FROST, 1.6), (ACID, 1.2)])
def test_frost_and_acid_multiply_hits(element, factor):
    env = still_fight("Slaughterspine")
    hold(env, "Carja's Bane")
    aim_at_body(env)
    env.state.state_timer[element] = 300.0
    components, _ = act(env, SHOOT)
    over_time = 5 * 0.2 * 0.5 if element == ACID else 0.0  # strong to acid
    assert part(components, "damage").item() == pytest.approx(20 * factor + over_time, rel=1e-4)


def test_a_full_gauge_starts_the_state_once_and_shock_gets_harder():
    env = still_fight("Snapmaw")  # weak to shock
    env.state.gauge[SHOCK] = 0.99
    hold(env, "Icestorm", 2)
    aim_at_body(env)
    act(env, SHOOT)
    assert env.state.gauge[SHOCK].item() == 0.0
    assert env.state.shock_growth.item() == pytest.approx(1.6)
    assert 200 < env.state.state_timer[SHOCK].item() <= 210
    assert env.state.phase.item() == STAGGERED
    components, _ = act(env, SHOOT)
    assert part(components, "buildup")[..., SHOCK].item() == 0.0  # none while the state lasts
    act(env, *[NOTHING] * 34)
    assert env.state.phase.item() == IDLE


def test_build_up_to_the_trigger_and_decay_are_counted_and_the_reset_is_not():
    env = still_fight("Ravager")
    env.state.gauge[ACID] = 0.5
    components, _ = act(env, NOTHING)
    assert part(components, "buildup")[..., ACID].item() == pytest.approx(-0.02 * 0.2, rel=1e-3)
    env.state.gauge[ACID] = 0.9
    hold(env, "Corrosive Blastsling")
    aim_at_body(env)
    components, _ = act(env, SHOOT)
    assert part(components, "buildup")[..., ACID].item() == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("machine", list(MACHINES))
def test_destroying_everything_removes_exactly_the_machines_parts(machine):
    env = still_fight(machine, parts=True)
    totals, bursts = Totals.zeros(env.state.enemy_hp, 12), 0
    for _ in range(20):
        bursts += damage_parts(env.state, env.traits, torch.full_like(env.state.count, 1e6), totals).item()
    removed = (env.traits.part_type * totals.removed).sum((1, 2, 3))
    assert tuple(removed.int().tolist()) == MACHINES[machine].parts
    assert env.state.count.abs().max().item() == 0
    dealt = (env.traits.units * env.traits.unit_hp).sum().item()
    assert totals.part_dealt.sum().item() == pytest.approx(dealt, rel=1e-5)
    assert bursts <= 20  # once per shot, however many canisters go


def test_a_shot_at_a_part_does_body_and_tear_damage():
    env = still_fight("Ravager", 12.0, parts=True)
    hold(env, "Carja's Bane")
    s, slot = env.state, 1  # the weapon part
    s.count = torch.zeros_like(s.count).index_fill(0, torch.tensor([slot]), 1.0)
    x, y, z = env.traits.offset[:, slot, 0, 0].tolist()
    s.enemy_yaw = torch.full_like(s.enemy_yaw, math.pi - math.atan2(y, x))  # the part faces the player
    reach = 12.0 - math.hypot(x, y)
    s.pitch = torch.full_like(s.pitch, math.atan2(z + 1.4 - c.EYE_HEIGHT, reach))
    env.rules.assist = c.ASSIST["off"]
    env.traits.speed = torch.zeros_like(env.traits.speed)
    s.phase, s.phase_timer = s.phase + STAGGERED, s.phase_timer + NEVER  # does not turn
    components, _ = act(env, SHOOT)
    assert part(components, "part_damage")[0, 0].tolist() == pytest.approx([0, 20 + 1.5 * 4, 0])
    assert part(components, "damage").item() == pytest.approx(20)


def test_no_weapon_parts_no_ranged_attack():
    env = CombatEnv(512, seed=0, machines=["Ravager", "Slaughterspine"], sites=["Arena"])
    env.reset()
    env.state.count = env.state.count * (1.0 - env.traits.part_type[1])
    kinds = set()
    for _ in range(30):
        act_plain(env, NOTHING)
        kind = env.traits.attacks[KIND].gather(0, env.state.attack.unsqueeze(0))[0]
        kinds |= set(kind[env.state.phase == ACTIVE].int().tolist())
    assert 2 not in kinds
    assert kinds


def act_plain(env, action):
    return env._step(TensorDict({"action": action.expand(env.num_envs, 24).clone()}, [env.num_envs]))


def test_flyers_dive_and_shoot_only_and_come_down_to_dive():
    env = CombatEnv(256, seed=0, machines=["Sunwing"], sites=["Arena"])
    env.reset()
    kinds, low = set(), 0
    for _ in range(30):
        act_plain(env, NOTHING)
        kind = env.traits.attacks[KIND].gather(0, env.state.attack.unsqueeze(0))[0]
        active = env.state.phase == ACTIVE
        kinds |= set(kind[active].int().tolist())
        low += int((env.state.enemy_z[active & (kind == 1)] < 1e-3).sum())
    assert kinds == {1, 2}
    assert low > 0
    assert env.state.enemy_z.max().item() <= 6.0


def test_hidden_attacks_never_show_an_id_and_others_do():
    env = CombatEnv(512, seed=0, sites=["Arena"], observation="small")
    env.reset()
    names = dict(zip(MACHINE_NAMES, ALL_MACHINES.values(), strict=True))
    assert len(names) == 22
    first = 48 + 7 + 16 + 13 + 2 + 7 + 14 + 5 + 1  # of the attack id
    shown = 0
    for _ in range(20):
        observation = act_plain(env, NOTHING)["observation"]
        kind = env.traits.attacks[KIND].gather(0, env.state.attack.unsqueeze(0))[0, 0]
        ids = observation[:, first : first + 4]
        attacking = (env.state.phase[0] > IDLE) & (env.state.phase[0] < STAGGERED)
        assert ids[attacking & (kind == 2)].abs().sum().item() == 0
        assert ids[~attacking].abs().sum().item() == 0
        shown += int(ids.sum())
    assert shown > 0


@pytest.mark.parametrize("machine", ["Burrower", "Slaughterspine"])
def test_a_bite_hits_once_hurts_as_the_table_says_and_a_dodge_avoids_it(machine):
    for dodging in (False, True):
        env = still_fight(machine, ALL_MACHINES[machine].radius + 1.0)
        s = env.state
        s.phase, s.attack = torch.full_like(s.phase, ACTIVE), torch.zeros_like(s.attack)
        s.phase_timer, s.hits_left = torch.full_like(s.phase_timer, 4.0), torch.ones_like(s.hits_left)
        s.lock = torch.stack((-torch.ones_like(s.pause), torch.zeros_like(s.pause)))
        act(env, press("square", left=(1.0, 0.0)) if dodging else NOTHING)
        lost = c.PLAYER_HP - s.hp.item()
        if dodging:
            assert lost == 0.0
        else:
            hit = ALL_MACHINES[machine].hit * env.traits.attacks[DAMAGE, 0].item()
            assert 0.85 * hit <= lost <= 1.15 * hit
            assert (s.timers[STAGGER].item() > 0) == (lost > 60)
            assert s.timers[SAFE].item() > 0


def test_an_attack_hits_once_and_one_that_was_dodged_is_spent():
    """It goes on for 40 frames within reach of two players: one is safe in its first 5, the other after the hit."""
    env = still_fight("Ravager", 2.5, num_envs=2)
    s = env.state
    s.phase, s.attack = torch.full_like(s.phase, ACTIVE), torch.zeros_like(s.attack)
    s.phase_timer, s.hits_left = torch.full_like(s.phase_timer, 40.0), torch.ones_like(s.hits_left)
    s.lock = torch.tensor([-1.0, 0.0]).view(2, 1, 1).expand(2, 1, 2)
    s.timers[SAFE] = torch.tensor([5.0, 0.0])
    act(env, *[NOTHING] * 5)
    assert (s.phase == ACTIVE).all() and (s.timers[SAFE] == 0.0).all()
    assert (s.hits_left == 0.0).all()
    dodged, lost = (c.PLAYER_HP - s.hp).tolist()
    hit = MACHINES["Ravager"].hit * env.traits.attacks[DAMAGE, 0, 0, 0].item()
    assert dodged == 0.0 and 0.85 * hit <= lost <= 1.15 * hit


def test_the_shots_of_an_attack_are_spread_evenly_over_its_active_phase():
    env = still_fight("Ravager", 12.0)
    s = env.state
    s.phase, s.attack = torch.full_like(s.phase, TELEGRAPH), torch.full_like(s.attack, 2)
    s.phase_timer = torch.ones_like(s.phase_timer)
    act(env, NOTHING, NOTHING)
    # Three in 12 frames: in the 1st, 5th and 9th, of which 11, 7 and 3 have passed. 12 m take 12.9 frames of 0.93 m.
    assert s.land_timer[:, 0, 0].tolist() == [13 - 11, 13 - 7, 13 - 3, 0]
    assert s.hits_left.item() == 0.0
    act(env, NOTHING, NOTHING)
    assert s.land_timer.max().item() == 0.0 and s.phase.item() == RECOVER


def test_a_jump_avoids_a_stomp():
    for jumping in (False, True):
        env = still_fight("Ravager", 4.0)
        s = env.state
        s.phase, s.attack = torch.full_like(s.phase, ACTIVE), torch.full_like(s.attack, 3)
        s.phase_timer, s.hits_left = torch.full_like(s.phase_timer, 4.0), torch.ones_like(s.hits_left)
        act(env, press("cross") if jumping else NOTHING)
        assert (s.hp.item() == c.PLAYER_HP) == jumping


def test_a_landing_shot_hits_where_it_was_aimed_and_a_slide_avoids_it():
    for buttons, hit in (((), True), (("circle",), False)):
        env = still_fight("Ravager")
        s = env.state
        s.land_timer[0], s.shot_damage[0] = 3.0, 50.0
        act(env, press(*buttons))
        assert (s.hp.item() == 650.0) == hit
    env = still_fight("Ravager")
    env.state.land_timer[0], env.state.shot_damage[0], env.state.shot_point[0] = 3.0, 50.0, 1.6
    act(env, NOTHING)
    assert env.state.hp.item() == 700.0


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


def test_enough_damage_staggers_the_machine():
    env = still_fight("Ravager")
    env.state.stagger_sum = torch.full_like(env.state.stagger_sum, 0.22 * 1300 + 60)
    act(env, NOTHING)
    assert env.state.phase.item() == STAGGERED
    act(env, *[NOTHING] * 8)
    assert env.state.phase.item() == IDLE
