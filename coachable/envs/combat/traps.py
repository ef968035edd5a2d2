"""Traps that the player sets, and hazard zones that a machine leaves."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from coachable.envs.combat import constants as c
from coachable.envs.combat.state import State, nearest, pick
from coachable.envs.combat.tables import ELEMENTS, TRAPS, load_table
from coachable.envs.combat.traits import Traits


@dataclass
class TrapNumbers:
    """Numbers of traps.csv for the machines of the fights.

    Attributes:
        damage: Damage of each trap type, with the resistance (4, E, N) [HP].
        gain: Build-up as a share of the threshold (4, E, N), without the growth of shock's threshold.
        element: One-hot columns (7, 4), zero for a trap without an element.
    """

    damage: Tensor
    gain: Tensor
    element: Tensor

    @classmethod
    def of(cls, traits: Traits) -> TrapNumbers:
        """Compute the numbers from the data file and the machines' resistance."""
        table, device = load_table("traps"), traits.hp.device
        element = torch.zeros((len(ELEMENTS), len(TRAPS)), device=device)
        for i, trap in enumerate(TRAPS):
            for name in table.words(trap, "element", ELEMENTS):
                element[ELEMENTS.index(name), i] = 1.0
        resisted = torch.tensordot(element.T, traits.resistance, dims=1)  # (4, E, N), 0 without element
        plain = (1.0 - element.sum(0)).view(-1, 1, 1)

        def column(name: str) -> Tensor:
            return torch.tensor(table.column(name), device=device).view(-1, 1, 1)

        return cls(column("damage") * (resisted + plain), column("buildup") * resisted / traits.threshold, element)


def spring_traps(s: State, traits: Traits, numbers: TrapNumbers) -> tuple[Tensor, Tensor, Tensor]:
    """Advance the traps of `s` by one frame in place; an armed trap fires when a machine is near, and disappears.

    Returns:
        Damage to the machines (E, N) [HP], build-up (7, E, N), and damage to the player (N,) [HP].
    """
    s.trap_arm = (s.trap_arm - 1.0).clamp(min=0.0)
    offset = s.enemy_position.unsqueeze(1) - s.trap_position.unsqueeze(2)  # (2, 4, E, N)
    within = offset.square().sum(0) < (traits.radius + c.TRAP_TRIGGER).square()
    near = within & (s.enemy_hp > 0) & (s.enemy_z < c.REACHABLE_HEIGHT)  # (4, E, N)
    fires = near.any(1) & (s.trap_type >= 0) & (s.trap_arm <= 0)  # (4, N)
    hits = near & fires.unsqueeze(1)
    types = torch.arange(len(TRAPS), device=fires.device).view(-1, 1, 1)
    of_type = s.trap_type.unsqueeze(0) == types  # (types, 4, N)
    hit = (hits.unsqueeze(0) & of_type.unsqueeze(2)).sum(1).float()  # (types, E, N)
    to_player = (s.position.unsqueeze(1) - s.trap_position).square().sum(0) < c.TRAP_BLAST**2
    self_damage = c.TRAP_SELF_DAMAGE * (fires & to_player).any(0)
    s.trap_type = torch.where(fires, -1.0, s.trap_type)
    gain = torch.tensordot(numbers.element, hit * numbers.gain, dims=1)
    return (hit * numbers.damage).sum(0), gain, self_damage


def closeness(s: State, trap_type: Tensor) -> Tensor:
    """Return the closeness of the nearest enemy and of the player to a set trap, (2, N) in [0, 1].

    Args:
        s: State.
        trap_type: Types of the traps that count (4, N), or -1 in an empty slot.
    """
    bodies = torch.stack((pick(s.enemy_position, nearest(s)), s.position), 1)  # (2 coordinates, 2 bodies, N)
    distance = (bodies.unsqueeze(2) - s.trap_position.unsqueeze(1)).square().sum(0).sqrt()  # (2, 4, N)
    near = (1.0 - distance / c.CLOSENESS_SCALE).clamp(min=0.0)
    return (near * (trap_type >= 0)).amax(1)


def burn_player(s: State) -> Tensor:
    """Advance the zones by one frame and return the damage to the player (N,) [HP]."""
    s.hazard_timer = (s.hazard_timer - 1.0).clamp(min=0.0)
    inside = (s.position.unsqueeze(1) - s.hazard_position).square().sum(0) < c.HAZARD_RADIUS**2
    return (inside & (s.hazard_timer > 0)).any(0) * (c.HAZARD_DPS * c.DT)


def leave_zone(s: State, left: Tensor) -> None:
    """Start hazard zones under the machines where `left` (E, N) holds.

    A new zone replaces the one with the least time left.

    Args:
        s: State, changed in place.
        left: (E, N) bool.
    """
    for enemy, leaves in enumerate(left):
        oldest = s.hazard_timer[0] > s.hazard_timer[1]  # (N,) the second slot
        slot = torch.stack((~oldest, oldest)) & leaves
        s.hazard_position = torch.where(slot, s.enemy_position[:, enemy].unsqueeze(1), s.hazard_position)
        s.hazard_timer = torch.where(slot, c.HAZARD_TIME * c.FPS, s.hazard_timer)
