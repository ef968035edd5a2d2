"""Scene of a fight: machines differ, parts vanish when they are removed, and attacks mark the ground."""

import numpy as np
import pytest
import torch

from coachable.domains.combat.machine_scene import PART_COLOURS, machine, plan_of, player
from coachable.domains.combat.stage import ELEMENT_COLOURS, LAMPS, CombatStage, _warning
from coachable.envs.combat import constants as c
from coachable.envs.combat.env import CombatEnv
from coachable.envs.combat.state import ACTIVE, IDLE, TELEGRAPH
from coachable.envs.combat.tables import ALL_MACHINES, ELEMENTS, MACHINES, TRAPS, WEAPONS
from coachable.scene import palette
from coachable.scene.parts import SHAPES, Parts


@pytest.fixture
def env():
    env = CombatEnv(1, seed=0, machines=["Lancehorn"], sites=["Arena"])
    env.reset()
    env.state.phase.fill_(IDLE)
    env.state.weapon.fill_(WEAPONS.index("Icestorm"))
    env.state.section.fill_(0)  # frost
    return env


def shown(parts, colour):
    """Sizes of the primitives of a colour that can be seen."""
    batches = [parts.of(shape) for shape in SHAPES]
    sizes = np.concatenate([b.sizes[(b.colours == colour).all(1)] for b in batches])
    return sizes[sizes.max(1) > 1e-3]


def silhouette(name):
    parts = machine(name, 1.0, 0.0, LAMPS[IDLE])
    return np.concatenate([np.concatenate([b.positions, b.sizes], 1).ravel() for b in map(parts.of, SHAPES)])


def test_all_machines_differ_in_shape_or_size():
    assert len(MACHINES) == 19
    seen = [silhouette(name) for name in MACHINES]
    for index, one in enumerate(seen):
        for other in seen[:index]:
            assert len(one) != len(other) or np.abs(one - other).max() > 0.05


@pytest.mark.parametrize("name", ALL_MACHINES)
def test_a_machine_is_as_large_as_its_body_and_stands_on_the_ground(name):
    radius = ALL_MACHINES[name].radius
    parts = machine(name, radius, 0.7, LAMPS[IDLE])
    positions = np.concatenate([parts.of(shape).positions for shape in SHAPES])
    assert 0.0 <= positions[:, 2].min() < 0.5 * radius
    assert 0.9 * radius < np.abs(positions).max() < 4.0 * radius
    counts = [len(machine(name, radius, walked, LAMPS[ACTIVE], alive)) for walked in (0.0, 0.3) for alive in (1, 0)]
    assert len({*counts, len(parts)}) == 1, "frames in between need the same primitives"
    assert len(shown(parts, LAMPS[IDLE])) == 2  # its eyes
    assert plan_of(name).length > 0


def test_walking_moves_the_legs():
    one, other = (machine("Ravager", 1.0, walked, LAMPS[IDLE]).of("cylinder").positions for walked in (0.0, 0.4))
    assert np.abs(one - other).max() > 0.1


def test_weapons_look_different_and_show_their_ammunition():
    figures = {weapon: player(weapon, palette.GREEN, 0.0) for weapon in WEAPONS}
    shapes = {tuple(np.concatenate([figures[w].of(s).sizes.ravel() for s in SHAPES]).round(3)) for w in WEAPONS}
    assert len(shapes) == len(WEAPONS) == 6
    assert all(len(shown(figure, palette.GREEN)) >= 1 for figure in figures.values())
    assert len({len(figure) for figure in figures.values()}) == 1


def test_a_removed_part_is_gone(env):
    stage = CombatStage()
    before = stage.frame(env)
    kinds = env.traits.part_type[:, :, 0, 0]
    for kind, colour in enumerate(PART_COLOURS):
        slots = torch.nonzero(kinds[kind] > 0)[:, 0]
        # The lamps and the health bar have other colours; yellow and vermilion are used by parts alone here.
        count = len(shown(before.parts, colour)) - (2 if colour == LAMPS[IDLE] else 0)
        assert count >= len(slots) > 0
        env.state.count[slots[0], 0, 0] = 0
        after = stage.frame(env)
        left = len(shown(after.parts, colour)) - (2 if colour == LAMPS[IDLE] else 0)
        assert left == count - 1
        assert all(len(after.parts.of(shape)) == len(before.parts.of(shape)) for shape in SHAPES)
    assert stage.frame(env).gauges[5].text.startswith(f"shields {int((kinds[0] > 0).sum()) - 1}")


def test_the_health_bar_shrinks_and_changes_colour(env):
    stage = CombatStage()
    full = stage.frame(env)
    assert shown(full.parts, palette.GREEN)[:, 0].max() == pytest.approx(2.4)
    assert full.labels[0].text == "Lancehorn 390 HP"
    env.state.enemy_hp[:] = 39.0
    hurt = stage.frame(env)
    assert len(shown(hurt.parts, palette.GREEN)) == 0
    assert shown(hurt.parts, palette.VERMILION)[:, 0].min() == pytest.approx(0.24)
    assert hurt.labels[0].text == "Lancehorn 39 HP"


@pytest.mark.parametrize("phase, colour", [(TELEGRAPH, palette.YELLOW), (ACTIVE, palette.VERMILION)])
def test_attacks_mark_the_ground_that_they_reach(env, phase, colour):
    stage = CombatStage()
    assert len(stage.frame(env).glows) == 0
    env.state.phase.fill_(phase)
    for slot in range(4):
        env.state.attack.fill_(slot)
        assert len(shown(stage.frame(env).glows, colour)) > 0


def test_a_bite_is_one_sector_of_the_ground():
    glows = Parts()
    _warning(glows, np.zeros(2), 0.5, 1.0, "cone", 8.0, palette.YELLOW)
    sector = glows.of("sector")
    assert len(glows) == len(sector) == 1
    assert sector.sizes[0, :2].tolist() == [16.0, 16.0] and sector.positions[0, :2].tolist() == [0.0, 0.0]


def test_the_bar_of_a_tall_machine_is_in_the_picture(env):
    env.traits.radius[:] = 4.0
    stage = CombatStage()
    boxes = stage.frame(env).parts.of("box")
    bar = boxes.positions[(boxes.colours == palette.GREEN).all(1) & np.isclose(boxes.sizes[:, 0], 2.4)]
    place = env.state.enemy_position[:, 0, 0].numpy()
    assert bar[0, 2] < 5.0 and np.hypot(*(bar[0, :2] - place)) > 4.0, "in front of its body"


def test_a_line_of_fire_when_a_round_is_gone(env):
    stage = CombatStage()
    stage.frame(env)
    assert len(stage.frame(env).glows) == 0
    wheel = 3 * int(env.state.weapon) + int(env.state.section)
    env.state.magazine[wheel] -= 1
    line = stage.frame(env).glows.of("cylinder")
    assert len(line) == 1
    reach = float((env.state.enemy_position[:, 0, 0] - env.state.position[:, 0]).norm())
    assert line.sizes[0, 2] == pytest.approx(max(reach, 2.0) - 1.0, rel=1e-3)
    assert len(stage.frame(env).glows) == 0


def test_traps_and_burning_ground(env):
    stage = CombatStage()
    before = len(stage.frame(env).marks)
    env.state.trap_type[0, 0] = TRAPS.index("shock")
    env.state.trap_arm[0, 0] = 0.0
    armed = stage.frame(env).marks
    assert len(armed) == before + 4
    assert len(shown(armed, ELEMENT_COLOURS["shock"])) == 3
    env.state.trap_arm[0, 0] = 10.0
    assert len(shown(stage.frame(env).marks, ELEMENT_COLOURS["shock"])) == 2, "the plate is grey until it is armed"
    env.state.hazard_timer[0, 0] = 5.0
    zone = stage.frame(env).glows.of("cylinder")
    assert zone.sizes[0, :2].tolist() == [2 * c.HAZARD_RADIUS] * 2


def test_elements_of_a_machine_are_named_and_coloured(env):
    env.state.state_timer[ELEMENTS.index("fire"), 0, 0] = 30.0
    frame = CombatStage().frame(env)
    assert frame.labels[0].text == "Lancehorn 390 HP · fire"
    assert len(shown(frame.glows, ELEMENT_COLOURS["fire"])) == 2
    assert len(set(ELEMENT_COLOURS.values())) == 8


def test_every_site_has_its_scenery():
    stage, seen = CombatStage(), []
    for site in ("Ice-lake", "Shining-wastes", "Arena"):
        env = CombatEnv(1, seed=0, sites=[site])
        env.reset()
        scenery = stage.backdrop(env)
        seen.append((scenery.surfaces[0].colour, len(scenery.parts)))
        assert stage.frame(env).place == ("Ice-lake", "Shining-wastes", "Arena").index(site)
    assert len(set(seen)) == 3


def test_two_machines_are_both_drawn():
    env = CombatEnv(1, seed=0, machines=["Scrounger"], num_enemies=2)
    env.reset()
    frame = CombatStage().frame(env)
    assert [label.text for label in frame.labels] == ["Scrounger 150 HP"] * 2
