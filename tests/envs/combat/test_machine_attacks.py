"""Rules of the machines' attacks, and of avoiding them, in closed form."""

import pytest
import torch

from coachable.envs.combat import CombatEnv
from coachable.envs.combat import constants as c
from coachable.envs.combat.state import ACTIVE, IDLE, RECOVER, SAFE, STAGGER, STAGGERED, TELEGRAPH
from coachable.envs.combat.tables import ALL_MACHINES, MACHINES
from coachable.envs.combat.traits import DAMAGE, KIND, MACHINE_NAMES
from tests.envs.combat.pressing import press
from tests.envs.combat.still_fight import NOTHING, act, act_plain, still_fight


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


def test_enough_damage_staggers_the_machine():
    env = still_fight("Ravager")
    env.state.stagger_sum = torch.full_like(env.state.stagger_sum, 0.22 * 1300 + 60)
    act(env, NOTHING)
    assert env.state.phase.item() == STAGGERED
    act(env, *[NOTHING] * 8)
    assert env.state.phase.item() == IDLE
