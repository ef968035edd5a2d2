"""The six frames of 1/30 s of a step of N fights, with the same state of the gamepad."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from coachable.envs.combat import constants as c
from coachable.envs.combat.damage import (
    ACID,
    BURNING,
    ElementNumbers,
    Totals,
    build_up,
    damage_parts,
    hit_factor,
    run_elements,
    shoot,
    swing,
    take_damage,
)
from coachable.envs.combat.machine import (
    decide,
    move_machines,
    ranged_strength,
    ray_blocked_at,
    strike_player,
)
from coachable.envs.combat.player import Intent, move_player, run_timers, turn_camera
from coachable.envs.combat.state import FROM_TRAP, State, nearest, pick
from coachable.envs.combat.tables import ATTACK_SLOTS, PART_SLOTS
from coachable.envs.combat.traits import Traits
from coachable.envs.combat.traps import TrapNumbers, burn_player, leave_zone, spring_traps


@dataclass
class Noise:
    """Random numbers of one step.

    Attributes:
        spread: Standard normal numbers (6, 2, N) for the aim of the player's shots.
        aim: Standard normal numbers (6, 2, E, N) for the aim of the machines' shots.
        flip: Uniform numbers (6, E, N) for changes of the strafing direction.
        shot: Uniform numbers (6, E, N) for the damage of the machines' shots.
        choice: Uniform numbers (4, E, N) for the choice of the attack. One per step is enough, because an attack lasts
            longer than a step.
        pause: Uniform numbers (E, N) for the pause after an attack.
        hit: Uniform numbers (E, N) for the damage of a hit.
    """

    spread: Tensor
    aim: Tensor
    flip: Tensor
    shot: Tensor
    choice: Tensor
    pause: Tensor
    hit: Tensor

    @classmethod
    def draw(cls, enemies: int, n: int, generator: torch.Generator) -> Noise:
        """Draw the numbers of a step; their count depends only on the numbers of enemies and of fights `n`."""
        frames, device = c.FRAMES_PER_STEP, generator.device
        normal = torch.randn((frames, 2 + 2 * enemies, n), generator=generator, device=device)
        uniform = torch.rand((2 * frames + ATTACK_SLOTS + 2, enemies, n), generator=generator, device=device)
        flip, shot, choice, pause, hit = uniform.split((frames, frames, ATTACK_SLOTS, 1, 1))
        aim = normal[:, 2:].unflatten(1, (2, enemies))
        return cls(normal[:, :2], aim, flip, shot, choice, pause[0], hit[0])


@dataclass
class Rules:
    """Quantities that stay the same over a step.

    Attributes:
        traits: Traits of the machines.
        site: Rows of `site_table` (4, N).
        elements: Result of `ElementNumbers.load`.
        traps: Result of `TrapNumbers.of`, or None if there are no traps.
        pillars: Positions of the pillars (2, 4), or None if no fight has any [m].
        assist: Cone [rad] and share per frame of the aim assist.
    """

    traits: Traits
    site: Tensor
    elements: ElementNumbers
    traps: TrapNumbers | None
    pillars: Tensor | None
    assist: tuple[float, float]


def run_frames(s: State, intent: Intent, rules: Rules, noise: Noise) -> Totals:
    """Advance the fights by all frames of a step; `s` and `intent.loaded` change in place.

    Args:
        s: State, changed in place.
        intent: What the players want; `loaded` changes in place.
        rules: Rules of the fights.
        noise: Random numbers of the step.

    Returns:
        Damage of the step.
    """
    totals = Totals.zeros(s.enemy_hp, PART_SLOTS)
    strength = ranged_strength(s, rules.traits)
    for frame in range(c.FRAMES_PER_STEP):
        _run_frame(s, intent, rules, totals, strength, noise, frame)
    return totals


def _run_frame(
    s: State, intent: Intent, rules: Rules, totals: Totals, strength: Tensor, noise: Noise, frame: int
) -> None:
    """Advance the fights by one frame: the player, its attacks, the machines, and theirs."""
    traits, site = rules.traits, rules.site
    run_timers(s, intent)
    move_player(s, intent, traits, site)

    relative = s.enemy_position - s.position.unsqueeze(1)  # (2, E, N)
    distance = relative.square().sum(0).sqrt().clamp(min=1e-3)
    second = nearest(s)
    x, y = pick(relative, second)
    rise = pick(s.enemy_z + traits.radius, second) - c.EYE_HEIGHT
    turn_camera(s, intent, *rules.assist, torch.atan2(y, x), torch.atan2(rise, pick(distance, second)))

    blocked_at, blocks = torch.full_like(s.yaw, torch.inf), site[2] > 0
    if rules.pillars is not None:
        level = ray_blocked_at(s.position, s.yaw, rules.pillars)
        blocked_at = torch.where(blocks, level / s.pitch.cos(), torch.inf)
    factor = hit_factor(s, rules.elements)
    hit, body, parts = shoot(s, intent, traits, relative, distance, noise.spread[frame], blocked_at)
    by_shot = intent.damage * body
    bursts = damage_parts(s, traits, (intent.damage + intent.tear) * factor * parts, totals)
    by_shot = (by_shot + bursts * (c.BURST_DAMAGE + c.BURST_SHARE * traits.hp)) * factor
    build_up(s, intent.buildup * hit, s.weapon.float(), totals)
    by_spear = swing(s, intent, traits) * factor

    by_trap, self_damage = torch.zeros_like(by_spear), torch.zeros_like(s.hp)
    if rules.traps is not None:
        by_trap, gain, self_damage = spring_traps(s, traits, rules.traps)
        by_trap = by_trap * factor
        build_up(s, gain, FROM_TRAP, totals)
    burns = burn_player(s)

    active, over_time, burst, shocked = run_elements(s, rules.elements, traits, totals)
    raw = torch.stack((by_shot, by_spear, by_trap, over_time[ACID], over_time[BURNING], burst))
    take_damage(s, raw, active, burst, totals)

    gap = distance - traits.radius - c.BODY_RADIUS
    blow, zone = decide(s, traits, strength, gap, shocked, noise.choice, noise.pause)
    leave_zone(s, zone)
    move_machines(s, traits, site, blow, noise.flip[frame])
    burns = burns * (s.enemy_hp > 0).any(0)  # otherwise the fight is over
    s.hp = (s.hp - burns).clamp(min=0.0)
    strike_player(
        s, traits, blow, strength, self_damage, noise.hit, noise.shot[frame], noise.aim[frame], rules.pillars, blocks
    )
