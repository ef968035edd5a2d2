"""Scripted players: they fight as their names say, and the weapons have the intended order of strength."""

import pytest
import torch
from combat_bots import BOTS, Bot, to_stick
from tensordict import TensorDict

from coachable.envs.combat import CombatEnv
from coachable.envs.combat.constants import CONTROL_STEP
from coachable.envs.combat.gamepad import GAMEPAD
from coachable.envs.combat.player import from_stick
from coachable.envs.combat.state import ACTIVE, IDLE, TELEGRAPH, State
from coachable.envs.combat.tables import AMMO, MACHINES, SITES, WEAPONS

TOP = ("Slitherfang", "Apex Thunderjaw", "Slaughterspine", "Specter Prime")


def test_directions_and_sticks_are_inverse():
    yaw = torch.tensor([0.3, -2.0])
    forward = torch.stack((yaw.cos(), yaw.sin()))
    stick = torch.tensor([[0.6, -1.0], [0.8, 0.0]])
    torch.testing.assert_close(to_stick(from_stick(stick, forward), yaw), stick)


def test_one_bot_per_ammo_and_the_spear():
    assert len(BOTS) == sum(map(len, AMMO)) + 1


@pytest.mark.parametrize("name", ["Fire Light Arrow", "Spear"])
def test_bots_act_validly_and_fight_as_they_are_called(name):
    env = CombatEnv(12, seed=0, machines=["Longleg"], sites=["Arena"], components=True)
    env.reset()
    generator, damage = torch.Generator().manual_seed(0), torch.zeros(44)
    for _ in range(30):
        action = BOTS[name].act(env, generator)
        assert GAMEPAD.spec((12,)).is_in(action)
        damage += env._step(TensorDict({"action": action}, [12]))["components"].sum(0)
    bow, spear = damage[1 + WEAPONS.index("Carja's Bane")], damage[7]
    assert damage[0] > 500
    torch.testing.assert_close(bow if name != "Spear" else spear, damage[0])


def test_bots_dodge_what_is_about_to_hit_with_their_probabilities():
    # Phase, its timer [frames], attack slot, gap [m], machine alive, frames until a shot lands; probability.
    bite, shots, soon, late = 0, 2, 3.0, 20.0  # a bite reaches 4.5 m, and dodges begin 3 m further
    cases = [
        (IDLE, 0.0, bite, 2.0, True, 0.0, 0.0),
        (TELEGRAPH, soon, bite, 2.0, True, 0.0, 0.6),
        (TELEGRAPH, late, bite, 2.0, True, 0.0, 0.0),
        (ACTIVE, late, bite, 7.0, True, 0.0, 0.6),
        (ACTIVE, late, bite, 8.0, True, 0.0, 0.0),
        (ACTIVE, late, bite, 2.0, False, 0.0, 0.0),
        (ACTIVE, late, shots, 2.0, True, 0.0, 0.0),
        (IDLE, 0.0, bite, 30.0, True, soon, 0.42),
        (IDLE, 0.0, bite, 30.0, True, late, 0.0),
        (TELEGRAPH, soon, bite, 2.0, True, soon, 0.6),  # one decision for both
    ]
    phase, timer, attack, gap, lives, landing, share = torch.tensor(cases).repeat(30, 1).T
    env = CombatEnv(len(phase), seed=0, machines=["Ravager"], sites=["Arena"])
    env.reset()
    s = env.state
    s.phase, s.phase_timer, s.attack = phase[None], timer[None], attack[None].long()
    s.position, s.enemy_hp = torch.zeros_like(s.position), s.enemy_hp * lives
    s.enemy_position = torch.stack((gap + MACHINES["Ravager"].radius + 0.5, torch.zeros_like(gap))).unsqueeze(1)
    s.land_timer[3] = landing
    luck = torch.rand(len(phase), generator=torch.Generator().manual_seed(0))
    assert torch.equal(Bot._dodges(env, torch.Generator().manual_seed(0)), luck < share)


def test_acting_leaves_the_fight_alone():
    env = CombatEnv(3, seed=0)
    env.reset()
    before = State(**env.state.tensors())
    BOTS["Acid Shredder"].act(env, torch.Generator().manual_seed(0))
    for name, value in before.tensors().items():
        assert getattr(env.state, name) is value


@torch.no_grad()
def fight_all(bot: Bot, machines: list[str], fights: int, steps: int) -> dict[str, dict[str, float]]:
    """Let a bot fight every machine: its share of won fights, damage dealt and taken [HP/s], and mean length [s]."""
    rows = [machine for machine in machines for _ in range(fights)]
    env = CombatEnv(len(rows), seed=0, machines=machines, episode_steps=steps)
    env.assign(rows, [SITES[i % len(SITES)] for i in range(len(rows))])
    env.reset()
    generator = torch.Generator().manual_seed(0)
    running = torch.ones(len(rows), dtype=torch.bool)
    won, length, dealt, taken = (torch.zeros(len(rows)) for _ in range(4))
    for _ in range(steps):
        hp, enemy_hp = env.state.hp.clone(), env.state.enemy_hp.sum(0)
        action = bot.act(env, generator)
        after = env._step(TensorDict({"action": action}, [len(rows)]))
        length += running
        dealt += (enemy_hp - env.state.enemy_hp.sum(0)) * running
        taken += (hp - env.state.hp).clamp(min=0.0) * running
        dead = (env.state.enemy_hp <= 0).all(0) & (env.state.hp > 0)
        won += dead & running
        running &= ~after["done"][:, 0]
        if not running.any():
            break
    report = {}
    for i, machine in enumerate(machines):
        row = slice(i * fights, (i + 1) * fights)
        seconds = float(length[row].sum()) * CONTROL_STEP
        report[machine] = {
            "won": float(won[row].mean()),
            "dealt": float(dealt[row].sum()) / seconds,
            "taken": float(taken[row].sum()) / seconds,
            "seconds": seconds / fights,
        }
    return report


def test_the_spear_costs_health_and_spikes_deal_more():
    """A cheap part of the balance below: two small machines."""
    machines = ["Scrounger", "Burrower"]
    names = ("Advanced Explosive Spike", "Light Arrow", "Spear")
    strong, bow, spear = (fight_all(BOTS[name], machines, fights=3, steps=300) for name in names)
    for report in (strong, bow, spear):
        assert list(report) == machines
        assert all(result["won"] > 0.8 and 0 < result["seconds"] < 60 for result in report.values())
    assert sum(r["dealt"] for r in strong.values()) > 1.5 * sum(r["dealt"] for r in bow.values())
    assert sum(r["taken"] for r in spear.values()) > 1.5 * sum(r["taken"] for r in strong.values())


@pytest.mark.slow
def test_the_balance_of_three_bots():
    """The strongest weapon beats everything; weak ones and the spear fail only at the top; the spear costs health."""
    names = ("Advanced Explosive Spike", "Light Arrow", "Spear")
    strong, bow, spear = (fight_all(BOTS[name], list(MACHINES), fights=12, steps=2400) for name in names)
    assert all(result["won"] > 0.9 for result in strong.values())
    for machine in MACHINES:
        if machine not in (*TOP, "Frostclaw", "Rockbreaker"):
            assert bow[machine]["won"] > 0.8, machine
            assert spear[machine]["won"] > 0.8, machine

    def mean(report, key):
        return sum(result[key] for result in report.values()) / len(report)

    assert mean(strong, "dealt") > 1.5 * mean(bow, "dealt")
    assert mean(spear, "taken") > 1.5 * mean(strong, "taken")
