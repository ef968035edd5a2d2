"""Raw components of a step, and the weights that make the task reward, style features and events of them."""

from collections.abc import Sequence

import torch
from torch import Tensor

from coachable.envs.combat.tables import ELEMENTS, PART_TYPES, STYLES, WEAPONS, load_table

COMPONENTS: dict[str, int] = {
    "damage": 1,
    "weapon_damage": len(WEAPONS),
    "melee_damage": 1,
    "trap_damage": 1,
    "state_damage": len(ELEMENTS),
    "part_damage": len(PART_TYPES),
    "removals": len(PART_TYPES),
    "buildup": len(ELEMENTS),
    "ammo_change": len(ELEMENTS),
    "lure": 1,
    "proximity": 1,
    "wheel": 1,
    "quick": 1,
    "off_screen": 1,
    "smoothness": 1,
    "death": 1,
    "out_of_bounds": 1,
}
"""Name and width; weapons in wheel order, parts as shield, weapon, canister, elements in their usual order."""

COMPONENT_SLICES: dict[str, slice] = {}
for _name, _width in COMPONENTS.items():
    _first = sum(s.stop - s.start for s in COMPONENT_SLICES.values())
    COMPONENT_SLICES[_name] = slice(_first, _first + _width)
NUM_COMPONENTS = sum(COMPONENTS.values())

WEAPON_OF = {
    "ancestors_return": "Ancestor's Return",
    "corrosive_blastsling": "Corrosive Blastsling",
    "carjas_bane": "Carja's Bane",
    "sunscourge": "Sunscourge",
    "icestorm_boltblaster": "Icestorm",
    "skykiller": "Skykiller",
}
"""Weapon of each weapon style."""

_GENEROUS = ("fire", "adhesive")  # the elements whose build-up counts 35, not 15

REWARD_SCALES = ("sim", "paper")


def pack_components(**parts: Tensor) -> Tensor:
    """Stack components (44, N) from named rows, `(width, N)` or `(N,)`.

    Raises:
        ValueError: If the names are not those of `COMPONENTS`.
    """
    if set(parts) != set(COMPONENTS):
        raise ValueError(f"components are {sorted(parts)}, expected {sorted(COMPONENTS)}")
    return torch.cat([parts[name].reshape(width, -1) for name, width in COMPONENTS.items()])


def task_weights() -> Tensor:
    """Return the weight of each component in the task reward, (44,) (paper)."""
    table, weights = load_table("task_rewards"), torch.zeros(NUM_COMPONENTS)
    for name in table.rows:
        weights[COMPONENT_SLICES[name]] = table.number(name, "weight")
    return weights


def style_weights(reward_scale: str) -> Tensor:
    """Return the inner weights (18, 44), whose row i gives g_i as a sum of components (paper).

    Args:
        reward_scale: "paper", or "sim" for smaller rewards of removed parts.

    Raises:
        ValueError: If the scale is unknown.
    """
    if reward_scale not in REWARD_SCALES:
        raise ValueError(f"reward_scale is {reward_scale!r}: expected one of {REWARD_SCALES}")
    table = load_table("style_terms")

    def weight(term: str) -> float:
        return table.number(term, f"{reward_scale}_weight")

    def at(name: str, offset: int = 0) -> int:
        return COMPONENT_SLICES[name].start + offset

    weights = torch.zeros(len(STYLES), NUM_COMPONENTS)
    for row, style in zip(weights, STYLES, strict=True):
        if style == "melee":
            entries = [(at("melee_damage"), weight("melee damage"))]
        elif style == "traps":
            entries = [
                (at("trap_damage"), weight("trap damage")),
                (at("proximity"), weight("trap proximity")),
                (at("lure"), weight("trap lure")),
            ]
        elif style in WEAPON_OF:
            entries = [(at("weapon_damage", WEAPONS.index(WEAPON_OF[style])), weight("weapon damage"))]
        elif style in ELEMENTS:
            e = ELEMENTS.index(style)
            buildup = "build-up of fire and adhesive" if style in _GENEROUS else "build-up"
            entries = [
                (at("state_damage", e), weight("damage in the state")),
                (at("ammo_change", e), weight("ammo selected")),
                (at("buildup", e), weight(buildup)),
            ]
        else:
            p = PART_TYPES.index(style.removeprefix("part_"))
            entries = [(at("part_damage", p), weight("part damage")), (at("removals", p), weight("part removal"))]
        for component, value in entries:
            row[component] = value
    return weights


def event_components() -> Tensor:
    """Return which components make an event fire when they are above 0, (18, 44), 0 or 1.

    Build-up is an event of its element, because a policy first has to learn to choose the ammunition and to hit.
    """
    weights = style_weights("paper")
    quiet = [COMPONENT_SLICES[name] for name in ("proximity", "lure", "ammo_change")]
    fires = (weights != 0).float()
    for piece in quiet:
        fires[:, piece] = 0.0
    return fires


def style_counts(styles: Sequence[str]) -> Tensor:
    """Return which components count for each style, (len(styles), 44), 0 or 1: damage, or removals for part styles."""
    counts = event_components()
    for name in ("part_damage", "buildup"):
        counts[:, COMPONENT_SLICES[name]] = 0.0
    return counts[[STYLES.index(name) for name in styles]]
