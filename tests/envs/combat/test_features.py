"""What the agent sees of one fight that is set by hand, as numbers of its own geometry."""

import math

import pytest
import torch

from coachable.envs.combat import CombatEnv
from coachable.envs.combat.features import observation_groups, observe
from coachable.envs.combat.state import ACTIVE, NUM_TIMERS, STAGGERED
from coachable.envs.combat.tables import ALL_MACHINES, AMMO, ELEMENTS, WEAPONS, load_table, resistance
from coachable.envs.combat.traits import AMMO_SLOTS, MACHINE_NAMES

WEAPON, SECTION = WEAPONS.index("Carja's Bane"), 1
RAVAGER = ALL_MACHINES["Ravager"]


def fight(machines=("Ravager",)):
    """The player at (2, 1) looks along +y: what lies at (2 + a, 1 + b) is b m ahead and -a m to the left."""
    env = CombatEnv(1, seed=0, num_enemies=len(machines), machines=["Ravager"], sites=["Arena"])
    env.state.machine[:, 0] = torch.tensor([MACHINE_NAMES.index(name) for name in machines])
    env._look_up()
    s = env.state
    s.enemy_hp = env.traits.hp.clone()
    s.position, s.yaw, s.pitch = torch.tensor([[2.0], [1.0]]), torch.tensor([math.pi / 2]), torch.tensor([0.3])
    s.weapon, s.section = torch.tensor([WEAPON]), torch.tensor([SECTION])
    return env


def seen(env, observation="full"):
    """Numbers by name of their group."""
    s = env.state
    ammo = env._ammo[s.weapon * AMMO_SLOTS + s.section].T
    groups = {group.name: group.width for group in observation_groups(observation)}
    row = observe(s, env.traits, ammo, observation, 4500)[0].split(list(groups.values()))
    return {name: values.tolist() for name, values in zip(groups, row, strict=True)}


def one_hot(index, size):
    return [float(i == index) for i in range(size)]


def place(ahead, left, up):
    d = math.sqrt(ahead**2 + left**2 + up**2)
    return [ahead / d, left / d, up / d, math.sin(d), math.sin(0.1 * d), math.sin(0.01 * d)]


def close(numbers):
    return pytest.approx(numbers, abs=2e-6)


def test_the_player():
    env = fight()
    s = env.state
    s.hp, s.berries, s.stamina = torch.tensor([280.0]), torch.tensor([7.0]), torch.tensor([60.0])
    s.weapon_stamina, s.technique = torch.tensor([25.0]), torch.ones(1)
    s.velocity, s.steps = torch.tensor([[3.0], [4.0]]), torch.tensor([900.0])
    s.timers = 6.0 * torch.arange(1.0, 1 + NUM_TIMERS).unsqueeze(1)  # 0.2, 0.4, 0.6 s and so on
    s.magazine = torch.full_like(s.magazine, 2.0)
    s.quick = torch.ones(1)
    found = seen(env)
    assert found["Player health"] == close([0.4])
    assert found["Quick-tool: health bucket"] == close([0.5, 0.6])
    assert found["Weapon technique stamina"] + found["Active weapon technique"] == close([0.25, 1.0])
    assert found["Player stamina"] == close([0.6])
    # Timers in units of two seconds: in the air, dodging, staggered; the others in the order of the state.
    assert found["Player pose"] == close([0.4, -0.3, math.sin(0.3), math.cos(0.3), 0.9, 0.5, 0.6])
    timers = [0.1, 0.2, 0.3, 0.4, 0.7, 0.8, 1.0, 1.1]
    assert found["Player game state"] == close([*timers, *one_hot(2, 3), 0.2])
    numbers, name = load_table("weapons"), AMMO[WEAPON][SECTION]
    magazine, interval, reload = (numbers.number(name, column) for column in ("magazine", "interval", "reload"))
    element = [*one_hot(ELEMENTS.index("fire"), 7), 0.0]
    shares = [2.0 / magazine, 0.2 / interval, 0.4 / 0.35, 0.6 / reload]
    expected = [*one_hot(WEAPON, 6), *one_hot(SECTION, 3), *element, *shares]
    assert found["Active weapon + ammo"] == close(expected)
    assert found["Weapon wheel open"] == [0.0, 1.0]
    s.steps = 3 * s.steps * 5  # a live fight has no limit
    assert seen(env)["Player game state"][-1] == 1.0
    s.section, s.berries = torch.tensor([0]), torch.zeros(1)  # no element; nothing to heal with
    assert seen(env)["Active weapon + ammo"][9:17] == one_hot(7, 8)
    assert seen(env)["Quick-tool: health bucket"] == [0.0, 0.0]


def test_places_on_the_ground():
    """Seen from an eye 1.5 m up."""
    env = fight()
    s = env.state
    s.trap_type = torch.tensor([[-1.0], [2.0], [0.0], [-1.0]])
    s.trap_arm = torch.tensor([[0.0], [0.0], [9.0], [0.0]])
    s.trap_position = torch.tensor([[9.0, 5.0, 2.0, 9.0], [9.0, 2.0, -3.0, 9.0]]).unsqueeze(-1)
    s.inventory, s.tool = torch.tensor([[1.0], [2.0], [3.0], [10.0]]), torch.tensor([1])
    s.anchor = torch.tensor([[-4.0], [9.0]])
    s.hazard_timer, s.hazard_position = (
        torch.tensor([[0.0], [30.0]]),
        torch.tensor([[9.0, 2.0], [9.0, 4.0]]).unsqueeze(-1),
    )
    found = seen(env)
    traps = [*place(1, -3, -1.5), *one_hot(2, 4), 1.0, *place(-4, 0, -1.5), *one_hot(0, 4), 0.0]
    assert found["Traps: pose + inventory"] == close([*[0.0] * 11, *traps, *[0.0] * 11, 0.1, 0.2, 0.3, 1, 0, 1, 0, 0])
    assert found["Anchor pose"] == close([*place(8, 6, -1.5), 10 / 30])
    # Two fires of 3 m, of which one burns for a second of four.
    assert found["Ejectors: pose + duration"] == close([*[0.0] * 8, *place(3, 0, -1.5), 0.3, 0.25])


def stand(env, row, a, b, up=0.0):
    """An enemy at (2 + a, 1 + b), with its feet `up` m above the ground."""
    env.state.enemy_position[:, row, 0] = torch.tensor([2.0 + a, 1.0 + b])
    env.state.enemy_z[row] = up


def test_the_enemy():
    env = fight()
    s = env.state
    stand(env, 0, -4.0, 3.0)
    s.enemy_yaw, s.enemy_velocity[:, 0, 0] = torch.tensor([[math.pi]]), torch.tensor([1.0, -2.0])
    s.enemy_hp = torch.tensor([[0.3 * RAVAGER.hp]])
    s.gauge, s.state_timer = torch.linspace(0, 0.6, 7).view(7, 1, 1), 30.0 * torch.arange(7.0).view(7, 1, 1)
    s.phase, s.phase_timer = torch.full_like(s.phase, ACTIVE), torch.full_like(s.phase_timer, 24.0)
    s.attack, s.lock[:, 0, 0] = torch.full_like(s.attack, 3), torch.tensor([0.0, -1.0])  # a stomp, which can be told
    found, up = seen(env), RAVAGER.radius - 1.5
    error = math.atan2(up, 5.0) - 0.3
    pose = [*place(3, 4, up), math.atan2(4, 3) / math.pi, error / math.pi, 0, 1, -0.2, -0.1, RAVAGER.radius / 2.6]
    assert found["Enemy pose"] == close(pose)
    assert found["Enemy health"] == close([0.3, math.sqrt(0.3 * RAVAGER.hp / 8500)])  # the strongest one has 8500
    assert found["Enemy type"] == one_hot(MACHINE_NAMES.index("Ravager"), 22)
    assert found["Enemy resistances"] == close([math.log2(factor) for factor in resistance(RAVAGER)])
    longest = max(load_table("elements").column("seconds"))
    status = [*torch.linspace(0, 0.6, 7).tolist(), *[k / longest for k in range(7)]]
    assert found["Enemy elemental status"] == close(status)
    assert found["Enemy attack state"] == close([*one_hot(ACTIVE, 5), 0.4, *one_hot(3, 4), -1, 0])
    assert found["Enemy game state"] == [0, 1, 1]  # staggered, nearly dead, alive
    assert not any(any(values) for name, values in found.items() if name.endswith(" 2"))
    s.phase, s.phase_timer = torch.full_like(s.phase, STAGGERED), torch.full_like(s.phase_timer, 90.0)
    assert seen(env)["Enemy attack state"] == close([*one_hot(STAGGERED, 5), 1, *[0] * 6])
    s.enemy_hp = torch.zeros_like(s.enemy_hp)
    assert seen(env)["Enemy attack state"][:5] == [0.0] * 5
    assert seen(env)["Enemy game state"] == [1, 1, 0]


def test_the_nearer_enemy_comes_first_and_the_dead_one_last():
    env = fight(("Ravager", "Sunwing"))
    stand(env, 0, 0.0, 9.0)
    stand(env, 1, 6.0, 0.0, up=6.0)
    everything = [group.name for group in observation_groups("full")]
    names = [name for name in everything if f"{name} 2" in everything]
    found = seen(env)
    types = found["Enemy type"].index(1.0), found["Enemy type 2"].index(1.0)
    assert types == (MACHINE_NAMES.index("Sunwing"), MACHINE_NAMES.index("Ravager"))
    assert found["Enemy pose"][:6] == close(place(0, -6, 6 + ALL_MACHINES["Sunwing"].radius - 1.5))
    env.state.enemy_hp[1] = 0.0
    swapped = seen(env)
    for name in set(names) - {"Enemy health", "Enemy attack state", "Enemy game state"}:
        assert (swapped[name], swapped[f"{name} 2"]) == (found[f"{name} 2"], found[name]), name


@pytest.mark.parametrize("observation", ["full", "small"])
def test_parts(observation):
    """All twelve, or the four nearest that are left; units that are left of each, and health of the current one."""
    env = fight(("Slitherfang",))
    s, traits = env.state, env.traits
    stand(env, 0, 5.0, 12.0)
    s.enemy_yaw = torch.tensor([[2.0]])
    s.count = torch.where(torch.arange(12).view(12, 1, 1) % 4 == 1, 0.0, traits.units)
    s.part_hp = traits.unit_hp * torch.linspace(0.1, 1.0, 12).view(12, 1, 1)
    rows = []
    for k in range(12):
        x, y, z = traits.offset[:, k, 0, 0].tolist()
        a, b = 5.0 + math.cos(2) * x - math.sin(2) * y, 12.0 + math.sin(2) * x + math.cos(2) * y
        up = traits.radius.item() + z - 1.5
        left, kind = s.count[k].item(), traits.part_type[:, k, 0, 0].tolist()
        looks = [0.1 + 0.9 * k / 11, 0.1 * left, *kind] if left else [0.0] * 5
        rows.append((a**2 + b**2 + up**2, left, place(b, -a, up) if left else [0.0] * 6, looks))
    if observation == "small":
        rows = sorted(row for row in rows if row[1])[:4]
    found = seen(env, observation)
    assert found["Enemy parts pose"] == pytest.approx([x for row in rows for x in row[2]], abs=1e-5)
    assert found["Enemy parts health"] == pytest.approx([x for row in rows for x in row[3]], abs=1e-5)


def test_what_was_done_and_seen_before():
    env = fight()
    s = env.state
    s.actions, s.features = torch.rand(72, 1), torch.rand(24, 1)
    assert seen(env)["Action history"] + seen(env)["Feature history"] == [*s.actions[:, 0], *s.features[:, 0]]
    assert seen(env, "small")["Action history"] == s.actions[:24, 0].tolist()  # of the last step
