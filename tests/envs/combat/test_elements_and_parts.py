"""Rules of elemental states and of parts in closed form: one still machine, one scripted pad."""

import math

import pytest
import torch

from coachable.envs.combat import CombatEnv
from coachable.envs.combat import constants as c
from coachable.envs.combat.damage import ACID, BURNING, FROST, PLASMA, SHOCK, Totals, damage_parts
from coachable.envs.combat.state import ACTIVE, IDLE, STAGGERED
from coachable.envs.combat.tables import MACHINES, STYLES, WEAPONS, resistance
from coachable.envs.combat.traits import KIND
from tests.envs.combat.still_fight import NEVER, NOTHING, SHOOT, act, act_plain, aim_at_body, hold, part, still_fight


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


def test_build_up_and_damage_in_the_state_are_events_of_an_element_and_decay_is_not():
    def events(after):
        return {STYLES[i] for i in after["events"][0].nonzero()[:, 0].tolist()}

    env = still_fight("Slaughterspine")
    env.state.gauge[ACID] = 0.5
    assert events(act(env, NOTHING)[1]) == set()
    hold(env, "Corrosive Blastsling")
    aim_at_body(env)
    components, after = act(env, SHOOT)
    assert part(components, "state_damage").sum() == 0
    assert events(after) == {"corrosive_blastsling", "acid"}
    env.state.gauge[FROST] = 0.5  # it decays while the other state hurts
    env.state.state_timer[ACID] = 300.0
    env.state.source[ACID] = WEAPONS.index("Sunscourge")
    assert events(act(env, NOTHING)[1]) == {"sunscourge", "acid"}


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
