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
        position: Position of the player (2, N) [m].
        velocity: Velocity of the player (2, N) [m/s].
        yaw: Direction of the camera, counter-clockwise from +x (N,) [rad].
        pitch: Elevation of the camera (N,) [rad].
        hp: Health of the player (N,) [HP].
        stamina: Stamina of the player (N,).
        weapon_stamina: Stamina for weapon techniques (N,).
        berries: Number of berries left (N,).
        inventory: Number of traps of each type (4, N).
        tool: Selected trap type (N,) int64.
        weapon: Selected weapon (N,) int64.
        section: Selected ammo of the weapon (N,) int64.
        magazine: Rounds by wheel section, three rows per weapon (18, N).
        timers: Timers with the rows `FIRE` to `BERRY` (11, N) [frames].
        technique: 1 while the next shot deals double damage (N,).
        dodge: Direction of the current dodge or slide (2, N).
        wheel: 1 if the weapon wheel was open in the last step (N,).
        quick: 1 if the tool menu was used in the last step (N,).
        sticks: Right stick of the last step and of the one before (4, N).
        anchor: Centre of the Dynamic Anchor Bound (2, N) [m].
        distance: Distance to the nearest enemy after the last step (N,) [m].
        closeness: Closeness of the nearest enemy and of the player to a set trap (2, N).
        steps: Number of steps since the reset (N,).
        site: Number of the site (N,) int64.
        machine: Number of the machine type (E, N) int64.
        enemy_position: Positions of the machines (2, E, N) [m].
        enemy_velocity: Velocities of the machines (2, E, N) [m/s].
        enemy_z: Heights of the machines (E, N) [m].
        enemy_yaw: Directions of the machines (E, N) [rad].
        enemy_hp: Health of the machines (E, N) [HP].
        phase: Phase of the machines, `IDLE` to `STAGGERED` (E, N).
        phase_timer: Time left of the phase (E, N) [frames].
        attack: Slot of the latest attack (E, N) int64.
        cooldown: Time until each attack slot can be used again (4, E, N) [frames].
        pause: Time until the next attack may start (E, N) [frames].
        lock: Direction of the active attack (2, E, N).
        hits_left: Number of hits left in the active attack (E, N).
        stagger_sum: Damage since the last stagger (E, N) [HP].
        strafe: Direction of strafing, +1 or -1 (E, N).
        gauge: Build-up of each element, in [0, 1) (7, E, N).
        state_timer: Time left of each elemental state (7, E, N) [frames].
        source: Latest source of each element's build-up (7, E, N).
        plasma_store: Damage that plasma has stored (E, N) [HP].
        shock_growth: Factor on shock's threshold (E, N).
        count: Number of units left of each part (12, E, N).
        part_hp: Health of the current unit of each part (12, E, N) [HP].
        land_timer: Time until each shot of a machine lands (4, E, N) [frames].
        shot_damage: Damage of each shot of a machine (4, E, N) [HP].
        shot_point: Place where each shot of a machine lands (2, 4, E, N) [m].
        trap_position: Positions of the set traps (2, 4, N) [m].
        trap_type: Types of the set traps, or -1 in an empty slot (4, N).
        trap_arm: Time until each trap is armed (4, N) [frames].
        hazard_position: Positions of the hazard zones (2, 2, N) [m].
        hazard_timer: Time left of each hazard zone (2, N) [frames].
        actions: Canonical actions of the last three steps, newest first (72, N).
        features: Features of the last two steps, newest first (24, N); see `features.kept_features`.
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
        """Return `other` in the fights where `mask` (N,) holds, and this state elsewhere.

        Args:
            mask: (N,) bool.
            other: State of the fights where the mask holds.
        """
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
    """Return the values of the enemy that `nearest` chose.

    Args:
        values: (..., E, N) with E of 1 or 2.
        second: Whether the second enemy is the nearest one (N,) bool.

    Returns:
        (..., N).
    """
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
