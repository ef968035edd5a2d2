"""Attacks, phases and motion of the machines, and their hits on the player."""

import torch
from torch import Tensor

from coachable.envs.combat import constants as c
from coachable.envs.combat.damage import ADHESIVE, PURGEWATER
from coachable.envs.combat.player import facing, inside_wall, rows_where, wrap
from coachable.envs.combat.state import (
    ACTIVE,
    AIR,
    IDLE,
    RECOVER,
    SAFE,
    SLIDE,
    STAGGER,
    STAGGERED,
    TELEGRAPH,
    State,
)
from coachable.envs.combat.tables import KINDS, PART_TYPES, load_table
from coachable.envs.combat.traits import ACTIVE as ACTIVE_FRAMES
from coachable.envs.combat.traits import (
    COOLDOWN,
    DAMAGE,
    FARTHEST,
    HAZARD,
    KIND,
    NEAREST,
    SHOTS,
    Traits,
)
from coachable.envs.combat.traits import RECOVER as RECOVER_FRAMES
from coachable.envs.combat.traits import TELEGRAPH as TELEGRAPH_FRAMES

CONE, CHARGE, RANGED, AREA = range(len(KINDS))
_WEAPON = PART_TYPES.index("weapon")
_SHOCK_FRAMES = load_table("elements").number("shock", "seconds") * c.FPS


def ranged_strength(s: State, traits: Traits) -> Tensor:
    """Return the share of weapon parts that are left.

    Returns:
        (E, N) in [0, 1]; 1 for machines without weapon parts.
    """
    left = (s.count * traits.part_type[_WEAPON]).sum(0)
    return torch.where(traits.weapon_parts > 0, left / traits.weapon_parts.clamp(min=1.0), 1.0)


def decide(
    s: State, traits: Traits, strength: Tensor, gap: Tensor, shocked: Tensor, choice: Tensor, pause: Tensor
) -> tuple[Tensor, Tensor]:
    """Advance the phases by one frame: idle, telegraph, active, recover, and staggered.

    Args:
        s: State; it changes.
        traits: Traits of the machines.
        strength: Result of `ranged_strength`.
        gap: Distances between the bodies (E, N) [m].
        shocked: Whether shock begins (E, N), 0 or 1.
        choice: Uniform numbers (4, E, N); of the attacks that can be used, the one with the largest number starts.
        pause: Uniform numbers (E, N) for the pause after an attack.

    Returns:
        Rows of the current attack (11, E, N), and whether a hazard zone is left behind (E, N) bool.
    """
    living, idle = s.enemy_hp > 0, s.phase == IDLE
    timer = s.phase_timer - 1.0
    cooldown = (s.cooldown - 1.0).clamp(min=0.0)
    waiting = torch.where(idle, s.pause - 1.0, s.pause)

    attacks = traits.attacks
    usable = (gap >= attacks[NEAREST]) & (gap <= attacks[FARTHEST]) & (cooldown <= 0)
    usable = usable & ((attacks[KIND] != RANGED) | (strength > 0))
    best = (choice * usable).amax(0)
    starts = idle & living & (waiting <= 0) & (best > 0)
    s.attack = torch.where(starts, (choice * usable).argmax(0), s.attack)
    blow = attacks.gather(1, s.attack.expand(attacks.shape[0], 1, *s.attack.shape)).squeeze(1)

    over = (timer <= 0) & living
    to_active, to_recover = over & (s.phase == TELEGRAPH), over & (s.phase == ACTIVE)
    to_idle = over & (s.phase >= RECOVER)
    phase = torch.where(starts, TELEGRAPH, s.phase + 1.0 * (to_active | to_recover))
    phase = torch.where(to_idle, IDLE, phase)
    glued = 1.0 + (c.GLUED_TELEGRAPH - 1.0) * s.state_timer[ADHESIVE].clamp(max=1.0)
    timer = torch.where(starts, blow[TELEGRAPH_FRAMES] * glued, timer)
    timer = torch.where(to_active, blow[ACTIVE_FRAMES], timer)
    timer = torch.where(to_recover, blow[RECOVER_FRAMES], timer)

    s.lock = torch.where(to_active, facing(s.enemy_yaw), s.lock)
    s.hits_left = torch.where(to_active, blow[SHOTS], s.hits_left)
    slots = torch.arange(cooldown.shape[0], device=cooldown.device).view(-1, 1, 1)
    s.cooldown = torch.where(to_recover & (s.attack == slots), blow[COOLDOWN], cooldown)
    calm = (c.PAUSE_LOW + (c.PAUSE_HIGH - c.PAUSE_LOW) * pause) * c.FPS
    rage = 1.0 - c.PAUSE_RAGE * (1.0 - s.enemy_hp / traits.hp)
    s.pause = torch.where(to_recover, calm * rage, waiting)
    zone = to_recover & (blow[HAZARD] > 0)

    # Enough damage staggers a machine, and shock paralyses it. Both interrupt its attack.
    staggers = (s.stagger_sum >= c.STAGGER_SHARE * traits.hp + c.STAGGER_BASE) & living
    s.stagger_sum = torch.where(staggers, 0.0, s.stagger_sum)
    frames = torch.maximum(staggers * (c.MACHINE_STAGGER * c.FPS), shocked * _SHOCK_FRAMES)
    stopped = (frames > 0) & living
    still = torch.where(s.phase == STAGGERED, timer, 0.0)
    s.phase = torch.where(stopped, STAGGERED, phase)
    s.phase_timer = torch.where(stopped, torch.maximum(frames, still), timer)
    return blow, zone


def move_machines(s: State, traits: Traits, site: Tensor, blow: Tensor, flip: Tensor) -> None:
    """Advance the motion by one frame: approach or strafe, charge, turn, and dive. Bodies never overlap.

    Args:
        s: State; it changes.
        traits: Traits of the machines.
        site: Rows of `site_table` (4, N).
        blow: Rows of the current attack (11, E, N).
        flip: Uniform numbers (E, N) that reverse the strafing direction with a small probability.
    """
    living, idle = s.enemy_hp > 0, s.phase == IDLE
    to_player = s.position.unsqueeze(1) - s.enemy_position  # (2, E, N)
    distance = to_player.square().sum(0).sqrt().clamp(min=1e-3)
    direction = to_player / distance
    s.strafe = torch.where(flip < c.STRAFE_FLIP, -s.strafe, s.strafe)

    charging = (s.phase == ACTIVE) & (blow[KIND] == CHARGE)
    sideways = torch.stack((-direction[1], direction[0])) * (c.STRAFE_FACTOR * s.strafe)
    wanted = torch.where(distance > traits.approach, direction, sideways)
    glued = 1.0 - (1.0 - c.GLUED_SPEED) * s.state_timer[ADHESIVE].clamp(max=1.0)
    speed = traits.speed * glued * living
    wanted = torch.where(charging, c.CHARGE_FACTOR * s.lock, wanted * idle) * speed
    s.enemy_velocity = torch.lerp(s.enemy_velocity, wanted, c.MACHINE_LAG)
    position = inside_wall(s.enemy_position + c.DT * s.enemy_velocity, site)
    away = position - s.position.unsqueeze(1)
    gone = away.square().sum(0).sqrt().clamp(min=1e-3)
    space = (traits.radius + c.BODY_RADIUS) * living
    s.enemy_position = position + away * (space / gone - 1.0).clamp(min=0.0)

    bearing = torch.atan2(direction[1], direction[0])
    turns = (s.phase <= TELEGRAPH) & living
    step = wrap(bearing - s.enemy_yaw).clamp(-c.MACHINE_TURN * c.DT, c.MACHINE_TURN * c.DT)
    s.enemy_yaw = wrap(s.enemy_yaw + step * turns)

    # Flying machines descend to dive and when they are staggered, within the time of a telegraph.
    dives = (blow[KIND] == CHARGE) & (s.phase >= TELEGRAPH) & (s.phase <= ACTIVE)
    aloft = traits.height * ~(dives | (s.phase == STAGGERED))
    climb = traits.height / 12.0
    s.enemy_z = s.enemy_z + torch.maximum(torch.minimum(aloft - s.enemy_z, climb), -climb)


def strike_player(
    s: State,
    traits: Traits,
    blow: Tensor,
    strength: Tensor,
    self_damage: Tensor,
    roll: Tensor,
    shot_roll: Tensor,
    noise: Tensor,
    pillars: Tensor | None,
    blocks: Tensor,
) -> None:
    """Advance the attacks by one frame and apply the damage to the player.

    Args:
        s: State; it changes.
        traits: Traits of the machines.
        blow: Rows of the current attack (11, E, N).
        strength: Result of `ranged_strength`.
        self_damage: Damage by the player's own traps (N,) [HP].
        roll: Uniform numbers (E, N) for the damage of hits.
        shot_roll: Uniform numbers (E, N) for the damage of shots.
        noise: Standard normal numbers (2, E, N) for the aim of shots.
        pillars: Positions of the pillars (2, 4), or None if no fight has any [m].
        blocks: Whether the site has pillars (N,) bool.
    """
    attacking = (s.phase == ACTIVE) & (s.enemy_hp > 0) & (s.hits_left > 0)
    kind = blow[KIND]
    to_player = s.position.unsqueeze(1) - s.enemy_position
    distance = to_player.square().sum(0).sqrt().clamp(min=1e-3)
    gap = distance - traits.radius - c.BODY_RADIUS
    ahead = (to_player * s.lock).sum(0) / distance >= c.CONE_COSINE
    low = s.enemy_z < c.REACHABLE_HEIGHT

    cone = (kind == CONE) & (gap < blow[FARTHEST] + c.CONE_MARGIN) & ahead
    charge = (kind == CHARGE) & (gap < c.CHARGE_GAP) & low
    area = (kind == AREA) & (gap < blow[FARTHEST] + c.AREA_MARGIN) & (s.timers[AIR] <= 0)
    safe = s.timers[SAFE] > 0
    reaches = attacking & (cone | charge | area)
    connects = reaches & ~safe
    weak = 1.0 - (1.0 - c.DRENCHED_DAMAGE) * s.state_timer[PURGEWATER].clamp(max=1.0)
    damage = traits.hit * blow[DAMAGE]
    direct = connects * damage * _spread(roll) * torch.where(kind == AREA, weak, 1.0)

    fires = _fire_shots(s, blow, attacking & (kind == RANGED), distance, noise, pillars, blocks)
    ranged = damage * _spread(shot_roll) * weak * (c.RANGED_REST + (1.0 - c.RANGED_REST) * strength)
    s.shot_damage = torch.where(fires, ranged, s.shot_damage)
    # An attack on an invulnerable player is spent, too: this is the purpose of a dodge.
    s.hits_left = s.hits_left - 1.0 * (reaches | fires.any(0))

    landing = s.land_timer == 1.0  # in this frame
    s.land_timer = (s.land_timer - 1.0).clamp(min=0.0)
    miss = (s.shot_point - s.position.view(2, 1, 1, -1)).square().sum(0)
    exposed = ~safe & (s.timers[SLIDE] <= 0)
    shots = s.shot_damage * (landing & (miss < c.SHOT_RADIUS**2) & exposed)

    # Only the worst hit of a frame counts, because a hit makes the player invulnerable for a moment.
    worst = torch.maximum(direct.amax(0), shots.amax((0, 1)))
    worst = torch.maximum(worst, self_damage * ~safe)
    worst = worst * (s.enemy_hp > 0).any(0)  # otherwise the fight is over
    charged = ((direct >= worst) & charge).any(0)
    _suffer(s, worst, charged)


def _spread(roll: Tensor) -> Tensor:
    return c.DAMAGE_LOW + (c.DAMAGE_HIGH - c.DAMAGE_LOW) * roll


def _fire_shots(
    s: State, blow: Tensor, firing: Tensor, distance: Tensor, noise: Tensor, pillars: Tensor | None, blocks: Tensor
) -> Tensor:
    """Fire the shots that are due in this frame; they are spread evenly over the active phase.

    Returns:
        Whether each slot is filled (4, E, N) bool.
    """
    shot = blow[SHOTS] - s.hits_left  # number of the next one
    elapsed = blow[ACTIVE_FRAMES] - s.phase_timer
    due = firing & (elapsed * blow[SHOTS] >= shot * blow[ACTIVE_FRAMES])
    flight = distance / c.SHOT_SPEED  # [s]
    lead = s.velocity.unsqueeze(1) * (c.SHOT_LEAD * flight)
    point = s.position.unsqueeze(1) + lead + c.SHOT_NOISE * noise  # (2, E, N)
    slots = torch.arange(c.SHOT_SLOTS, device=shot.device).view(-1, 1, 1)
    filled = due & (shot == slots)  # (4, E, N)
    s.shot_point = torch.where(filled, point.unsqueeze(1), s.shot_point)
    # Rounded up to whole frames, at least one.
    s.land_timer = torch.where(filled, (flight * c.FPS).ceil() + 1.0, s.land_timer)
    if pillars is not None:
        stopped = segment_blocked(s.enemy_position, point, pillars) & blocks
        s.land_timer = torch.where(filled & stopped, 0.0, s.land_timer)
    return filled


def segment_blocked(start: Tensor, end: Tensor, pillars: Tensor) -> Tensor:
    """Return whether a pillar is between two points.

    Args:
        start: (2, E, N) [m].
        end: (2, E, N) [m].
        pillars: (2, 4) centres of the pillars [m].

    Returns:
        (E, N) bool.
    """
    along = end - start
    length = along.square().sum(0).clamp(min=1e-6)
    x, y = pillars.view(2, -1, 1, 1)
    offset_x, offset_y = x - start[0], y - start[1]  # (4, E, N)
    share = ((offset_x * along[0] + offset_y * along[1]) / length).clamp(0.0, 1.0)
    miss = (offset_x - share * along[0]).square() + (offset_y - share * along[1]).square()
    return miss.amin(0) < c.PILLAR_RADIUS**2


def ray_blocked_at(position: Tensor, yaw: Tensor, pillars: Tensor) -> Tensor:
    """Return the distance at which level rays meet a pillar.

    Args:
        position: Start of the rays (2, N) [m].
        yaw: Direction of the rays, counter-clockwise from +x (N,) [rad].
        pillars: (2, 4) centres of the pillars [m].

    Returns:
        (N,) [m], infinity where a ray meets no pillar.
    """
    x, y = pillars.unsqueeze(-1)
    cos, sin = facing(yaw)
    offset_x, offset_y = x - position[0], y - position[1]  # (4, N)
    along = offset_x * cos + offset_y * sin
    inside = c.PILLAR_RADIUS**2 - (offset_x * sin - offset_y * cos).square()
    entry = along - inside.clamp(min=0.0).sqrt()
    return torch.where((inside > 0) & (along > 0), entry, torch.inf).amin(0)


def _suffer(s: State, hit: Tensor, charged: Tensor) -> None:
    """Apply a hit (N,) [HP] to the player's health, stagger and moment of invulnerability."""
    s.hp = (s.hp - hit).clamp(min=0.0)
    heavy = hit > c.HEAVY_HIT
    stagger = torch.where(charged, c.CHARGE_STAGGER_TIME * c.FPS, c.STAGGER_TIME * c.FPS) * heavy
    safe = torch.where(heavy, c.HEAVY_SAFE * c.FPS, c.LIGHT_SAFE * c.FPS) * (hit > 0)
    rows_where(s.timers, STAGGER, stagger > s.timers[STAGGER], stagger)
    rows_where(s.timers, SAFE, safe > s.timers[SAFE], safe)
