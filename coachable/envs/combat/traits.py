"""Numbers of the tables for the machines, weapons and sites of every fight, as tensors with the fights last."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from coachable.envs.combat import constants as c
from coachable.envs.combat.tables import (
    ALL_MACHINES,
    AMMO,
    ATTACK_SLOTS,
    ELEMENTS,
    KINDS,
    PART_SLOTS,
    PART_TYPES,
    SITES,
    Machine,
    attacks_of,
    load_table,
    resistance,
)

MACHINE_NAMES = tuple(ALL_MACHINES)
AMMO_SLOTS = 3  # sections of a weapon; a weapon of two ammo types leaves the last one empty

# Rows of `Traits.attacks` and `blow`, first dimension; times in frames, `kind` in the order of KINDS.
DAMAGE, TELEGRAPH, ACTIVE, RECOVER, NEAREST, FARTHEST, COOLDOWN, SHOTS, HIDDEN, HAZARD, KIND = range(11)
NUM_ATTACK_ROWS = 11

# Columns of `ammo_table`; interval and reload in frames, spread in rad.
IMPACT, ELEMENTAL, TEAR, BUILDUP, INTERVAL, MAGAZINE, RELOAD, SPEED, SPREAD, RANGE, BLAST = range(11)


@dataclass
class Traits:
    """Traits of the machine types of E enemies in N fights, which are looked up at a reset.

    Attributes:
        hp: Health (E, N) [HP].
        radius: Radius of the body (E, N) [m].
        speed: Speed (E, N) [m/s].
        hit: Damage of the unscaled attack (E, N) [HP].
        approach: Distance to which the machine approaches the player (E, N) [m].
        height: Height at which the machine flies (E, N) [m].
        weapon_parts: Number of weapon parts (E, N).
        threshold: Build-up that starts an elemental state (E, N).
        part_radius: Radius of a part (E, N) [m].
        resistance: Factor on damage and build-up of each element (7, E, N).
        attacks: Numbers of the attacks (11, 4, E, N) with the rows `DAMAGE` to `KIND`; an empty slot is never in range.
        offset: Positions of the parts relative to the body's centre in the machine's frame (3, 12, E, N) [m].
        unit_hp: Health of one unit of a part (12, E, N) [HP].
        units: Number of units of each part at the start (12, E, N).
        part_type: One-hot of shield, weapon, canister (3, 12, E, N); it is zero in unused slots.
        hit_factor: Factor on the body's damage through a part, less 1 (12, E, N).
    """

    hp: Tensor
    radius: Tensor
    speed: Tensor
    hit: Tensor
    approach: Tensor
    height: Tensor
    weapon_parts: Tensor
    threshold: Tensor
    part_radius: Tensor
    resistance: Tensor
    attacks: Tensor
    offset: Tensor
    unit_hp: Tensor
    units: Tensor
    part_type: Tensor
    hit_factor: Tensor


_SCALARS = 9
_SHAPES = {
    "resistance": (len(ELEMENTS),),
    "attacks": (NUM_ATTACK_ROWS, ATTACK_SLOTS),
    "offset": (3, PART_SLOTS),
    "unit_hp": (PART_SLOTS,),
    "units": (PART_SLOTS,),
    "part_type": (3, PART_SLOTS),
    "hit_factor": (PART_SLOTS,),
}


def machine_table(device: torch.device) -> Tensor:
    """Return the table of all machines, (22, S) float32, for `look_up_traits`."""
    rows = [_machine_row(index, machine) for index, machine in enumerate(ALL_MACHINES.values())]
    return torch.from_numpy(np.stack(rows)).to(device)


def look_up_traits(table: Tensor, machine: Tensor) -> Traits:
    """Return the traits of machine numbers (E, N).

    Args:
        table: One row of traits per machine.
        machine: Numbers of machines (E, N) int64.
    """
    found = table[machine].permute(2, 0, 1).contiguous()  # (S, E, N)
    pieces = list(found[:_SCALARS])
    first = _SCALARS
    for shape in _SHAPES.values():
        size = math.prod(shape)
        pieces.append(found[first : first + size].unflatten(0, shape))
        first += size
    return Traits(*pieces)


def part_layout(machine: Machine) -> list[tuple[str, int]]:
    """Return type and units of every used part slot, shields first; units are spread as evenly as possible."""
    layout = []
    for part, count, slots in zip(PART_TYPES, machine.parts, machine.slots(), strict=True):
        layout += [(part, count // slots + (i < count % slots)) for i in range(slots)]
    return layout


def unit_hp(machine: Machine, part: str) -> float:
    """Return the health of one unit of a part [HP]."""
    return c.UNIT_HP[part] * 1.6 * machine.hp**0.85


def _machine_row(index: int, machine: Machine) -> np.ndarray:
    random = np.random.default_rng(index)  # places the parts, the same in every fight
    arrays = {name: np.zeros(shape) for name, shape in _SHAPES.items()}
    arrays["resistance"][:] = resistance(machine)
    arrays["attacks"][:] = _attack_rows(machine)
    for slot, (part, units) in enumerate(part_layout(machine)):
        spread = {"shield": (-1.2, 1.2), "weapon": (-1.6, 1.6), "canister": (1.6, 4.7)}[part]
        elevation, azimuth = random.uniform(-0.2, 0.9), random.uniform(*spread)
        direction = (
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        )
        arrays["offset"][:, slot] = np.multiply(direction, c.PART_DISTANCE * machine.radius)
        arrays["unit_hp"][slot] = unit_hp(machine, part)
        arrays["units"][slot] = units
        arrays["part_type"][PART_TYPES.index(part), slot] = 1.0
        arrays["hit_factor"][slot] = {"shield": c.SHIELD_FACTOR, "weapon": 1.0, "canister": c.CANISTER_FACTOR}[part] - 1
    scalars = (
        machine.hp,
        machine.radius,
        machine.speed,
        machine.hit,
        c.APPROACH[machine.kind],
        machine.height,
        machine.parts[PART_TYPES.index("weapon")],
        c.THRESHOLD + c.THRESHOLD_SCALE * math.sqrt(machine.hp),
        c.PART_SPHERE * machine.radius + c.PART_SPHERE_EXTRA,
    )
    flat = [np.asarray(scalars), *(array.reshape(-1) for array in arrays.values())]
    return np.concatenate(flat).astype(np.float32)


def _attack_rows(machine: Machine) -> np.ndarray:
    rows = np.zeros((NUM_ATTACK_ROWS, ATTACK_SLOTS))
    rows[NEAREST], rows[FARTHEST] = 1.0, 0.0  # nowhere in range
    table = load_table("attacks")
    for slot, name in enumerate(attacks_of(machine.kind)):
        kind = table.rows[name]["kind"]
        if machine.height and kind not in ("charge", "ranged"):
            continue  # a flyer only dives and shoots
        numbers = ("damage", "telegraph", "active", "recover", "nearest", "farthest", "cooldown", "shots")
        numbers = (*numbers, "hidden", "hazard")
        rows[: len(numbers), slot] = [table.number(name, column) for column in numbers]
        rows[COOLDOWN, slot] *= c.FPS
        rows[KIND, slot] = KINDS.index(kind)
    return rows


def ammo_table(device: torch.device) -> Tensor:
    """Return numbers and element one-hots of every wheel section, (18, 11 + 7) float32; row 3 i + j is of weapon i."""
    table = load_table("weapons")
    numbers = ("impact", "elemental", "tear", "buildup", "interval", "magazine", "reload", "speed", "spread_deg")
    rows = np.zeros((len(AMMO) * AMMO_SLOTS, 11 + len(ELEMENTS)))
    for weapon, names in enumerate(AMMO):
        for section, name in enumerate(names):
            row = rows[weapon * AMMO_SLOTS + section]
            row[:11] = [table.number(name, column) for column in (*numbers, "range", "blast")]
            row[[INTERVAL, RELOAD]] *= c.FPS
            row[SPREAD] = math.radians(row[SPREAD])
            for element in table.words(name, "element", ELEMENTS):
                row[11 + ELEMENTS.index(element)] = 1.0
    return torch.from_numpy(rows.astype(np.float32)).to(device)


def ammo_sections(device: torch.device) -> Tensor:
    """Return the number of ammo sections of each weapon, (6,) int64."""
    return torch.tensor([len(names) for names in AMMO], device=device)


def site_table(device: torch.device) -> Tensor:
    """Return velocity lag, speed factor, pillars and wall radius of each site, (3, 4) float32."""
    table = load_table("sites")
    columns = ("velocity_lag", "speed_factor", "pillars", "wall_radius")
    return torch.tensor([[table.number(site, column) for column in columns] for site in SITES], device=device)
