"""The data files against the paper's tables, line by line, and against the numbers that are ours."""

import pytest
import torch

from coachable.domains.combat.styles import combat_style_space
from coachable.envs.combat.rewards import NUM_COMPONENTS, style_weights, task_weights
from coachable.envs.combat.tables import (
    AMMO,
    ELEMENTS,
    MACHINES,
    SITES,
    STYLES,
    TRAPS,
    UNSEEN_MACHINES,
    WEAPONS,
    attacks_of,
    load_table,
    machines_of,
    parse_table,
    resistance,
)
from coachable.envs.combat.traits import MACHINE_NAMES, look_up_traits, machine_table, part_layout, unit_hp

# Table "The Horizon Forbidden West machine types used in training and testing": health, strengths, weaknesses, S/W/C.
PAPER_MACHINES = """
Burrower | 95 | none | fire | 0, 1, 1
Scrounger | 150 | none | frost, acid | 0, 1, 1
Scrapper | 235 | plasma | shock | 1, 1, 1
Leaplasher | 375 | shock | purgewater | 0, 2, 2
Lancehorn | 390 | frost | fire | 2, 2, 4
Longleg | 750 | acid | shock | 2, 3, 2
Widemaw | 900 | acid, frost, fire, plasma, shock | purgewater | 0, 3, 6
Ravager | 1300 | frost, shock | acid, purgewater | 1, 1, 3
Snapmaw | 1450 | frost, purgewater | fire, shock | 1, 0, 15
Grimhorn | 1800 | shock, fire | purgewater, acid | 9, 6, 2
Scorcher | 2000 | fire | frost, shock | 1, 3, 3
Rollerback | 2200 | frost, shock | acid | 4, 6, 8
Specter | 2400 | shock, purgewater, fire | acid, plasma | 12, 12, 8
Frostclaw | 2800 | frost | fire, shock | 3, 2, 5
Rockbreaker | 3600 | fire | frost, shock | 2, 6, 2
Slitherfang | 5500 | shock, purgewater, acid | frost, plasma, fire | 28, 7, 24
Apex Thunderjaw | 6500 | fire, frost, shock, purgewater, plasma | acid | 11, 5, 22
Slaughterspine | 7500 | acid, plasma, shock, fire | purgewater, frost | 2, 12, 17
Specter Prime | 8500 | shock, purgewater, fire | acid, plasma | 18, 18, 8
"""
# The design's slots and hits.
SLOTS = (
    "0/1/1 0/1/1 1/1/1 0/2/2 2/2/4 2/3/2 0/3/6 1/1/3 1/0/11 6/4/2 1/3/3 3/4/5 5/4/3 3/2/5 2/6/2 5/2/5 4/2/6 1/5/6 5/5/2"
)
HITS = (31, 36, 43, 51, 41, 65, 69, 79, 91, 80, 97, 86, 84, 125, 120, 100, 163, 186, 125)


@pytest.mark.parametrize("line", PAPER_MACHINES.strip().splitlines())
def test_machines_are_the_papers(line):
    name, health, strong, weak, parts = (cell.strip() for cell in line.split("|"))
    machine = MACHINES[name]
    assert machine.hp == float(health)
    assert set(machine.strong) == set() if strong == "none" else set(strong.split(", "))
    assert set(machine.weak) == set(weak.split(", "))
    assert machine.parts == tuple(int(n) for n in parts.split(","))


def test_all_machines_and_totals():
    assert len(MACHINES) == 19
    assert list(MACHINES) == [line.split("|")[0].strip() for line in PAPER_MACHINES.strip().splitlines()]
    assert [sum(m.parts[i] for m in MACHINES.values()) for i in range(3)] == [97, 91, 134]
    assert sum(m.hp for m in MACHINES.values()) / 19 == pytest.approx(2549.74, abs=0.01)
    assert list(UNSEEN_MACHINES) == ["Bellowback", "Tremortusk", "Sunwing"]
    origin = load_table("machines").origin
    assert {origin[c] for c in ("hp", "strong", "weak", "shields", "weapons", "canisters")} == {"paper"}
    assert set(load_table("unseen_machines").origin.values()) == {"ours"}


def test_part_slots_and_hits_follow_their_formulas():
    for machine, slots, hit in zip(MACHINES.values(), SLOTS.split(), HITS, strict=True):
        assert "/".join(map(str, machine.slots())) == slots, machine.name
        assert round(machine.hit) == hit, machine.name
        assert len(part_layout(machine)) == sum(machine.slots()) <= 12


def test_traits_hold_every_unit_of_every_part():
    traits = look_up_traits(machine_table(torch.device("cpu")), torch.arange(len(MACHINE_NAMES)).unsqueeze(0))
    for i, machine in enumerate([*MACHINES.values(), *UNSEEN_MACHINES.values()]):
        units = (traits.part_type[:, :, 0, i] * traits.units[:, 0, i]).sum(1)
        assert tuple(units.int().tolist()) == machine.parts
        assert traits.hp[0, i] == machine.hp
        assert traits.resistance[:, 0, i].tolist() == resistance(machine)
    distance = traits.offset.square().sum(0).sqrt() / traits.radius
    torch.testing.assert_close(distance[traits.units > 0], torch.tensor(1.08).expand(int((traits.units > 0).sum())))
    assert unit_hp(MACHINES["Ravager"], "shield") == pytest.approx(0.06 * 1.6 * 1300**0.85)


def test_shields_and_weapons_are_in_front_and_canisters_behind():
    """Azimuths [rad] over the whole of their ranges; elevations between -0.2 and 0.9 rad."""
    traits = look_up_traits(machine_table(torch.device("cpu")), torch.arange(len(MACHINE_NAMES)).unsqueeze(0))
    x, y, z = traits.offset[:, :, 0]  # (12, 22) each
    elevation = torch.atan2(z, torch.hypot(x, y))
    for kind, (low, high) in zip(traits.part_type[:, :, 0], ((-1.2, 1.2), (-1.6, 1.6), (1.6, 4.7)), strict=True):
        used = kind > 0
        azimuth = torch.remainder(torch.atan2(y, x)[used] - low, 2 * torch.pi) + low
        for angle, a, b in ((azimuth, low, high), (elevation[used], -0.2, 0.9)):
            assert a <= angle.min() < a + 0.1 * (b - a)
            assert b - 0.1 * (b - a) < angle.max() <= b


def test_weapons_are_the_papers():
    assert dict(zip(WEAPONS, AMMO, strict=True)) == {
        "Icestorm": ("Frost Bolts", "Plasma Bolts", "Shock Bolts"),
        "Carja's Bane": ("Light Arrow", "Fire Light Arrow"),
        "Corrosive Blastsling": ("Acid Bomb", "Adhesive Bomb", "Purgewater Bomb"),
        "Sunscourge": ("Advanced Fire Hunter Arrow", "Advanced Frost Hunter Arrow", "Advanced Acid Hunter Arrow"),
        "Skykiller": ("Advanced Explosive Spike", "Explosive Spike", "Fire Spike"),
        "Ancestor's Return": ("Acid Shredder", "Tear Shredder", "Shock Shredder"),
    }
    assert sum(len(names) for names in AMMO) == 17
    assert TRAPS == ("acid", "purgewater", "shock", "blast")
    assert load_table("traps").column("inventory") == [10, 10, 10, 10]
    assert SITES == ("Ice-lake", "Shining-wastes", "Arena")
    assert ELEMENTS == ("acid", "purgewater", "frost", "shock", "plasma", "fire", "adhesive")


def test_style_ranges_are_the_papers():
    space = combat_style_space(reward_scale="paper")
    high = [7.5, 0.375, 1.5, 1.8, 2.25, 7.5, 30, 0.3, 1.5, 1.5, 1.5, 3, 3, 3, 3, 3, 4.5, 4.5]
    low = [-0.3 if name == "skykiller" else -0.05 * b for name, b in zip(STYLES, high, strict=True)]
    torch.testing.assert_close(space.high, torch.tensor(high))
    torch.testing.assert_close(space.low, torch.tensor(low))
    sim = combat_style_space()
    sim_high = [1.1, 0.15, 0.6, 0.7, 1.0, 1.6, 2.1, 0.3, 1, 1, 1, 0.6, 0.6, 0.6, 0.6, 0.6, 0.9, 0.9]
    torch.testing.assert_close(sim.high, torch.tensor(sim_high))
    ratio = torch.tensor([-1.0 if name == "skykiller" else -0.05 for name in STYLES])
    torch.testing.assert_close(sim.low, ratio * sim.high)
    assert set(load_table("styles").origin.items()) >= {("paper_low", "paper"), ("paper_high", "paper")}


def test_task_and_style_terms_are_the_papers():
    table = load_table("task_rewards")
    paper = {"damage": 0.03, "wheel": -0.5, "quick": -0.5, "out_of_bounds": -500, "death": -500, "off_screen": -1}
    assert {name: table.number(name, "weight") for name in table.rows} == {**paper, "smoothness": -0.01}
    assert table.number("off_screen", "high") == 1.87
    assert table.number("smoothness", "high") == 5.66
    assert task_weights().count_nonzero() == 7
    weights = style_weights("paper")
    assert weights.shape == (18, NUM_COMPONENTS) == (18, 44)
    by_name = {name: sorted(row[row != 0].tolist()) for name, row in zip(STYLES, weights, strict=True)}
    assert by_name["traps"] == [-100, 1, 500]
    assert by_name["skykiller"] == by_name["melee"] == [1]
    assert by_name["part_shield"] == [1, 1000]
    assert by_name["frost"] == [1, 15, 20]
    assert by_name["fire"] == by_name["adhesive"] == [1, 20, 35]
    assert style_weights("sim").max() == 500  # a removal is worth 60


def test_every_class_has_attacks_and_one_that_cannot_be_recognised():
    table = load_table("attacks")
    for kind in {m.kind for m in [*MACHINES.values(), *UNSEEN_MACHINES.values()]}:
        names = attacks_of(kind)
        assert len(names) == (3 if kind == "small" else 4)
        assert any(table.number(name, "hidden") for name in names)


GOOD = "name,hp,strong,weak,shields,weapons,canisters,class,radius,speed,threat,height\norigin" + ",ours" * 11 + "\n"


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("X,10,fire,fire acid,0,0,0,small,1,1,1,0", r"machines\.csv, row 'X': strong and weak share \['fire'\]"),
        ("X,10,heat,,0,0,0,small,1,1,1,0", "row 'X': strong has 'heat'"),
        ("X,10,,,0.5,0,0,small,1,1,1,0", "row 'X': parts are"),
        ("X,ten,,,0,0,0,small,1,1,1,0", "row 'X': hp is 'ten', expected a number"),
        ("X,-1,,,0,0,0,small,1,1,1,0", "row 'X': hp is -1.0"),
        ("X,10,,,0,0,0,huge,1,1,1,0", "row 'X': class has 'huge'"),
        ("X,10,,,0,0,0,small,1,1,1", "row 'X': 11 cells, expected 12"),
        ("X,10,,,0,0,0,small,1,1,1,0\nX,10,,,0,0,0,small,1,1,1,0", "row 'X': appears twice"),
    ],
)
def test_bad_rows_are_named(row, message):
    with pytest.raises(ValueError, match=message):
        machines_of(parse_table("machines.csv", GOOD + row))


def test_columns_need_an_origin():
    with pytest.raises(ValueError, match="expected 'paper' or 'ours'"):
        parse_table("x.csv", "name,a\norigin,guessed\nX,1")
    with pytest.raises(ValueError, match=r"x\.csv has no rows"):
        parse_table("x.csv", "name,a\norigin,ours\n")
