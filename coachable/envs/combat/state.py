"""State of N fights against E machines as a structure of tensors.

The fights are the last dimension, so that every number is one dense row. Timers count frames of 1/30 s and are 0 when
they are not running.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from coachable.envs.combat import constants as c
from coachable.envs.combat.tables import ATTACK_SLOTS, ELEMENTS, TRAPS, WEAPONS
from coachable.envs.combat.traits import AMMO_SLOTS, Traits

# Rows of `State.timers`, in an order in which the timers that block a shot, a swing, a dodge or a step are one slice.
FIRE, SWAP, RELOAD, MELEE, DODGE, STAGGER, ROOT, SLIDE, AIR, SAFE, BERRY = range(11)
NUM_TIMERS = 11
NO_SHOT, NO_SWING, NO_MOVE, HELPLESS = slice(FIRE, SLIDE), slice(MELEE, AIR), slice(DODGE, SAFE), slice(STAGGER, SLIDE)

# Values of `State.phase`.
IDLE, TELEGRAPH, ACTIVE, RECOVER, STAGGERED = range(5)
NUM_PHASES = 5

# Values of `State.source` beside the numbers of the weapons.
FROM_MELEE, FROM_TRAP = len(WEAPONS), len(WEAPONS) + 1
NUM_SOURCES = len(WEAPONS) + 2

ACTION_HISTORY, FEATURE_HISTORY, FEATURES_KEPT = 3, 2, 12


@dataclass
class State:
    """State of N fights against E enemies, which together with the random generator determines the next step.

    Attributes:
        position, velocity: (2, N) of the player [m], [m/s].
        yaw, pitch: (N,) of the camera, counter-clockwise from +x and upwards [rad].
        hp, stamina, weapon_stamina, berries: (N,).
        inventory: (4, N) traps of each type.
        tool, weapon, section: (N,) int64, selected trap type, weapon and ammo.
        magazine: (18, N) rounds by wheel section, three rows per weapon.
        timers: (11, N), rows above [frames].
        technique: (N,) 1 while the next shot deals double damage.
        dodge: (2, N) direction of the running dodge or slide.
        wheel, quick: (N,) 1 if shown in the last step.
        sticks: (4, N) right stick of the last step and of the one before.
        anchor: (2, N) centre of the Dynamic Anchor Bound [m].
        distance: (N,) to the nearest enemy after the last step [m].
        closeness: (2, N) of the nearest enemy and of the player to a set trap.
        steps: (N,) since the reset.
        site: (N,) int64.
        machine: (E, N) int64.
        enemy_position, enemy_velocity: (2, E, N) [m], [m/s].
        enemy_z, enemy_yaw, enemy_hp: (E, N) [m], [rad], [HP].
        phase, phase_timer: (E, N); the timer in frames.
        attack: (E, N) int64, attack slot.
        cooldown: (4, E, N) of the slots [frames].
        pause: (E, N) until the next attack may start [frames].
        lock: (2, E, N) locked direction.
        hits_left: (E, N) of the running attack.
        stagger_sum: (E, N) damage since the last stagger [HP].
        strafe: (E, N) +1 or -1.
        gauge: (7, E, N) build-up of each element, in [0, 1).
        state_timer: (7, E, N) of each elemental state [frames].
        source: (7, E, N) latest source of the element's build-up.
        plasma_store, shock_growth: (E, N) [HP], factor on shock's threshold.
        count, part_hp: (12, E, N) units left of each part, health of the current one.
        land_timer, shot_damage: (4, E, N) of the machine's shots in the air [frames], [HP].
        shot_point: (2, 4, E, N) places where they land [m].
        trap_position: (2, 4, N) [m]. trap_type: (4, N), -1 where none is set. trap_arm: (4, N) [frames].
        hazard_position: (2, 2, N) [m]. hazard_timer: (2, N) [frames].
        actions: (72, N) canonical actions of the last three steps, newest first.
        features: (24, N) `features.kept_features` of the last two steps, newest first.
    """

    position: Tensor
    velocity: Tensor
    yaw: Tensor
    pitch: Tensor
    hp: Tensor
    stamina: Tensor
    weapon_stamina: Tensor
    berries: Tensor
    inventory: Tensor
    tool: Tensor
    weapon: Tensor
    section: Tensor
    magazine: Tensor
    timers: Tensor
    technique: Tensor
    dodge: Tensor
    wheel: Tensor
    quick: Tensor
    sticks: Tensor
    anchor: Tensor
    distance: Tensor
    closeness: Tensor
    steps: Tensor
    site: Tensor
    machine: Tensor
    enemy_position: Tensor
    enemy_velocity: Tensor
    enemy_z: Tensor
    enemy_yaw: Tensor
    enemy_hp: Tensor
    phase: Tensor
    phase_timer: Tensor
    attack: Tensor
    cooldown: Tensor
    pause: Tensor
    lock: Tensor
    hits_left: Tensor
    stagger_sum: Tensor
    strafe: Tensor
    gauge: Tensor
    state_timer: Tensor
    source: Tensor
    plasma_store: Tensor
    shock_growth: Tensor
    count: Tensor
    part_hp: Tensor
    land_timer: Tensor
    shot_damage: Tensor
    shot_point: Tensor
    trap_position: Tensor
    trap_type: Tensor
    trap_arm: Tensor
    hazard_position: Tensor
    hazard_timer: Tensor
    actions: Tensor
    features: Tensor

    def tensors(self) -> dict[str, Tensor]:
        """Return the fields by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def replaced_where(self, mask: Tensor, other: State) -> State:
        """Return `other` in the fights where `mask` (N,) holds, and this state elsewhere."""
        theirs = other.tensors()
        return State(**{name: torch.where(mask, theirs[name], mine) for name, mine in self.tensors().items()})


def nearest(state: State) -> Tensor:
    """Return whether the second enemy is the nearest living one, (N,) bool; it is False if there is one enemy."""
    if state.enemy_hp.shape[0] == 1:
        return torch.zeros_like(state.hp, dtype=torch.bool)
    offset = state.enemy_position - state.position.unsqueeze(1)
    squared = offset.square().sum(0) + 1e6 * (state.enemy_hp <= 0)
    return squared[-1] < squared[0]


def pick(values: Tensor, second: Tensor) -> Tensor:
    """Return the values (..., N) of the enemy that `nearest` chose from (..., E, N)."""
    return values[..., 0, :] if values.shape[-2] == 1 else torch.where(second, values[..., 1, :], values[..., 0, :])


def start_fights(
    machine: Tensor, site: Tensor, traits: Traits, magazines: Tensor, traps: float, generator: torch.Generator
) -> State:
    """Draw new fights with random positions, orientations, weapons and cooldowns (paper: spawns within 25 m).

    Args:
        machine: Machine numbers (E, N) int64.
        site: Site numbers (N,) int64.
        traits: Traits of these machines.
        magazines: Capacities of the magazines (18, 1).
        traps: Number of traps of each type in the inventory.
        generator: Random generator; the count of numbers drawn depends on the shapes only.
    """
    device, (enemies, n) = machine.device, machine.shape

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand((*shape, n), generator=generator, device=device)

    def zeros(*shape: int) -> Tensor:
        return torch.zeros((*shape, n), device=device)

    def ints(high: int, *shape: int) -> Tensor:
        return torch.randint(high, (*shape, n), generator=generator, device=device)

    position, enemy_position = _spawn(enemies, uniform)
    weapon = ints(len(WEAPONS))
    distance = (enemy_position - position.unsqueeze(1)).square().sum(0).sqrt().amin(0)
    return State(
        position=position,
        velocity=zeros(2),
        yaw=uniform(-torch.pi, torch.pi),
        pitch=zeros(),
        hp=zeros() + c.PLAYER_HP,
        stamina=zeros() + c.STAMINA,
        weapon_stamina=zeros() + c.WEAPON_STAMINA,
        berries=zeros() + c.BERRIES,
        inventory=zeros(len(TRAPS)) + traps,
        tool=torch.zeros(n, dtype=torch.int64, device=device),
        weapon=weapon,
        section=torch.zeros_like(weapon),
        magazine=magazines.expand(len(WEAPONS) * AMMO_SLOTS, n).clone(),
        timers=zeros(NUM_TIMERS),
        technique=zeros(),
        dodge=zeros(2),
        wheel=zeros(),
        quick=zeros(),
        sticks=zeros(4),
        anchor=position.clone(),
        distance=distance,
        closeness=zeros(2),
        steps=zeros(),
        site=site,
        machine=machine,
        enemy_position=enemy_position,
        enemy_velocity=zeros(2, enemies),
        enemy_z=traits.height.clone(),
        enemy_yaw=uniform(-torch.pi, torch.pi, enemies),
        enemy_hp=traits.hp.clone(),
        phase=zeros(enemies),
        phase_timer=zeros(enemies),
        attack=torch.zeros_like(machine),
        cooldown=uniform(0.0, 3.0 * c.FPS, ATTACK_SLOTS, enemies),
        pause=uniform(0.5 * c.FPS, 2.0 * c.FPS, enemies),
        lock=zeros(2, enemies),
        hits_left=zeros(enemies),
        stagger_sum=zeros(enemies),
        strafe=2.0 * ints(2, enemies) - 1.0,
        gauge=zeros(len(ELEMENTS), enemies),
        state_timer=zeros(len(ELEMENTS), enemies),
        source=zeros(len(ELEMENTS), enemies),
        plasma_store=zeros(enemies),
        shock_growth=zeros(enemies) + 1.0,
        count=traits.units.clone(),
        part_hp=traits.unit_hp.clone(),
        land_timer=zeros(c.SHOT_SLOTS, enemies),
        shot_damage=zeros(c.SHOT_SLOTS, enemies),
        shot_point=zeros(2, c.SHOT_SLOTS, enemies),
        trap_position=zeros(2, c.TRAP_SLOTS),
        trap_type=zeros(c.TRAP_SLOTS) - 1.0,
        trap_arm=zeros(c.TRAP_SLOTS),
        hazard_position=zeros(2, c.HAZARD_SLOTS),
        hazard_timer=zeros(c.HAZARD_SLOTS),
        actions=zeros(24 * ACTION_HISTORY),
        features=zeros(FEATURES_KEPT * FEATURE_HISTORY),
    )


def _spawn(enemies: int, uniform) -> tuple[Tensor, Tensor]:
    """Draw positions of player (2, N) and enemies (2, E, N), uniform in the disc, at least `SPAWN_GAP` apart."""
    tries = 12  # one try is too close with probability 0.1 to 0.2; all of them, with less than 1e-8
    radius = c.SPAWN_RADIUS * uniform(0.0, 1.0, tries, 1 + enemies).sqrt()
    angle = uniform(-torch.pi, torch.pi, tries, 1 + enemies)
    points = torch.stack((radius * angle.cos(), radius * angle.sin()))  # (2, tries, 1 + E, N)
    placed = [points[:, 0, 0]]
    for enemy in range(1, 1 + enemies):
        candidates = points[:, :, enemy]
        gaps = torch.stack([(candidates - other.unsqueeze(1)).square().sum(0) for other in placed]).amin(0)
        # Beyond the gap all are equally good, so that the choice is as random as the points.
        best = gaps.clamp(max=c.SPAWN_GAP**2).argmax(0)  # (N,)
        placed.append(candidates.gather(1, best.expand(2, 1, -1)).squeeze(1))
    return placed[0], torch.stack(placed[1:], 1)
