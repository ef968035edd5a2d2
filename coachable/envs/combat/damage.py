"""Damage to the machines by shots at body and parts, the spear, traps and elements, recorded by its cause."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from coachable.envs.combat import constants as c
from coachable.envs.combat.player import Intent, rows_where
from coachable.envs.combat.state import FIRE, MELEE, NO_SHOT, NO_SWING, RELOAD, State, nearest, pick
from coachable.envs.combat.tables import ELEMENTS, PART_TYPES, load_table
from coachable.envs.combat.traits import BLAST, INTERVAL, RANGE, SPEED, SPREAD, Traits
from coachable.envs.combat.traits import RELOAD as RELOAD_FRAMES

ACID, PURGEWATER, FROST, SHOCK, PLASMA, BURNING, ADHESIVE = range(len(ELEMENTS))
_CANISTER = PART_TYPES.index("canister")
_FAR = 1e6  # [m], further than anything
_MISSED = 1e12  # factor that moves even a near miss out of range

# Rows of `Totals.dealt`.
BY_SHOT, BY_SPEAR, BY_TRAP, BY_ACID, BY_FIRE, BY_PLASMA = range(6)


@dataclass
class Totals:
    """Damage in a step, summed over its frames.

    Attributes:
        dealt: Damage to the machines by cause (6, E, N), clipped to the health left, with the rows `BY_SHOT` to
            `BY_PLASMA` [HP].
        in_state: Damage while each elemental state was active (7, E, N) [HP].
        buildup: Gain of the gauges less their decay (7, E, N).
        part_dealt: Damage to parts, clipped to the unit's health (12, E, N) [HP].
        removed: Number of removed units (12, E, N).
    """

    dealt: Tensor
    in_state: Tensor
    buildup: Tensor
    part_dealt: Tensor
    removed: Tensor

    @classmethod
    def zeros(cls, like: Tensor, slots: int) -> Totals:
        """Return an empty record; `like` is (E, N).

        Args:
            like: Tensor (E, N) with the wanted device and dtype.
            slots: Number of parts of a machine.
        """
        shapes = (6, len(ELEMENTS), len(ELEMENTS), slots, slots)
        return cls(*(like.new_zeros((rows, *like.shape)) for rows in shapes))


@dataclass
class ElementNumbers:
    """Columns (7, 1, 1) of elements.csv.

    Attributes:
        frames: Duration of the elemental state [frames].
        damage: Damage per frame [HP].
        hit_bonus: Factor on hits, less 1.
    """

    frames: Tensor
    damage: Tensor
    hit_bonus: Tensor

    @classmethod
    def load(cls, device: torch.device) -> ElementNumbers:
        """Read the numbers from the data file."""
        table = load_table("elements")

        def column(name: str) -> Tensor:
            return torch.tensor([table.number(e, name) for e in ELEMENTS], device=device).view(-1, 1, 1)

        return cls(column("seconds") * c.FPS, column("damage_per_second") * c.DT, column("hit_factor") - 1.0)


def shoot(
    s: State, intent: Intent, traits: Traits, relative: Tensor, distance: Tensor, spread: Tensor, blocked_at: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Advance the weapon by one frame, and find what its shot hits first.

    There are no projectiles. Instead, the machines are shifted by the distance that they move until the shot arrives.

    Args:
        s: State; its timers and `technique` change.
        intent: Intent of the step; its `loaded` changes.
        traits: Traits of the machines.
        relative: Positions of the enemies relative to the player (2, E, N) [m].
        distance: Distances of the enemies (E, N) [m].
        spread: Standard normal numbers (2, N).
        blocked_at: Distance at which a pillar stops the shot (N,) [m].

    Returns:
        Hits (E, N), 0 or 1; factor of the body's damage (E, N); factor of the parts' damage (12, E, N).
    """
    fires = intent.shooting & (s.hp > 0) & (s.timers[NO_SHOT].amax(0) <= 0) & (intent.loaded > 0)
    intent.loaded = intent.loaded - 1.0 * fires
    rows_where(s.timers, FIRE, fires, intent.ammo[INTERVAL])
    rows_where(s.timers, RELOAD, fires & (intent.loaded <= 0), intent.ammo[RELOAD_FRAMES])

    yaw, pitch = s.yaw + intent.ammo[SPREAD] * spread[0], s.pitch + intent.ammo[SPREAD] * spread[1]
    flat = pitch.cos()
    x, y, z = flat * yaw.cos(), flat * yaw.sin(), pitch.sin()
    centre = relative + s.enemy_velocity * (distance / intent.ammo[SPEED])  # (2, E, N)
    height = s.enemy_z + traits.radius - c.EYE_HEIGHT
    along = centre[0] * x + centre[1] * y + height * z
    squared = centre.square().sum(0) + height.square()
    body = _entry(along, squared - (c.BODY_SPHERE * traits.radius).square())

    # The same in the machine's frame, where its parts are at rest: (3, E, N) ray and centre.
    cos, sin = s.enemy_yaw.cos(), s.enemy_yaw.sin()
    ray = (cos * x + sin * y, cos * y - sin * x, z.expand_as(cos))
    middle = (cos * centre[0] + sin * centre[1], cos * centre[1] - sin * centre[0], height)
    part_along, part_across = _dot(traits.offset, ray), _dot(traits.offset, middle)  # (12, E, N)
    reach = (c.PART_DISTANCE * traits.radius).square()
    squared_parts = (squared + reach - traits.part_radius.square()) + 2.0 * part_across
    present = s.count.clamp(max=1.0)
    entries = _entry(part_along + along, squared_parts) + _FAR * (1.0 - present)
    first_part = entries.amin(0)  # (E, N)

    first = torch.minimum(first_part, body)
    limit = torch.minimum(intent.ammo[RANGE], blocked_at)
    meets = fires & (first <= limit) & (s.enemy_hp > 0)
    if first.shape[0] > 1:  # the nearest of several
        alive_first = first + _FAR * (s.enemy_hp <= 0)
        meets = meets & (alive_first <= alive_first.amin(0))
    struck = ((entries <= torch.minimum(first_part, body)) & meets).float()  # (12, E, N), at most one part

    # A blast reaches parts near the point of impact.
    impact = tuple(first * r - m for r, m in zip(ray, middle, strict=True))
    impact_squared = impact[0].square() + impact[1].square() + impact[2].square()
    gap = ((impact_squared + reach) - 2.0 * (first * part_along - part_across)).clamp(min=0.0).sqrt()
    reach_of_blast = intent.ammo[BLAST] + traits.part_radius
    blast = meets.float() * (intent.ammo[BLAST] > 0)
    shares = torch.maximum((1.0 - gap / reach_of_blast).clamp(min=0.0) * blast, struck) * present

    # The technique is used up by the next shot, also by one that misses.
    technique = 1.0 + (c.TECHNIQUE_FACTOR - 1.0) * s.technique
    s.technique = torch.where(fires, 0.0, s.technique)
    hit = meets.float()
    body_factor = technique * hit * (1.0 + (struck * traits.hit_factor).sum(0))
    return hit, body_factor, shares * technique


def _dot(offset: Tensor, vector: tuple[Tensor, ...]) -> Tensor:
    """Return the scalar products (12, E, N) of offsets (3, 12, E, N) and a vector of three (E, N)."""
    total = offset[0] * vector[0]
    total = torch.addcmul(total, offset[1], vector[1])
    return torch.addcmul(total, offset[2], vector[2])


def _entry(along: Tensor, squared: Tensor) -> Tensor:
    """Return the distance at which a ray enters a sphere; it is far out of range if the ray misses.

    Args:
        along: Projection of the centre on the ray [m].
        squared: Squared distance of the centre less the squared radius [m²].
    """
    inside = along.square() - squared
    # Arithmetic instead of a selection: on the CPU a selection between random elements is ten times slower.
    missed = (-inside).clamp(min=0.0) + (-along).clamp(min=0.0)
    return (along - inside.clamp(min=0.0).sqrt()).clamp(min=0.0) + _MISSED * missed


def damage_parts(s: State, traits: Traits, damage: Tensor, totals: Totals) -> Tensor:
    """Subtract damage from the parts and remove at most one unit of each.

    Args:
        s: State; `part_hp` and `count` change.
        traits: Traits of the machines.
        damage: Damage to the parts (12, E, N) [HP].
        totals: Totals of the step; they change.

    Returns:
        Whether a canister bursts (E, N), 0 or 1.
    """
    applied = torch.minimum(damage, s.part_hp * s.count.clamp(max=1.0))
    left = s.part_hp - applied
    gone = (applied > 0).float() * (left <= 0).float()
    s.count = s.count - gone
    s.part_hp = left + gone * traits.unit_hp
    totals.part_dealt = totals.part_dealt + applied
    totals.removed = totals.removed + gone
    return (gone * traits.part_type[_CANISTER]).amax(0)


def swing(s: State, intent: Intent, traits: Traits) -> Tensor:
    """Advance the spear of `s` by one frame in place; the player lunges and deals damage on the first frame of a swing.

    Returns:
        Damage (E, N) [HP].
    """
    wanted = (intent.light | intent.heavy) & (s.hp > 0) & (s.timers[NO_SWING].amax(0) <= 0)
    duration = torch.where(intent.heavy, c.HEAVY_TIME * c.FPS, c.LIGHT_TIME * c.FPS)
    rows_where(s.timers, MELEE, wanted, duration)
    second = nearest(s)
    offset = pick(s.enemy_position, second) - s.position
    distance = offset.square().sum(0).sqrt().clamp(min=1e-3)
    radius = pick(traits.radius, second)
    gap = distance - radius - c.BODY_RADIUS
    living = pick(s.enemy_hp, second) > 0
    cosine = (offset[0] * s.yaw.cos() + offset[1] * s.yaw.sin()) / distance
    aimed = wanted & living & (cosine > _MELEE_COSINE) & (pick(s.enemy_z, second) < c.REACHABLE_HEIGHT)
    lunge = torch.where(aimed & (gap < c.LUNGE_GAP), gap.clamp(0.0, c.LUNGE), 0.0)
    s.position = s.position + offset * (lunge / distance)
    strikes = aimed & (distance - lunge < radius + c.MELEE_REACH)
    damage = torch.where(intent.heavy, c.HEAVY_DAMAGE, c.LIGHT_DAMAGE) * strikes
    if s.enemy_hp.shape[0] == 1:
        return damage.unsqueeze(0)
    return torch.stack((damage * ~second, damage * second))


_MELEE_COSINE = float(torch.tensor(c.MELEE_CONE).cos())


def build_up(s: State, gain: Tensor, source: Tensor | float, totals: Totals) -> None:
    """Add build-up to the gauges of elements whose state is not active.

    Args:
        s: State.
        gain: Shares of the threshold (7, E, N), without the growth of shock's threshold.
        source: Number of the source, as in `State.source`: (N,) or one number.
        totals: Totals of the step; they change.
    """
    idle = 1.0 - s.state_timer.clamp(max=1.0)
    drenched = 1.0 + (c.DRENCHED_BUILDUP - 1.0) * s.state_timer[PURGEWATER].clamp(max=1.0)
    added = gain * idle * drenched
    shock = added[SHOCK] / s.shock_growth
    added = torch.cat((added[:SHOCK], shock.unsqueeze(0), added[SHOCK + 1 :]))
    gauge = (s.gauge + added).clamp(max=1.0)
    totals.buildup = totals.buildup + (gauge - s.gauge)
    s.gauge = gauge
    changed = (added > 0).float()
    s.source = s.source + changed * (source - s.source)


def run_elements(
    s: State, numbers: ElementNumbers, traits: Traits, totals: Totals
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Advance the decay of the gauges, the elemental states and their damage over time by one frame.

    Args:
        s: State, changed in place.
        numbers: Numbers of the elements.
        traits: Traits of the machines.
        totals: Record of the step, changed in place.

    Returns:
        Active states (7, E, N), 0 or 1, including those that end; damage over time (7, E, N) [HP]; whether plasma ends
        (E, N) and whether shock begins (E, N), 0 or 1.
    """
    active = s.state_timer.clamp(max=1.0)
    timer = (s.state_timer - 1.0).clamp(min=0.0)
    burning = active * numbers.damage * traits.resistance
    burst = active[PLASMA] - timer[PLASMA].clamp(max=1.0)
    decayed = (s.gauge - c.GAUGE_DECAY * c.DT).clamp(min=0.0)
    full = (s.gauge >= 1.0).float()
    # A full gauge starts its state before it can decay. Its reset does not count as a loss of build-up.
    totals.buildup = totals.buildup + (decayed - s.gauge) * (1.0 - full)
    s.gauge = decayed * (1.0 - full)
    s.state_timer = timer + full * numbers.frames
    s.shock_growth = s.shock_growth * (1.0 + (c.SHOCK_GROWTH - 1.0) * full[SHOCK])
    return active, burning, burst, full[SHOCK]


def hit_factor(s: State, numbers: ElementNumbers) -> Tensor:
    """Return the factor of frost and acid on hits.

    Returns:
        (E, N).
    """
    bonus = 1.0 + numbers.hit_bonus * s.state_timer.clamp(max=1.0)
    return bonus[ACID] * bonus[FROST]


def take_damage(s: State, raw: Tensor, active: Tensor, burst: Tensor, totals: Totals) -> None:
    """Subtract damage from the machines, clipped to their health, and record its causes.

    Args:
        s: State.
        raw: Damage of this frame by cause (6, E, N); the stored damage replaces the row of plasma [HP].
        active: Active states during this frame (7, E, N), 0 or 1.
        burst: Whether plasma ends (E, N), 0 or 1.
        totals: Totals of the step; they change.
    """
    release = s.plasma_store * burst
    raw = torch.cat((raw[:BY_PLASMA], release.unsqueeze(0)))
    total = raw.sum(0)
    applied = torch.minimum(total, s.enemy_hp)
    dealt = raw * (applied / total.clamp(min=1e-6))
    totals.dealt = totals.dealt + dealt
    totals.in_state = totals.in_state + active * applied
    s.enemy_hp = s.enemy_hp - applied
    stored = c.PLASMA_SHARE * (applied - dealt[BY_PLASMA]) * active[PLASMA]
    s.plasma_store = (s.plasma_store + stored) * (1.0 - burst)
    s.stagger_sum = s.stagger_sum + applied
