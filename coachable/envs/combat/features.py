"""Observations in named groups, aligned with the camera and roughly within [-1, 1] (paper, Appendix C)."""

from dataclasses import replace

import torch
from torch import Tensor

from coachable.envs.combat import constants as c
from coachable.envs.combat.player import facing, wrap
from coachable.envs.combat.state import (
    ACTIVE,
    AIR,
    DODGE,
    FIRE,
    IDLE,
    NUM_PHASES,
    RELOAD,
    STAGGER,
    STAGGERED,
    SWAP,
    State,
    nearest,
    pick,
)
from coachable.envs.combat.tables import ATTACK_SLOTS, ELEMENTS, PART_SLOTS, SITES, TRAPS, WEAPONS
from coachable.envs.combat.traits import AMMO_SLOTS, HIDDEN, INTERVAL, MACHINE_NAMES, MAGAZINE, Traits
from coachable.envs.combat.traits import RELOAD as RELOAD_FRAMES
from coachable.signals import Signal

SMALL_PARTS = 4
_SPEED_SCALE, _TIMER_SCALE = 0.1, 0.5 / c.FPS  # per m/s, per frame
_HP_MAX = 8500.0  # [HP], the strongest machine of the paper
_LONGEST_STATE = 14.0 * c.FPS  # [frames]
_ENCODED = 6

_PLACE = ("forward", "left", "up", "sine", "slow_sine", "slowest_sine")  # entries of `encode_position`
_AT = f"{c.FPS * 2:g} frames"
_SPEED = f"{1 / _SPEED_SCALE:g} m/s"

# Names are the rows of the paper's importance tables; stamina, type and resistances are ours.
_PLAYER = (
    Signal("Player health", 1, "full health"),
    Signal("Quick-tool: health bucket", 2, "full", ("berries", "missing_health")),
    Signal("Weapon technique stamina", 1, "full stamina"),
    Signal("Active weapon technique", 1),
    Signal("Player stamina", 1, "full stamina"),
    Signal(
        "Player pose",
        7,
        (_SPEED, _SPEED, "", "", _AT, _AT, _AT),
        ("forward_speed", "left_speed", "pitch_sine", "pitch_cosine", "in_air", "dodging", "staggered"),
    ),
    Signal("Player game state", 12),
    Signal("Active weapon + ammo", 21),
    Signal("Weapon wheel open", 2, "", ("wheel", "quick")),
)
_TRAPS = Signal("Traps: pose + inventory", c.TRAP_SLOTS * (_ENCODED + 5) + 8)
_PLACES = (
    Signal("Anchor pose", 7, (*[""] * 6, f"{c.BOUND_RADIUS:g} m"), (*_PLACE, "distance")),
    Signal("Ejectors: pose + duration", c.HAZARD_SLOTS * 8),
)


def _enemy(small: bool) -> list[Signal]:
    parts = SMALL_PARTS if small else PART_SLOTS
    pose = ("bearing", "pitch_error", "heading_forward", "heading_left", "forward_speed", "left_speed", "radius")
    return [
        Signal("Enemy pose", 13, (*[""] * 6, "pi", "pi", "", "", _SPEED, _SPEED, "2.6 m"), (*_PLACE, *pose)),
        Signal("Enemy health", 2, ("full health", f"{_HP_MAX:g} HP, square root"), ("share", "health")),
        *([] if small else [Signal("Enemy type", len(MACHINE_NAMES), "", tuple(MACHINE_NAMES))]),
        Signal("Enemy resistances", len(ELEMENTS), "factor 2", ELEMENTS),
        Signal(
            "Enemy elemental status",
            2 * len(ELEMENTS),
            (*["full gauge"] * len(ELEMENTS), *[f"{_LONGEST_STATE:g} frames"] * len(ELEMENTS)),
            (*(f"{e}_gauge" for e in ELEMENTS), *(f"{e}_left" for e in ELEMENTS)),
        ),
        Signal("Enemy attack state", NUM_PHASES + 1 + ATTACK_SLOTS + 2),
        Signal("Enemy game state", 3, "", ("staggered", "weak", "living")),
        Signal("Enemy parts pose", parts * _ENCODED),
        Signal("Enemy parts health", parts * 5),
    ]


def observation_groups(observation: str) -> tuple[Signal, ...]:
    """Return the blocks of the observation, in order.

    Enemies are sorted by distance; the names of the second one's groups end in "2".

    Args:
        observation: "full" (629 numbers) or "small" (190).

    Raises:
        ValueError: If it is neither.
    """
    if observation == "small":
        return (*_PLAYER, *_PLACES, *_enemy(True), Signal("Action history", 24))
    if observation != "full":
        raise ValueError(f"observation is {observation!r}: expected 'full' or 'small'")
    second = [replace(group, name=f"{group.name} 2") for group in _enemy(False)]
    histories = Signal("Action history", 72), Signal("Feature history", 24)
    return (*_PLAYER, _TRAPS, *_PLACES, *_enemy(False), *second, *histories)


def observation_size(observation: str) -> int:
    """Return the width of the observation."""
    return sum(group.width for group in observation_groups(observation))


def encode_position(offset: Tensor) -> Tensor:
    """Encode offsets (3, ..., N) [m] as (6, ..., N): x/d, y/d, z/d, sin d, sin 0.1 d, sin 0.01 d (Appendix C)."""
    distance = offset.square().sum(0, keepdim=True).sqrt().clamp(min=1e-3)
    return torch.cat([offset / distance, distance.sin(), (0.1 * distance).sin(), (0.01 * distance).sin()])


def _to_camera(vector: Tensor, axes: Tensor) -> Tensor:
    """Rotate world vectors (2, ..., N) to the camera's forward and left directions, from its forward one (2, N)."""
    x, y = vector
    fx, fy = axes
    return torch.stack((fx * x + fy * y, fx * y - fy * x))


def _ground(position: Tensor, s: State, axes: Tensor) -> Tensor:
    """Encode positions on the ground (2, k, N) or (2, N) relative to the eye."""
    own = s.position.view(2, *[1] * (position.ndim - 2), -1)
    flat = _to_camera(position - own, axes)
    return encode_position(torch.cat([flat, torch.full_like(flat[:1], -c.EYE_HEIGHT)]))


def one_hot_rows(index: Tensor, size: int) -> Tensor:
    """Return the one-hots (size, ..., N) of indices (..., N).

    Args:
        index: Indices (..., N).
        size: Number of values.

    Returns:
        (size, ..., N) float32.
    """
    return (index == torch.arange(size, device=index.device).view(-1, *[1] * index.ndim)).float()


def _body(s: State, traits: Traits, axes: Tensor) -> Tensor:
    """Return the centres of the machines relative to the eye (3, E, N), aligned with the camera [m]."""
    flat = _to_camera(s.enemy_position - s.position.unsqueeze(1), axes)
    return torch.cat([flat, (s.enemy_z + traits.radius - c.EYE_HEIGHT).unsqueeze(0)])


def _attack_id(s: State, traits: Traits) -> Tensor:
    """Return the one-hot (4, E, N) of the current attack; it is zero if there is none or if it is hidden."""
    hidden = traits.attacks[HIDDEN].gather(0, s.attack.unsqueeze(0))[0]
    shown = (s.phase > IDLE) & (s.phase < STAGGERED) & (hidden <= 0) & (s.enemy_hp > 0)
    return one_hot_rows(s.attack, ATTACK_SLOTS) * shown


def kept_features(s: State, traits: Traits) -> Tensor:
    """Return what the feature history keeps of a state: place of the nearest enemy, both healths and the attack.

    Returns:
        (12, N).
    """
    second = nearest(s)
    return torch.cat(
        [
            encode_position(pick(_body(s, traits, facing(s.yaw)), second)),
            (s.hp / c.PLAYER_HP).unsqueeze(0),
            pick(s.enemy_hp / traits.hp, second).unsqueeze(0),
            pick(_attack_id(s, traits), second),
        ]
    )


def observe(s: State, traits: Traits, ammo: Tensor, observation: str, episode_steps: int) -> Tensor:
    """Return the observation (N, 629) or (N, 190) of a state.

    Args:
        s: State.
        traits: Traits of the machines.
        ammo: Rows of `ammo_table` of the selected ammo (18, N).
        observation: "full" or "small".
        episode_steps: Length of an episode in steps.
    """
    axes, small = facing(s.yaw), observation == "small"
    rows = [_player_rows(s, ammo, axes, episode_steps)]
    if not small:
        rows += _trap_rows(s, axes)
    rows += _place_rows(s, axes)
    enemies = _enemy_rows(s, traits, axes, small)  # (F, E, N)
    if enemies.shape[1] > 1:
        enemies = torch.where(nearest(s), enemies.flip(1), enemies)
    rows.append(enemies[:, 0])
    if not small:
        rows.append(enemies[:, 1] if enemies.shape[1] > 1 else torch.zeros_like(enemies[:, 0]))
        rows += [s.actions, s.features]
    else:
        rows.append(s.actions[:24])
    return torch.cat(rows).T.contiguous()


def _player_rows(s: State, ammo: Tensor, axes: Tensor, episode_steps: int) -> Tensor:
    timers = s.timers * _TIMER_SCALE
    magazine = s.magazine.gather(0, (s.weapon * AMMO_SLOTS + s.section).unsqueeze(0))[0]
    others = [timer for i, timer in enumerate(timers) if i not in (AIR, DODGE, STAGGER)]
    element = ammo[11:]
    rows = [
        s.hp / c.PLAYER_HP,
        s.berries / c.BERRIES,
        (s.berries > 0) * (1.0 - s.hp / c.PLAYER_HP),
        s.weapon_stamina / c.WEAPON_STAMINA,
        s.technique,
        s.stamina / c.STAMINA,
        *(_to_camera(s.velocity, axes) * _SPEED_SCALE),
        s.pitch.sin(),
        s.pitch.cos(),
        timers[AIR],
        timers[DODGE],
        timers[STAGGER],
        *others,
        *one_hot_rows(s.site, len(SITES)),
        (s.steps / episode_steps).clamp(max=1.0),  # live fights have no limit
        *one_hot_rows(s.weapon, len(WEAPONS)),
        *one_hot_rows(s.section, AMMO_SLOTS),
        *element,
        1.0 - element.sum(0),
        magazine / ammo[MAGAZINE],
        (s.timers[FIRE] / ammo[INTERVAL]).clamp(max=1.0),  # may be another weapon's
        s.timers[SWAP] / (c.SWAP_TIME * c.FPS),
        s.timers[RELOAD] / ammo[RELOAD_FRAMES],
        s.wheel,
        s.quick,
    ]
    return torch.stack(rows)


def _trap_rows(s: State, axes: Tensor) -> list[Tensor]:
    is_set = (s.trap_type >= 0).float()  # (4, N)
    place = _ground(s.trap_position, s, axes) * is_set
    kind = one_hot_rows(s.trap_type, len(TRAPS))
    armed = (s.trap_arm <= 0) * is_set
    each = torch.cat([place, kind, armed.unsqueeze(0)])  # (11, 4, N)
    return [each.transpose(0, 1).flatten(0, 1), s.inventory * 0.1, one_hot_rows(s.tool, len(TRAPS))]


def _place_rows(s: State, axes: Tensor) -> list[Tensor]:
    away = (s.position - s.anchor).square().sum(0, keepdim=True).sqrt() / c.BOUND_RADIUS
    burning = (s.hazard_timer > 0).float()
    zones = _ground(s.hazard_position, s, axes) * burning
    left = (s.hazard_timer / (c.HAZARD_TIME * c.FPS)).unsqueeze(0)
    each = torch.cat([zones, burning.unsqueeze(0) * (c.HAZARD_RADIUS / 10.0), left])  # (8, 2, N)
    return [_ground(s.anchor, s, axes), away, each.transpose(0, 1).flatten(0, 1)]


def _enemy_rows(s: State, traits: Traits, axes: Tensor, small: bool) -> Tensor:
    body = _body(s, traits, axes)
    distance = body[:2].square().sum(0).sqrt()
    bearing = torch.atan2(body[1], body[0])
    pitch_error = wrap(torch.atan2(body[2], distance) - s.pitch)
    living = (s.enemy_hp > 0).float()
    rows = [
        encode_position(body),
        torch.stack((bearing, pitch_error)) / torch.pi,
        _to_camera(facing(s.enemy_yaw), axes),
        _to_camera(s.enemy_velocity, axes) * _SPEED_SCALE,
        traits.radius.unsqueeze(0) / 2.6,
        torch.stack((s.enemy_hp / traits.hp, (s.enemy_hp / _HP_MAX).sqrt())),
        *([] if small else [one_hot_rows(s.machine, len(MACHINE_NAMES))]),
        torch.log2(traits.resistance),
        s.gauge,
        s.state_timer / _LONGEST_STATE,
        one_hot_rows(s.phase, NUM_PHASES) * living,
        (s.phase_timer.clamp(0.0, 2.0 * c.FPS) * (s.phase > IDLE) * _TIMER_SCALE).unsqueeze(0),
        _attack_id(s, traits),
        _to_camera(s.lock, axes) * (s.phase == ACTIVE),
        torch.stack((1.0 * (s.phase == STAGGERED), 1.0 * (3.0 * s.enemy_hp < traits.hp), living)),
    ]
    return torch.cat([*rows, *_part_rows(s, traits, body, axes, small)])


def _part_rows(s: State, traits: Traits, body: Tensor, axes: Tensor, small: bool) -> list[Tensor]:
    heading = _to_camera(facing(s.enemy_yaw), axes)  # (2, E, N)
    x, y, z = traits.offset
    place = torch.stack(
        (
            body[0] + heading[0] * x - heading[1] * y,
            body[1] + heading[1] * x + heading[0] * y,
            body[2] + z,
        )
    )
    present = s.count.clamp(max=1.0)  # (12, E, N)
    share = present * s.part_hp / traits.unit_hp.clamp(min=1e-6)
    looks = torch.cat([share.unsqueeze(0), 0.1 * s.count.unsqueeze(0), traits.part_type * present])  # (5, 12, E, N)
    if small:
        order = (place.square().sum(0) + 1e6 * (1.0 - present)).topk(SMALL_PARTS, dim=0, largest=False).indices
        place, looks = (t.gather(1, order.expand(t.shape[0], *order.shape)) for t in (place, looks))
        present = present.gather(0, order)
    where = encode_position(place) * present
    return [where.transpose(0, 1).flatten(0, 1), looks.transpose(0, 1).flatten(0, 1)]
