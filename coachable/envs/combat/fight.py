"""One step of N fights from the gamepad's state to the components of the reward, for `CombatEnv`."""

import torch
from torch import Tensor

from coachable.envs.combat import constants as c
from coachable.envs.combat.damage import (
    ACID,
    BURNING,
    BY_ACID,
    BY_FIRE,
    BY_PLASMA,
    BY_SHOT,
    BY_SPEAR,
    BY_TRAP,
    PLASMA,
    Totals,
)
from coachable.envs.combat.features import kept_features, one_hot_rows
from coachable.envs.combat.gamepad import read_pad
from coachable.envs.combat.player import command, element_of, wrap
from coachable.envs.combat.rewards import pack_components
from coachable.envs.combat.state import FEATURES_KEPT, FROM_MELEE, FROM_TRAP, NUM_SOURCES, State, nearest, pick
from coachable.envs.combat.step_frames import Noise, Rules, run_frames
from coachable.envs.combat.tables import WEAPONS
from coachable.envs.combat.traits import AMMO_SLOTS, Traits
from coachable.envs.combat.traps import closeness


def run_step(s: State, pad_rows: Tensor, rules: Rules, noise: Noise, ammo_table: Tensor, sections: Tensor) -> Tensor:
    """Advance the fights by one step, in place.

    Args:
        s: State; it changes.
        pad_rows: Canonical actions (24, N).
        rules: Rules of the fights.
        noise: Random numbers of the step.
        ammo_table: Result of `ammo_table`.
        sections: Result of `ammo_sections`.

    Returns:
        Components (44, N); see `rewards.COMPONENTS`.
    """
    traits, pad = rules.traits, read_pad(pad_rows)
    s.features = torch.cat([kept_features(s, traits), s.features[:FEATURES_KEPT]])
    s.actions = torch.cat([pad_rows, s.actions[: -len(pad_rows)]])
    element_before = element_of(s.weapon * AMMO_SLOTS + s.section, ammo_table)
    intent = command(s, pad, traits, rules.site, ammo_table, sections)
    row = s.weapon * AMMO_SLOTS + s.section
    placed, was_active, source_before = s.trap_type, s.state_timer, s.source
    totals = run_frames(s, intent, rules, noise)
    s.magazine = s.magazine.scatter(0, row.unsqueeze(0), intent.loaded.unsqueeze(0))
    s.yaw = wrap(s.yaw)
    s.steps = s.steps + 1.0

    # A trap that fired keeps its place for this difference, otherwise firing would cost its closeness.
    near = closeness(s, placed)
    lure, proximity = near - s.closeness
    s.closeness = closeness(s, s.trap_type)

    second = nearest(s)
    offset = pick(s.enemy_position, second) - s.position
    distance = offset.square().sum(0).sqrt()
    s.anchor = torch.where(distance < s.distance, s.position, s.anchor)
    s.distance = distance
    outside = (s.position - s.anchor).square().sum(0) > c.BOUND_RADIUS**2

    stick = pad.right_stick
    jerk = stick - 2.0 * s.sticks[:2] + s.sticks[2:]
    s.sticks = torch.cat([stick, s.sticks[:2]])
    s.wheel, s.quick = pad.l1, pad.left + pad.right

    # Damage over time counts for the source at the start of the step if the state was active then, and otherwise for
    # the latest source.
    source = torch.where(was_active > 0, source_before, s.source)
    return pack_components(
        damage=totals.dealt.sum((0, 1)),
        **_credit(s, totals, source),
        state_damage=totals.in_state.sum(1),
        part_damage=(traits.part_type * totals.part_dealt).sum((1, 2)),
        removals=(traits.part_type * totals.removed).sum((1, 2)),
        buildup=totals.buildup.sum(1).clamp(c.BUILDUP_LOW, c.BUILDUP_HIGH),
        ammo_change=2.0 * (intent.element - element_before),
        lure=lure,
        proximity=proximity,
        wheel=s.wheel,
        quick=s.quick,
        off_screen=_off_screen(s, traits, offset, second),
        smoothness=jerk.square().sum(0).sqrt(),
        death=1.0 * (s.hp <= 0),
        out_of_bounds=1.0 * outside,
    )


def _credit(s: State, totals: Totals, source: Tensor) -> dict[str, Tensor]:
    """Return the damage by weapon (6, N), spear and traps (N,); that of elemental states counts for their source."""
    lasting = torch.stack([totals.dealt[row] for row in (BY_ACID, BY_FIRE, BY_PLASMA)])  # (3, E, N)
    lit_by = torch.stack([source[element] for element in (ACID, BURNING, PLASMA)])
    by_source = (one_hot_rows(lit_by, NUM_SOURCES) * lasting).sum((1, 2))  # (8, N)
    direct = totals.dealt.sum(1)
    shots = one_hot_rows(s.weapon, len(WEAPONS)) * direct[BY_SHOT]
    return {
        "weapon_damage": by_source[: len(WEAPONS)] + shots,
        "melee_damage": by_source[FROM_MELEE] + direct[BY_SPEAR],
        "trap_damage": by_source[FROM_TRAP] + direct[BY_TRAP],
    }


def _off_screen(s: State, traits: Traits, offset: Tensor, second: Tensor) -> Tensor:
    """Return the difference of cosines by which the nearest enemy is outside a cone of 60 degrees, in [0, 1.87]."""
    rise = pick(s.enemy_z + traits.radius, second) - c.EYE_HEIGHT
    length = (offset.square().sum(0) + rise.square()).sqrt().clamp(min=1e-3)
    ahead = s.pitch.cos() * (offset[0] * s.yaw.cos() + offset[1] * s.yaw.sin()) + rise * s.pitch.sin()
    return (c.SCREEN_COSINE - ahead / length).clamp(min=0.0)
