"""Scripted players: they fight as their name says, and the order of the weapons is the design's."""

import pytest
import torch
from tensordict import TensorDict

from coachable.envs.combat import CombatEnv
from coachable.envs.combat.bots import BOTS, fight_all
from coachable.envs.combat.player import from_stick, to_stick
from coachable.envs.combat.state import State
from coachable.envs.combat.tables import AMMO, MACHINES, WEAPONS
from coachable.transforms.gamepad import GAMEPAD

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


def test_acting_leaves_the_fight_alone():
    env = CombatEnv(3, seed=0)
    env.reset()
    before = State(**env.state.tensors())
    BOTS["Acid Shredder"].act(env, torch.Generator().manual_seed(0))
    for name, value in before.tensors().items():
        assert getattr(env.state, name) is value


def test_the_spear_costs_health_and_spikes_deal_more():
    """A cheap part of the balance below: two small machines."""
    machines = ["Scrounger", "Burrower"]
    names = ("Advanced Explosive Spike", "Light Arrow", "Spear")
    strong, bow, spear = (fight_all(BOTS[name], machines, fights=6, steps=300) for name in names)
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
