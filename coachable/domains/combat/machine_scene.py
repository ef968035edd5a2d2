"""Shapes of the machines, built from primitives by body plan, and of the player."""

import math
from dataclasses import dataclass, replace

import numpy as np

from coachable.envs.combat.tables import ALL_MACHINES
from coachable.scene import palette
from coachable.scene.palette import Colour
from coachable.scene.parts import Parts, about_x, about_y, about_z, towards

QUADRUPED, BIPED, SERPENT, UPRIGHT = "quadruped", "biped", "serpent", "upright"
METAL, JOINT, ARMOUR = (158, 164, 172), (70, 75, 82), (222, 224, 224)
_SWING = 0.5  # [rad], of a leg to either side
_STRIDE = 1.6  # radii, distance in which a leg swings once forward and back
PLAYER = palette.BLUE
_SKIN = (224, 180, 150)


@dataclass(frozen=True)
class Plan:
    """Build of a machine, with lengths in radii of its body.

    Attributes:
        plan: Body plan.
        length: Length of the trunk.
        girth: Width and height of the trunk.
        legs: Height of the trunk's middle above the ground.
        neck: Length of the neck.
        head: Length of the head.
        jaw: Width of the head.
        tail: Length of the tail.
        horns: Length of the horns.
        extra: What else it has: "plates" on the back, "claws", "wings", "ears" or a "sail".
    """

    plan: str
    length: float = 1.5
    girth: float = 0.8
    legs: float = 1.0
    neck: float = 0.4
    head: float = 0.6
    jaw: float = 0.4
    tail: float = 0.8
    horns: float = 0.0
    extra: str = ""


_CLASSES = {
    "small": Plan(QUADRUPED, tail=0.9),
    "charger": Plan(QUADRUPED, girth=0.95, horns=0.8, neck=0.3, tail=0.3),
    "brute": Plan(QUADRUPED, girth=1.0, jaw=0.6, head=0.7, extra="plates"),
    "titan": Plan(BIPED, length=1.5, girth=0.95, legs=1.25, head=0.9, jaw=0.6, tail=1.6),
    "stalker": Plan(UPRIGHT, girth=0.55),
}
_OWN: dict[str, dict[str, object]] = {  # what distinguishes a machine from its class
    "Burrower": {"girth": 0.5, "legs": 0.45, "length": 1.9, "jaw": 0.5, "tail": 0.6},
    "Scrounger": {"tail": 0.5, "extra": "plates"},
    "Scrapper": {"girth": 0.75, "jaw": 0.55, "head": 0.7, "tail": 1.1},
    "Leaplasher": {"plan": BIPED, "length": 1.1, "legs": 1.0, "tail": 1.5, "extra": "ears", "jaw": 0.3},
    "Lancehorn": {"girth": 0.6, "legs": 1.3, "neck": 0.6, "horns": 1.3, "jaw": 0.28},
    "Longleg": {"plan": BIPED, "legs": 1.7, "length": 1.0, "neck": 1.0, "tail": 0.7, "jaw": 0.25, "extra": "wings"},
    "Widemaw": {"jaw": 1.0, "head": 0.9, "horns": 0.0, "legs": 0.8, "girth": 1.15, "neck": 0.1},
    "Ravager": {"girth": 0.8, "legs": 1.15, "extra": "ears"},
    "Snapmaw": {"legs": 0.45, "length": 2.0, "girth": 0.7, "head": 1.3, "jaw": 0.4, "tail": 1.7},
    "Grimhorn": {"girth": 1.15, "horns": 1.1, "extra": "plates"},
    "Scorcher": {"girth": 0.75, "legs": 1.1, "tail": 1.2, "extra": "ears"},
    "Rollerback": {"girth": 1.1, "legs": 0.8, "horns": 0.4, "extra": "plates", "tail": 0.9},
    "Frostclaw": {"girth": 1.15, "legs": 1.05, "extra": "claws", "tail": 0.1},
    "Rockbreaker": {"girth": 0.95, "legs": 0.6, "length": 1.9, "extra": "claws", "jaw": 0.75},
    "Slitherfang": {"plan": SERPENT, "length": 3.0, "girth": 0.7, "neck": 1.6, "head": 0.9, "extra": "sail"},
    "Slaughterspine": {"extra": "sail", "head": 1.1, "jaw": 0.45},
    "Specter Prime": {"girth": 0.7, "extra": "claws"},
    "Bellowback": {"girth": 1.3, "tail": 1.0, "extra": ""},
    "Tremortusk": {"girth": 1.15, "horns": 1.2, "legs": 1.3, "head": 0.8},
    "Sunwing": {"plan": BIPED, "legs": 1.0, "neck": 0.7, "extra": "wings"},
}


def plan_of(name: str) -> Plan:
    """Return the build of a machine by its name."""
    plan = _CLASSES[ALL_MACHINES[name].kind]
    return replace(plan, **_OWN.get(name, {}))  # type: ignore[arg-type]


def machine(name: str, radius: float, walked: float, lamp: Colour, alive: bool = True) -> Parts:
    """Return a machine that faces +x, with its middle at x = y = 0 and the ground at z = 0.

    The number of primitives of a machine is always the same.

    Args:
        name: Name of the machine.
        radius: Radius of its body [m].
        walked: Distance that it has walked, which moves its legs [m].
        lamp: Colour of its lamps.
        alive: Whether it is alive; a dead one is dark.
    """
    plan = plan_of(name)
    swing = _SWING * math.sin(2 * math.pi * walked / (_STRIDE * radius)) if alive else 0.0
    unit = Parts()
    paint = METAL if alive else JOINT
    lamp = lamp if alive else JOINT
    {QUADRUPED: _quadruped, BIPED: _biped, SERPENT: _serpent, UPRIGHT: _upright}[plan.plan](
        unit, plan, swing, paint, lamp
    )
    return _scaled(unit, radius)


def _scaled(parts: Parts, size: float) -> Parts:
    scaled = Parts()
    for shape in ("box", "ball", "cylinder"):
        batch = parts.of(shape)
        if len(batch):
            scaled.batch(shape, replace(batch, positions=size * batch.positions, sizes=size * batch.sizes))
    return scaled


def _leg(parts: Parts, x: float, y: float, hip: float, swing: float, thick: float, paint: Colour) -> None:
    knee = np.array([x + 0.45 * hip * math.sin(swing) + 0.06, y, 0.5 * hip])
    foot = np.array([x + 0.9 * hip * math.sin(swing), y, 0.06 + 0.12 * hip * max(0.0, -math.sin(2 * swing))])
    parts.rod((x, y, hip), knee, thick, paint)
    parts.rod(knee, foot, 0.7 * thick, JOINT)
    parts.box((foot[0] + 0.06, foot[1], foot[2]), (0.34, 1.8 * thick, 0.12), JOINT)


def _head(parts: Parts, plan: Plan, place: np.ndarray, paint: Colour, lamp: Colour) -> None:
    """Add a head with lamps for eyes whose back is at a place, and its horns or ears."""
    x, y, z = place
    middle = x + plan.head / 2
    parts.box((middle, y, z), (plan.head, plan.jaw, 0.32), paint)
    parts.box((middle + 0.05, y, z - 0.2), (0.9 * plan.head, 0.85 * plan.jaw, 0.1), JOINT, about_y(0.15))
    for side in (-1, 1):
        parts.ball((x + 0.7 * plan.head, side * 0.5 * plan.jaw, z + 0.08), (0.2, 0.14, 0.16), lamp)
        if plan.horns:
            root = (x + 0.4 * plan.head, side * 0.35 * plan.jaw, z + 0.12)
            tip = (x + 0.5 * plan.head + 0.7 * plan.horns, side * (0.4 + 0.3 * plan.horns), z + 0.2 + 0.5 * plan.horns)
            parts.rod(root, tip, 0.06, ARMOUR)
        if plan.extra == "ears":
            parts.box((x + 0.1, side * 0.4 * plan.jaw, z + 0.3), (0.1, 0.16, 0.45), ARMOUR, about_y(-0.4))


def _back(parts: Parts, plan: Plan, height: float) -> None:
    """Add what a machine has on its back."""
    top = height + 0.45 * plan.girth
    if plan.extra == "plates":
        for index in range(4):
            x = plan.length * (index / 3 - 0.5) * 0.8
            parts.box((x, 0.0, top), (0.36, 0.55 * plan.girth, 0.16), ARMOUR, about_y(-0.35))
    if plan.extra == "sail":
        for index in range(5):
            x = plan.length * (index / 4 - 0.5) * 0.8
            tall = 0.9 - 0.25 * abs(index - 2)
            parts.box((x, 0.0, top + tall / 2 - 0.1), (0.12, 0.06, tall), ARMOUR, about_y(-0.2))
    if plan.extra == "claws":
        for side in (-1, 1):
            for finger in (-1, 0, 1):
                root = (0.6 * plan.length, side * 0.55 + 0.12 * finger, 0.3)
                parts.rod(root, (root[0] + 0.45, root[1], 0.08), 0.04, ARMOUR)
    if plan.extra == "wings":
        for side in (-1, 1):
            parts.box((-0.15, side * 0.95, top - 0.05), (0.7, 1.2, 0.06), ARMOUR, about_x(side * 0.35))


def _tail(parts: Parts, plan: Plan, start: np.ndarray) -> None:
    if plan.tail:
        bend = start + np.array([-0.55 * plan.tail, 0.0, 0.08])
        parts.rod(start, bend, 0.14, JOINT)
        parts.rod(bend, bend + np.array([-0.45 * plan.tail, 0.0, 0.16]), 0.08, ARMOUR)


def _quadruped(parts: Parts, plan: Plan, swing: float, paint: Colour, lamp: Colour) -> None:
    height, half = plan.legs, plan.length / 2
    parts.ball((0.0, 0.0, height), (plan.length, 0.9 * plan.girth, plan.girth), paint)
    parts.ball((0.6 * half, 0.0, height + 0.05), (0.9, 1.05 * plan.girth, 1.1 * plan.girth), paint)
    parts.box((-0.1, 0.0, height + 0.4 * plan.girth), (0.8 * plan.length, 0.3 * plan.girth, 0.14), JOINT)
    for x, sense in ((0.7 * half, 1.0), (-0.7 * half, -1.0)):
        for side in (-1, 1):
            _leg(parts, x, side * 0.45 * plan.girth, height, sense * side * swing, 0.14, paint)
    nape = np.array([0.85 * half, 0.0, height + 0.25])
    head = nape + np.array([0.8 * plan.neck, 0.0, 0.6 * plan.neck])
    parts.rod(nape, head, 0.2, JOINT)
    _head(parts, plan, head, paint, lamp)
    _tail(parts, plan, np.array([-0.9 * half, 0.0, height + 0.1]))
    _back(parts, plan, height)


def _biped(parts: Parts, plan: Plan, swing: float, paint: Colour, lamp: Colour) -> None:
    height, half = plan.legs, plan.length / 2
    parts.ball((0.0, 0.0, height), (plan.length, 0.85 * plan.girth, plan.girth), paint, about_y(-0.3))
    parts.ball((0.5 * half, 0.0, height + 0.25), (0.8, 0.75 * plan.girth, 0.8 * plan.girth), paint)
    for side in (-1, 1):
        _leg(parts, -0.1, side * 0.4 * plan.girth, height, side * swing, 0.2, paint)
        arm = np.array([0.55 * half, side * 0.4 * plan.girth, height + 0.05])
        parts.rod(arm, arm + np.array([0.3, 0.0, -0.3]), 0.07, JOINT)
    nape = np.array([0.75 * half, 0.0, height + 0.4])
    head = nape + np.array([0.5 * plan.neck, 0.0, 0.8 * plan.neck])
    parts.rod(nape, head, 0.22 if plan.girth > 0.85 else 0.12, JOINT)
    _head(parts, plan, head, paint, lamp)
    _tail(parts, plan, np.array([-0.8 * half, 0.0, height]))
    _back(parts, plan, height)


def _serpent(parts: Parts, plan: Plan, swing: float, paint: Colour, lamp: Colour) -> None:
    for index in range(9):  # the body on the ground, in waves that move with it
        x = 0.7 - plan.length * index / 8
        y = 0.5 * math.sin(1.1 * index + 4 * swing)
        size = plan.girth * (1.0 - 0.07 * index)
        parts.ball((x, y, 0.45 * size), (0.75, size, 0.9 * size), METAL if index % 2 else paint)
    for index in range(4):  # and the raised front
        share = index / 3
        parts.ball((0.8 + 0.5 * share, 0.0, 0.5 + plan.neck * share), (0.7, 0.7, 0.7), paint)
    parts.box((1.25, 0.0, 0.4 + plan.neck), (0.12, 1.3, 0.9), ARMOUR, about_y(0.2))  # the hood
    _head(parts, plan, np.array([1.3, 0.0, 0.7 + plan.neck]), paint, lamp)


def _upright(parts: Parts, plan: Plan, swing: float, paint: Colour, lamp: Colour) -> None:
    parts.box((0.0, 0.0, 1.55), (0.45, plan.girth, 0.8), paint)
    parts.box((0.0, 0.0, 1.05), (0.35, 0.7 * plan.girth, 0.3), JOINT)
    parts.box((-0.22, 0.0, 1.7), (0.14, 1.25 * plan.girth, 0.5), ARMOUR)
    for side in (-1, 1):
        _leg(parts, 0.0, side * 0.25 * plan.girth, 1.0, side * swing, 0.12, paint)
        shoulder = np.array([0.0, side * 0.65 * plan.girth, 1.85])
        hand = shoulder + np.array([0.45 * math.cos(side * swing), side * 0.12, -0.6])
        parts.ball(shoulder, (0.34, 0.34, 0.34), ARMOUR)
        parts.rod(shoulder, hand, 0.09, paint)
        if plan.extra == "claws":
            parts.rod(hand, hand + np.array([0.6, 0.0, -0.1]), 0.04, ARMOUR)
    parts.box((0.08, 0.0, 2.15), (0.34, 0.34, 0.34), paint)
    for side in (-1, 1):
        parts.ball((0.26, side * 0.1, 2.2), (0.12, 0.12, 0.12), lamp)


def removable(kind: int, radius: float, offset: np.ndarray) -> Parts:
    """Return a removable part on the surface of a machine.

    Args:
        kind: 0 for a shield, 1 for a weapon, 2 for a canister.
        radius: Radius of the part [m].
        offset: Place relative to the middle of the body (3,) [m], from which it points outwards.
    """
    parts, outward = Parts(), towards(offset)
    if kind == 0:
        parts.box(offset, (2.4 * radius, 2.4 * radius, 0.4 * radius), PART_COLOURS[0], outward)
    elif kind == 1:
        parts.cylinder(
            offset,
            (1.1 * radius, 1.1 * radius, 2.6 * radius),
            PART_COLOURS[1],
            towards(offset + np.array([2.0, 0.0, 0.0])),
        )
    else:
        parts.cylinder(offset, (1.5 * radius, 1.5 * radius, 2.0 * radius), PART_COLOURS[2], outward)
    return parts


PART_COLOURS: tuple[Colour, ...] = (palette.SKY, palette.VERMILION, palette.YELLOW)
"""Colours of shields (plates), weapons (barrels that point forward) and canisters."""


def player(weapon: str, ammo: Colour, walked: float, leaning: float = 0.0) -> Parts:
    """Return the player, who faces +x, with the weapon in the hands.

    Args:
        weapon: Name of the weapon.
        ammo: Colour of the ammunition's element.
        walked: Distance walked, which moves the legs [m].
        leaning: Angle to which the body leans forward, as in a dodge [rad].
    """
    parts, swing = Parts(), 0.6 * math.sin(2 * math.pi * walked / 1.8)
    for side in (-1, 1):
        foot = np.array([0.8 * math.sin(side * swing) * 0.8, side * 0.12, 0.08])
        parts.capsule((0.0, side * 0.11, 0.9), foot, 0.085, palette.mixed(PLAYER, (0, 0, 0), 0.35))
        parts.capsule((0.0, side * 0.22, 1.4), (0.38, side * 0.12, 1.22), 0.06, _SKIN)
    parts.box((0.0, 0.0, 1.18), (0.26, 0.40, 0.58), PLAYER, about_y(leaning))
    parts.box((-0.16, 0.0, 1.22), (0.06, 0.44, 0.66), palette.mixed(PLAYER, (255, 255, 255), 0.5))  # cape
    parts.ball((0.03, 0.0, 1.66), (0.26, 0.24, 0.28), _SKIN)
    parts.ball((-0.03, 0.0, 1.70), (0.28, 0.27, 0.28), (150, 70, 40))  # hair
    _weapon(parts, weapon, ammo)
    return parts


def _weapon(parts: Parts, weapon: str, ammo: Colour) -> None:
    """Add a weapon in front of the player, whose shape says which one it is: always four primitives."""
    grip = (0.42, 0.0, 1.24)
    if weapon in ("Carja's Bane", "Sunscourge"):  # bows
        reach = 0.45 if weapon == "Carja's Bane" else 0.62
        for side in (-1, 1):
            parts.rod((0.48, 0.0, 1.24), (0.34, 0.0, 1.24 + side * reach), 0.03, palette.INK)
        parts.rod((0.05, 0.0, 1.24), (0.75, 0.0, 1.24), 0.015, palette.SILVER)
        parts.ball((0.80, 0.0, 1.24), (0.14, 0.09, 0.09), ammo)
    elif weapon == "Corrosive Blastsling":
        for side in (-1, 1):
            parts.rod(grip, (0.60, side * 0.16, 1.50), 0.03, palette.INK)
        parts.rod(grip, (0.42, 0.0, 1.02), 0.035, palette.INK)
        parts.ball((0.55, 0.0, 1.45), (0.22, 0.22, 0.22), ammo)
    elif weapon == "Skykiller":
        parts.rod((0.0, 0.0, 1.34), (0.9, 0.0, 1.34), 0.03, palette.SILVER)
        parts.rod((0.1, 0.0, 1.26), (0.5, 0.0, 1.26), 0.05, palette.INK)
        parts.rod((0.9, 0.0, 1.34), (1.25, 0.0, 1.34), 0.05, ammo)
        parts.ball((1.25, 0.0, 1.34), (0.14, 0.10, 0.10), ammo)
    elif weapon == "Ancestor's Return":
        parts.cylinder((0.62, 0.0, 1.24), (0.5, 0.5, 0.06), palette.SILVER)
        parts.cylinder((0.62, 0.0, 1.26), (0.3, 0.3, 0.06), ammo)
        parts.rod((0.2, 0.0, 1.2), (0.45, 0.0, 1.2), 0.08, palette.INK)
        parts.ball(grip, (0.12, 0.12, 0.12), palette.INK)
    else:  # a bolt thrower
        parts.box((0.50, 0.0, 1.22), (0.70, 0.14, 0.16), palette.INK)
        parts.box((0.30, 0.0, 1.06), (0.12, 0.08, 0.20), palette.INK, about_z(0.0))
        parts.rod((0.84, 0.0, 1.24), (1.02, 0.0, 1.24), 0.04, palette.SILVER)
        parts.box((0.50, 0.0, 1.33), (0.30, 0.10, 0.08), ammo)
