"""Intent of the player in a step, and the motion and camera of each frame."""

from dataclasses import dataclass

import torch
from torch import Tensor

from coachable.envs.combat import constants as c
from coachable.envs.combat.gamepad import Pad
from coachable.envs.combat.state import (
    AIR,
    BERRY,
    DODGE,
    HELPLESS,
    MELEE,
    NO_MOVE,
    RELOAD,
    ROOT,
    SAFE,
    SLIDE,
    SWAP,
    State,
    nearest,
    pick,
)
from coachable.envs.combat.tables import TRAPS, WEAPONS
from coachable.envs.combat.traits import (
    AMMO_SLOTS,
    BUILDUP,
    ELEMENTAL,
    IMPACT,
    MAGAZINE,
    TEAR,
    Traits,
)
from coachable.envs.combat.traits import RELOAD as RELOAD_FRAMES


@dataclass
class Intent:
    """Intent of the player, which is valid for all six frames of a step.

    Attributes:
        move: Left stick (2, N), of length 1 or less.
        speed: Speed at a full stick (N,) [m/s].
        turn: Turn of the camera per frame (N,) [rad].
        tilt: Tilt of the camera per frame (N,) [rad].
        aiming: Whether the player aims (N,) bool.
        shooting: Whether the player shoots (N,) bool.
        light: Whether the player starts a light swing of the spear (N,) bool.
        heavy: Whether the player starts a heavy swing of the spear (N,) bool.
        sprint: Whether the player sprints (N,) bool.
        ammo: Rows of `ammo_table` of the selected ammo (18, N).
        element: One-hot of its element (7, N).
        damage: Damage of one shot to the body, with the resistance (E, N) [HP].
        tear: Additional damage to parts (N,) [HP].
        buildup: Share of the threshold that one shot builds up (7, E, N), without the growth of shock's threshold.
        loaded: Rounds in the selected magazine (N,); it changes from frame to frame.
    """

    move: Tensor
    speed: Tensor
    turn: Tensor
    tilt: Tensor
    aiming: Tensor
    shooting: Tensor
    light: Tensor
    heavy: Tensor
    sprint: Tensor
    ammo: Tensor
    element: Tensor
    damage: Tensor
    tear: Tensor
    buildup: Tensor
    loaded: Tensor


def rows_where(timers: Tensor, row: int, mask: Tensor, value: Tensor | float) -> None:
    """Write a value to a row of a tensor in place, in some fights. No other object may hold the tensor.

    Args:
        timers: (R, N).
        row: Number of the row.
        mask: (N,) bool.
        value: (N,), or one number.
    """
    timers[row] = torch.where(mask, value, timers[row])


def facing(yaw: Tensor) -> Tensor:
    """Return the unit vectors (2, ...) of angles (...,) [rad]."""
    return torch.stack((yaw.cos(), yaw.sin()))


def from_stick(stick: Tensor, forward: Tensor) -> Tensor:
    """Convert a stick to a direction of the world.

    Args:
        stick: (2, N), x to the right and y forward.
        forward: Direction of the camera (2, N).

    Returns:
        (2, N).
    """
    x, y = stick
    fx, fy = forward
    return torch.stack((fx * y + fy * x, fy * y - fx * x))


def element_of(section: Tensor, ammo_table: Tensor) -> Tensor:
    """Return one-hots (7, N) of the elements of wheel sections (N,).

    Args:
        section: Wheel sections (N,) int64.
        ammo_table: Table of the ammunition, one row per section.

    Returns:
        One-hots (7, N).
    """
    return ammo_table[:, 11:].index_select(0, section).T


def command(s: State, pad: Pad, traits: Traits, site: Tensor, ammo_table: Tensor, sections: Tensor) -> Intent:
    """Apply the gamepad at the start of a step: weapon wheel, berries, tools, traps and evasions.

    Args:
        s: State; it changes.
        pad: Canonical actions with fields (N,) and sticks (2, N).
        traits: Traits of the machines.
        site: Rows of `site_table` (4, N).
        ammo_table: Result of `ammo_table`.
        sections: Result of `ammo_sections`.

    Returns:
        The intent for the frames of the step.
    """
    timers = s.timers.clone()
    wheel, aiming = pad.l1 > 0, pad.l2 > 0
    _choose_weapon(s, wheel, pad.right_stick, timers, sections)
    forward = facing(s.yaw)
    able = (timers[HELPLESS].amax(0) <= 0) & (s.hp > 0)
    _use_tools(s, pad, able, timers, forward)
    _evade(s, pad, able, timers, forward)

    row = s.weapon * AMMO_SLOTS + s.section
    ammo = ammo_table.index_select(0, row).T.contiguous()
    loaded = s.magazine.gather(0, row.unsqueeze(0))[0]
    empty = (loaded <= 0) & (timers[RELOAD] <= 0)
    rows_where(timers, RELOAD, empty, ammo[RELOAD_FRAMES])
    s.timers = timers

    length = pad.left_stick.square().sum(0).sqrt()
    sprint = (pad.l3 > 0) & ~aiming & (s.stamina > 0) & (length > c.STICK_REST)
    speed = torch.where(aiming, c.AIM_WALK, torch.where(sprint, c.SPRINT, c.RUN)) * site[1]
    rate = torch.where(aiming, c.AIM_TURN_RATE, c.TURN_RATE) * (1.0 - pad.l1) * c.DT
    curve = pad.right_stick.sign() * pad.right_stick.abs().pow(c.STICK_EXPONENT)
    element = ammo[11:]
    resisted = (element.unsqueeze(1) * traits.resistance).sum(0)  # (E, N)
    buildup = element.unsqueeze(1) * traits.resistance * (ammo[BUILDUP] / traits.threshold)

    technique = aiming & (pad.r1 > 0) & (s.weapon_stamina >= c.TECHNIQUE_COST) & (s.technique <= 0)
    s.technique = torch.where(technique, 1.0, s.technique)
    s.weapon_stamina = s.weapon_stamina - c.TECHNIQUE_COST * technique
    free = ~aiming & ~wheel & (s.hp > 0)
    return Intent(
        move=pad.left_stick / length.clamp(min=1.0),
        speed=speed,
        turn=-rate * curve[0],
        tilt=rate * c.PITCH_FACTOR * curve[1],
        aiming=aiming,
        shooting=aiming & (pad.r2 > 0) & (s.hp > 0),
        light=free & (pad.r1 > 0),
        heavy=free & (pad.r2 > 0),
        sprint=sprint,
        ammo=ammo,
        element=element,
        damage=ammo[IMPACT] + ammo[ELEMENTAL] * resisted,
        tear=c.TEAR_FACTOR * ammo[TEAR],
        buildup=buildup,
        loaded=loaded,
    )


def _choose_weapon(s: State, wheel: Tensor, stick: Tensor, timers: Tensor, sections: Tensor) -> None:
    """Apply the weapon wheel: six sectors of 60 degrees, counter-clockwise from the right, with sections of ammo."""
    x, y = stick
    pointing = wheel & (stick.square().sum(0) > c.WHEEL_REACH**2)
    turns = torch.remainder(torch.atan2(y, x) / (2.0 * torch.pi), 1.0) * len(WEAPONS)
    sector = turns.floor().clamp(0, len(WEAPONS) - 1)
    weapon = torch.where(pointing, sector.long(), s.weapon)
    offered = sections[weapon]
    section = torch.minimum(((turns - sector) * offered).floor().long(), offered - 1)
    section = torch.where(pointing, section, s.section)
    changed = (weapon != s.weapon) | (section != s.section)
    rows_where(timers, SWAP, changed, c.SWAP_TIME * c.FPS)
    rows_where(timers, RELOAD, changed, 0.0)
    s.weapon, s.section = weapon, section


def _use_tools(s: State, pad: Pad, able: Tensor, timers: Tensor, forward: Tensor) -> None:
    """Apply berries, the tool menu, and traps, which are set ahead of the player."""
    eats = able & (pad.up > 0) & (s.hp < c.PLAYER_HP) & (s.berries > 0) & (timers[BERRY] <= 0)
    s.hp = torch.where(eats, (s.hp + c.BERRY_HP).clamp(max=c.PLAYER_HP), s.hp)
    s.berries = s.berries - 1.0 * eats
    rows_where(timers, BERRY, eats, c.BERRY_COOLDOWN * c.FPS)

    s.tool = torch.remainder(s.tool + pad.right.long() - pad.left.long(), len(TRAPS))
    selected = s.tool == torch.arange(len(TRAPS), device=s.tool.device).unsqueeze(1)  # (4, N)
    free = s.trap_type < 0
    slot = free & (free.cumsum(0) == 1)  # the first free one
    in_stock = (s.inventory * selected).sum(0) > 0
    sets = able & (pad.down > 0) & (timers[NO_MOVE].amax(0) <= 0) & in_stock & free.any(0)
    s.inventory = s.inventory - 1.0 * (selected & sets)
    place = slot & sets
    s.trap_position = torch.where(place, (s.position + c.TRAP_AHEAD * forward).unsqueeze(1), s.trap_position)
    s.trap_type = torch.where(place, s.tool.float(), s.trap_type)
    s.trap_arm = torch.where(place, c.TRAP_ARM * c.FPS, s.trap_arm)
    rows_where(timers, ROOT, sets, c.TRAP_ROOT * c.FPS)


def _evade(s: State, pad: Pad, able: Tensor, timers: Tensor, forward: Tensor) -> None:
    """Start a dodge (square), slide (circle) or jump (cross), one at a time."""
    ready = able & (timers[NO_MOVE].amax(0) <= 0)
    dodges = ready & (pad.square > 0) & (s.stamina >= c.DODGE_COST)
    slides = ready & (pad.circle > 0)
    jumps = ready & (pad.cross > 0)
    length = pad.left_stick.square().sum(0).sqrt()
    steered = from_stick(pad.left_stick / length.clamp(min=c.STICK_REST), forward)
    # Without a direction a dodge goes backwards and a slide forwards.
    neutral = torch.where(dodges, -forward, forward)
    direction = torch.where(length > c.STICK_REST, steered, neutral)
    s.dodge = torch.where(dodges | slides, direction, s.dodge)
    s.stamina = s.stamina - c.DODGE_COST * dodges
    rows_where(timers, DODGE, dodges, c.DODGE_TIME * c.FPS)
    rows_where(timers, SLIDE, slides, c.SLIDE_TIME * c.FPS)
    rows_where(timers, AIR, jumps, c.JUMP_TIME * c.FPS)
    rows_where(timers, SAFE, dodges, timers[SAFE].clamp(min=c.DODGE_SAFE * c.FPS))


def run_timers(s: State, intent: Intent) -> None:
    """Advance the timers, reloading and regeneration by one frame.

    Args:
        s: State, changed in place.
        intent: What the players want; `loaded` is set when reloading ends.
    """
    reloading = s.timers[RELOAD] > 0
    s.timers = (s.timers - 1.0).clamp(min=0.0)
    finished = reloading & (s.timers[RELOAD] <= 0)
    intent.loaded = torch.where(finished, intent.ammo[MAGAZINE], intent.loaded)
    gain = torch.where(intent.sprint, -c.SPRINT_COST * c.DT, c.STAMINA_GAIN * c.DT)
    s.stamina = (s.stamina + gain).clamp(0.0, c.STAMINA)
    s.weapon_stamina = (s.weapon_stamina + c.WEAPON_STAMINA_GAIN * c.DT).clamp(max=c.WEAPON_STAMINA)


def move_player(s: State, intent: Intent, traits: Traits, site: Tensor) -> None:
    """Advance walking, dodging or sliding by one frame; walls and bodies stop the player.

    Args:
        s: State, changed in place.
        intent: What the players want.
        traits: Traits of the machines.
        site: Rows of `site_table` (4, N).
    """
    direction = from_stick(intent.move, facing(s.yaw))
    swinging, helpless = s.timers[MELEE] > 0, s.timers[HELPLESS].amax(0) > 0
    speed = intent.speed * torch.where(swinging, c.SWING_FACTOR, 1.0)
    wanted = direction * torch.where(helpless, 0.0, speed)
    velocity = torch.lerp(s.velocity, wanted, site[0])
    evading = torch.where(s.timers[DODGE] > 0, c.DODGE_SPEED, c.SLIDE_SPEED) * s.dodge
    in_motion = (s.timers[DODGE] > 0) | (s.timers[SLIDE] > 0)
    s.velocity = torch.where(in_motion, evading, velocity)
    position = inside_wall(s.position + c.DT * s.velocity, site)
    second = nearest(s)  # the player is moved out of its body
    offset = position - pick(s.enemy_position, second)
    distance, space = offset.square().sum(0).sqrt().clamp(min=1e-3), pick(traits.radius, second) + c.BODY_RADIUS
    solid = pick(s.enemy_hp, second) > 0
    s.position = position + offset * torch.where(solid, (space / distance - 1.0).clamp(min=0.0), 0.0)


def inside_wall(position: Tensor, site: Tensor) -> Tensor:
    """Return positions (2, ..., N) moved inside the site's wall.

    Args:
        position: (2, ..., N) [m].
        site: Rows of `site_table` (4, N).

    Returns:
        (2, ..., N) [m].
    """
    return position * (site[3] / position.square().sum(0).sqrt().clamp(min=1.0)).clamp(max=1.0)


def turn_camera(s: State, intent: Intent, cone: float, share: float, bearing: Tensor, elevation: Tensor) -> None:
    """Advance the camera by one frame, with the aim assist.

    Args:
        s: State; it changes.
        intent: Intent of the step.
        cone: Yaw error within which the assist acts [rad].
        share: Share of the error that the assist removes per frame; 0 switches it off.
        bearing: Direction of the nearest enemy's body centre in the world (N,) [rad].
        elevation: Elevation of this centre above the horizon, from the eye (N,) [rad].
    """
    yaw, pitch = s.yaw + intent.turn, s.pitch + intent.tilt
    if share > 0:
        error = wrap(bearing - yaw)
        pull = torch.where(intent.aiming & (error.abs() < cone), share, 0.0)
        yaw = yaw + pull * error
        pitch = pitch + pull * (elevation - pitch)
    s.yaw, s.pitch = yaw, pitch.clamp(-c.PITCH_MAX, c.PITCH_MAX)


def wrap(angle: Tensor) -> Tensor:
    """Wrap angles (any shape) to [-pi, pi) [rad]."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi
