"""Scene of a fight: site, player, machines with their parts, attacks, traps, elements and health."""

import math
from collections.abc import Hashable, Mapping, Sequence
from typing import cast

import numpy as np
from torchrl.envs import EnvBase

from coachable.domains.combat.arena_scene import arena
from coachable.domains.combat.machine_scene import PART_COLOURS, PLAYER, machine, player, removable
from coachable.envs.combat import constants as c
from coachable.envs.combat.env import CombatEnv
from coachable.envs.combat.state import ACTIVE, DODGE, IDLE, RECOVER, STAGGERED, TELEGRAPH
from coachable.envs.combat.tables import AMMO, ELEMENTS, KINDS, PART_TYPES, SITES, TRAPS, WEAPONS, load_table
from coachable.envs.combat.traits import AMMO_SLOTS, FARTHEST, KIND, MACHINE_NAMES
from coachable.scene import palette
from coachable.scene.frame import Backdrop, Frame, Gauge, Label, Viewpoint
from coachable.scene.palette import Colour
from coachable.scene.parts import SHAPES, Batch, Parts, about_z, above
from coachable.training.collection import simulation_env

ELEMENT_COLOURS: dict[str, Colour] = {
    "acid": palette.GREEN,
    "purgewater": palette.BLUE,
    "frost": palette.SKY,
    "shock": palette.YELLOW,
    "plasma": palette.PURPLE,
    "fire": palette.VERMILION,
    "adhesive": palette.ORANGE,
    "blast": palette.INK,
}
LAMPS: dict[int, Colour] = {
    IDLE: palette.SKY,
    TELEGRAPH: palette.YELLOW,
    ACTIVE: palette.VERMILION,
    RECOVER: palette.WHITE,
    STAGGERED: palette.PURPLE,
}
_PLAIN = palette.SILVER  # ammunition without an element
_BAR = (2.4, 0.26)  # [m], health bar
_HIGHEST = 4.6  # [m], of a health bar, so that it is in the picture
_SHOWN = 0.05  # build-up of an element from which it is shown
_BOUND_POSTS = 48
_AHEAD = 4.0  # [m], from the player to what the camera looks at
_LAG = 0.3  # share by which the camera turns towards the nearest machine in a control step


class CombatStage:
    """Scene of one fight of a `CombatEnv` or of an environment around it; see `coachable.scene.frame.Stage`."""

    viewpoint = Viewpoint(distance=13.0, elevation=20.0, azimuth=152.0, turns=True, far=170.0, height=1.0)
    legend = (
        *((colour, name) for name, colour in ELEMENT_COLOURS.items()),
        *zip(PART_COLOURS, ("shields (plates)", "weapons (barrels)", "canisters"), strict=True),
        (LAMPS[IDLE], "lamps: the machine is calm"),
        (LAMPS[TELEGRAPH], "lamps: it is about to attack"),
        (LAMPS[ACTIVE], "lamps: it attacks; the marked ground is in reach"),
        (LAMPS[STAGGERED], "lamps: it staggers"),
    )

    def __init__(self) -> None:
        self._key: Hashable = None
        self._episode = 0
        self._begin()

    def backdrop(self, env: EnvBase, row: int = 0) -> Backdrop:
        """Return what does not move; see `Stage.backdrop`."""
        return arena(int(cast(CombatEnv, simulation_env(env)).state.site[row]))

    def frame(self, env: EnvBase, row: int = 0, asked: Mapping[str, float | str] | None = None) -> Frame:
        """Return what is visible now; see `Stage.frame`."""
        env = cast(CombatEnv, simulation_env(env))
        s = {name: value[..., row].cpu().numpy() for name, value in env.state.tensors().items()}
        steps, machines = float(s["steps"]), tuple(s["machine"].tolist())
        if steps < self._steps or machines != self._key:
            self._begin()
            self._key, self._episode = machines, self._episode + 1
        self._steps = steps
        apart = s["enemy_position"][:, _nearest(s)] - s["position"]
        heading = self._turn(math.atan2(apart[1], apart[0]))
        parts, glows, labels = Parts(), Parts(), []
        self._add_player(parts, glows, s)
        for enemy in range(env.num_enemies):
            self._add_machine(parts, glows, labels, env, s, row, enemy)
        marks = _ground_marks(s, glows)
        ahead = np.array([math.cos(heading), math.sin(heading)])
        return Frame(
            parts=parts,
            focus=(*(s["position"] + _AHEAD * ahead).tolist(), self.viewpoint.height),
            heading=heading,
            place=int(s["site"]),
            marks=marks,
            glows=glows,
            labels=labels,
            gauges=_gauges(env, s, row),
            episode=self._episode,
        )

    def _begin(self) -> None:
        self._steps = 0.0
        self._heading: float | None = None
        self._walked: dict[int, float] = {}  # by enemy, -1 for the player
        self._places: dict[int, np.ndarray] = {}
        self._rounds: tuple[int, float] | None = None  # section of the wheel, and rounds in it

    def _turn(self, direction: float) -> float:
        """Turn the camera towards a direction [rad] with a lag, and return where it looks then."""
        before = direction if self._heading is None else self._heading
        self._heading = before + _LAG * math.remainder(direction - before, 2 * math.pi)
        return self._heading

    def _walk(self, who: int, place: np.ndarray) -> float:
        """Return the distance that somebody has walked since the fight began [m]."""
        before = self._places.get(who, place)
        self._walked[who] = self._walked.get(who, 0.0) + float(np.hypot(*(place - before)))
        self._places[who] = place
        return self._walked[who]

    def _add_player(self, parts: Parts, glows: Parts, s: Mapping[str, np.ndarray]) -> None:
        weapon, section = int(s["weapon"]), int(s["section"])
        colour = _ammo_colour(AMMO[weapon][section])
        yaw, place = float(s["yaw"]), s["position"]
        leaning = 0.6 if s["timers"][DODGE] > 0 else 0.0
        figure = player(WEAPONS[weapon], colour, self._walk(-1, place), leaning)
        parts.figure(figure, (*place, 0.0), about_z(yaw))
        parts.cylinder((*place, 0.03), (1.6, 1.6, 0.03), palette.mixed(PLAYER, palette.WHITE, 0.3))
        wheel = AMMO_SLOTS * weapon + section
        rounds = float(s["magazine"][wheel])
        fired = self._rounds is not None and self._rounds[0] == wheel and rounds < self._rounds[1]
        self._rounds = wheel, rounds
        eye = np.array([*place, c.EYE_HEIGHT])
        if fired:  # the line of fire, as far as the nearest machine
            pitch = float(s["pitch"])
            reach = float(np.hypot(*(s["enemy_position"][:, _nearest(s)] - place)))
            ray = np.array([math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch)])
            glows.rod(eye + ray, eye + max(reach, 2.0) * ray, 0.06, colour)

    def _add_machine(
        self,
        parts: Parts,
        glows: Parts,
        labels: list[Label],
        env: CombatEnv,
        s: Mapping[str, np.ndarray],
        row: int,
        enemy: int,
    ) -> None:
        radius, hp = float(env.traits.radius[enemy, row]), float(s["enemy_hp"][enemy])
        place, yaw, phase = s["enemy_position"][:, enemy], float(s["enemy_yaw"][enemy]), int(s["phase"][enemy])
        name, full, alive = MACHINE_NAMES[int(s["machine"][enemy])], float(env.traits.hp[enemy, row]), hp > 0
        ground = np.array([*place, float(s["enemy_z"][enemy]) if alive else -0.4 * radius])
        figure = machine(name, radius, self._walk(enemy, place), LAMPS[phase], alive)
        turn = np.array(about_z(yaw))
        parts.figure(figure, ground, turn)
        size = float(env.traits.part_radius[enemy, row])
        for slot in range(s["count"].shape[0]):
            kinds = env.traits.part_type[:, slot, enemy, row]
            if float(kinds.sum()) > 0:
                offset = env.traits.offset[:, slot, enemy, row].cpu().numpy().astype(float)
                part = removable(int(kinds.argmax()), size, offset)
                shown = part if s["count"][slot, enemy] > 0 else _vanished(part)
                parts.figure(shown, above(ground, radius), turn)
        azimuth, height = math.radians(self.viewpoint.azimuth) + (self._heading or 0.0), 2.6 * radius + 0.8
        top = above(ground, min(height, _HIGHEST))
        if height > _HIGHEST:  # the bar of a tall machine is in front of it
            top += 1.6 * radius * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        _health_bar(parts, top, hp / full, azimuth)
        active = [e for i, e in enumerate(ELEMENTS) if s["state_timer"][i, enemy] > 0]
        for index, element in enumerate(active):
            ring = 2 * radius + 1.0 + 0.7 * index
            glows.cylinder((*place, 0.10 + 0.03 * index), (ring, ring, 0.12), ELEMENT_COLOURS[element])
            glows.ball(above(ground, 2.2 * radius + 0.4 * index), (0.5,) * 3, ELEMENT_COLOURS[element])
        labels.append(Label(" · ".join([f"{name} {max(hp, 0.0):.0f} HP", *active]), above(top, 0.3)))
        if alive and phase in (TELEGRAPH, ACTIVE):
            blow = env.traits.attacks[:, int(s["attack"][enemy]), enemy, row]
            reach = radius + c.BODY_RADIUS + min(float(blow[FARTHEST]), 40.0)
            _warning(glows, place, yaw, radius, KINDS[int(blow[KIND])], reach, LAMPS[phase])
        for slot in range(c.SHOT_SLOTS):
            if s["land_timer"][slot, enemy] > 0:
                target = s["shot_point"][:, slot, enemy]
                glows.cylinder((*target, 0.08), (2 * c.SHOT_RADIUS, 2 * c.SHOT_RADIUS, 0.08), palette.VERMILION)
                glows.rod(above(ground, radius), (*target, 0.3), 0.05, palette.VERMILION)


def _nearest(s: Mapping[str, np.ndarray]) -> int:
    """Return the number of the nearest living machine, or of the nearest if none lives."""
    squared = ((s["enemy_position"] - s["position"][:, None]) ** 2).sum(0) + 1e6 * (s["enemy_hp"] <= 0)
    return int(squared.argmin())


def _ammo_colour(ammo: str) -> Colour:
    elements = load_table("weapons").words(ammo, "element", ELEMENTS)
    return ELEMENT_COLOURS[elements[0]] if elements else _PLAIN


def _vanished(parts: Parts) -> Parts:
    """Return primitives without a size, which keep the number of primitives of a machine."""
    gone = Parts()
    for shape in SHAPES:
        batch = parts.of(shape)
        if len(batch):
            gone.batch(shape, Batch(batch.positions, batch.wxyzs, 0.0 * batch.sizes + 1e-4, batch.colours))
    return gone


def _health_bar(parts: Parts, place: np.ndarray, share: float, azimuth: float) -> None:
    """Add a bar that is upright and turned to the camera, which is in a direction [rad]."""
    share, across = min(max(share, 0.0), 1.0), azimuth + math.pi / 2
    along = np.array([math.cos(across), math.sin(across), 0.0])
    length, height = _BAR
    colour = palette.GREEN if share > 0.5 else palette.ORANGE if share > 0.25 else palette.VERMILION
    parts.box(place, (length + 0.1, 0.08, height + 0.1), palette.INK, about_z(across))
    filled = place + (share - 1.0) * length / 2 * along
    parts.box(filled, (max(share * length, 1e-3), 0.14, height), colour, about_z(across))


def _warning(
    glows: Parts, place: np.ndarray, yaw: float, radius: float, kind: str, reach: float, colour: Colour
) -> None:
    """Mark the ground that an attack reaches."""
    if kind == "area":
        glows.cylinder((*place, 0.06), (2 * reach, 2 * reach, 0.06), colour)
        return
    if kind == "cone":
        glows.sector((*place, 0.06), (2 * reach, 2 * reach, 0.06), colour, about_z(yaw))
        return
    middle = place + reach / 2 * np.array([math.cos(yaw), math.sin(yaw)])
    glows.box((*middle, 0.06), (reach, 2 * radius if kind == "charge" else 0.3, 0.04), colour, about_z(yaw))


def _ground_marks(s: Mapping[str, np.ndarray], glows: Parts) -> Parts:
    """Return traps and the bound of the fight; burning ground is added to the translucent primitives."""
    marks = Parts()
    for slot in range(c.TRAP_SLOTS):
        kind = int(s["trap_type"][slot])
        if kind >= 0:
            x, y = s["trap_position"][:, slot].tolist()
            armed, colour = bool(s["trap_arm"][slot] <= 0), ELEMENT_COLOURS[TRAPS[kind]]
            marks.cylinder((x, y, 0.06), (1.2, 1.2, 0.12), palette.SLATE)
            marks.cylinder((x, y, 0.14), (0.8, 0.8, 0.12), colour if armed else palette.SILVER)
            for turn in (0.0, math.pi / 2):
                marks.box((x, y, 0.2), (1.5, 0.08, 0.06), colour, about_z(turn))
    for slot in range(c.HAZARD_SLOTS):
        if s["hazard_timer"][slot] > 0:
            place = (*s["hazard_position"][:, slot].tolist(), 0.08)
            glows.cylinder(place, (2 * c.HAZARD_RADIUS, 2 * c.HAZARD_RADIUS, 0.1), palette.ORANGE)
    anchor = s["anchor"]
    for index in range(_BOUND_POSTS):
        angle = 2 * math.pi * index / _BOUND_POSTS
        place = anchor + c.BOUND_RADIUS * np.array([math.cos(angle), math.sin(angle)])
        marks.box((*place, 0.05), (0.14, 2.0, 0.06), palette.VERMILION, about_z(angle))
    return marks


def _gauges(env: CombatEnv, s: Mapping[str, np.ndarray], row: int) -> Sequence[Gauge]:
    weapon, section = int(s["weapon"]), int(s["section"])
    ammo, wheel = AMMO[weapon][section], AMMO_SLOTS * weapon + section
    left, full = float(s["magazine"][wheel]), load_table("weapons").number(ammo, "magazine")
    hp, stamina = float(s["hp"]), float(s["stamina"])
    gauges = [
        Gauge("health", f"{hp:.0f} of {c.PLAYER_HP:.0f} HP", hp / c.PLAYER_HP, PLAYER),
        Gauge("stamina", f"{stamina:.0f} %", stamina / c.STAMINA, palette.GREEN),
        Gauge(WEAPONS[weapon], f"{ammo}: {left:.0f}", left / full, _ammo_colour(ammo)),
        Gauge("berries", f"{float(s['berries']):.0f} of {c.BERRIES}", float(s["berries"]) / c.BERRIES, palette.PURPLE),
    ]
    enemy = _nearest(s)
    built = {name: float(s["gauge"][i, enemy]) for i, name in enumerate(ELEMENTS)}
    strongest = max(built, key=lambda name: built[name])
    shown = built[strongest] > _SHOWN
    text = f"{strongest} {built[strongest]:.0%}" if shown else "none"
    gauges.append(Gauge("build-up", text, built[strongest] if shown else 0.0, ELEMENT_COLOURS[strongest]))
    counts = s["count"][:, enemy]
    kinds = env.traits.part_type[:, :, enemy, row].cpu().numpy()
    remaining = ", ".join(f"{name}s {float(kinds[i] @ counts):.0f}" for i, name in enumerate(PART_TYPES))
    gauges.append(Gauge("parts left", remaining))
    gauges.append(Gauge("site", f"{SITES[int(s['site'])]}, {float(s['steps']) * c.CONTROL_STEP:.0f} s"))
    return gauges
