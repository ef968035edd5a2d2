"""Top-down images of a fight with machines, attacks, traps, parts, health and ammo, drawn with Pillow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torchrl.envs import EnvBase

from coachable.envs.combat import constants as c
from coachable.envs.combat.env import CombatEnv
from coachable.envs.combat.gamepad import describe
from coachable.envs.combat.state import ACTIVE, IDLE, RECOVER, STAGGERED, TELEGRAPH
from coachable.envs.combat.tables import AMMO, ELEMENTS, KINDS, SITES, TRAPS, WEAPONS
from coachable.envs.combat.traits import FARTHEST, KIND, MACHINE_NAMES

Colour = tuple[int, int, int]
_GROUND: dict[str, Colour] = {"Ice-lake": (222, 235, 242), "Shining-wastes": (240, 229, 205), "Arena": (228, 224, 220)}
_INK, _FAINT, _PLAYER = (40, 40, 46), (165, 165, 170), (28, 95, 180)
_PHASE: dict[int, Colour] = {
    IDLE: (120, 120, 128),
    TELEGRAPH: (240, 170, 20),
    ACTIVE: (215, 40, 40),
    RECOVER: (150, 120, 100),
    STAGGERED: (120, 90, 200),
}
_PARTS: tuple[Colour, ...] = ((70, 120, 190), (190, 60, 60), (230, 190, 40))  # shield, weapon, canister
_ELEMENT: dict[str, Colour] = {
    "acid": (130, 170, 30),
    "purgewater": (30, 150, 200),
    "frost": (110, 180, 230),
    "shock": (150, 130, 250),
    "plasma": (190, 70, 220),
    "fire": (235, 100, 20),
    "adhesive": (160, 120, 60),
    "blast": (60, 60, 60),
}
_METRES = 24.0  # from the centre to the nearer edge of the map
_PANEL = 92  # [px] below the map


class CombatRenderer:
    """Renderer of one fight of a `CombatEnv` or of an environment around it; the map follows the player.

    Args:
        width: Width of the image [px].
        height: Height of the image, with the panel [px].
    """

    def __init__(self, width: int = 640, height: int = 480) -> None:
        self.width, self.height = width, height
        self._map_height = height - _PANEL
        self._scale = min(width, self._map_height) / (2 * _METRES)
        self._font = ImageFont.load_default(size=max(10, width // 54))

    def draw(self, env: EnvBase, row: int = 0) -> np.ndarray:
        """Return an image (height, width, 3) uint8 of the current state of one fight."""
        while not isinstance(env, CombatEnv):
            env = cast(EnvBase, env.base_env)
        s = {name: value[..., row].cpu() for name, value in env.state.tensors().items()}
        site = SITES[int(s["site"])]
        image = Image.new("RGB", (self.width, self.height), _GROUND[site])
        pen = ImageDraw.Draw(image)
        self._centre = (float(s["position"][0]), float(s["position"][1]))
        self._draw_place(pen, s, site)
        for enemy in range(env.num_enemies):
            self._draw_machine(pen, env, s, row, enemy)
        self._draw_player(pen, s)
        self._draw_panel(pen, env, s, row, site)
        return np.asarray(image)

    def close(self) -> None:
        """Do nothing, because there is nothing to release."""

    # -- the map ---------------------------------------------------------------------------------------------------

    def _at(self, x: float, y: float) -> tuple[float, float]:
        return (
            self.width / 2 + (x - self._centre[0]) * self._scale,
            self._map_height / 2 - (y - self._centre[1]) * self._scale,
        )

    def _circle(self, pen: ImageDraw.ImageDraw, place: Sequence[float], metres: float, **style: Any) -> None:
        px, py = self._at(*place)
        r = metres * self._scale
        pen.ellipse((px - r, py - r, px + r, py + r), **style)

    def _arrow(self, pen: ImageDraw.ImageDraw, x: float, y: float, yaw: float, metres: float, fill: Colour) -> None:
        pen.line((self._at(x, y), self._at(x + metres * math.cos(yaw), y + metres * math.sin(yaw))), fill=fill, width=2)

    def _draw_place(self, pen: ImageDraw.ImageDraw, s: dict, site: str) -> None:
        anchor = s["anchor"].tolist()
        self._circle(pen, anchor, c.BOUND_RADIUS, outline=(200, 80, 80), width=2)
        if site == "Arena":
            self._circle(pen, (0.0, 0.0), 38.0, outline=_INK, width=4)
        if site == "Shining-wastes":
            for x, y in c.PILLARS:
                self._circle(pen, (x, y), c.PILLAR_RADIUS, fill=(150, 130, 100))
        for slot in range(c.HAZARD_SLOTS):
            if s["hazard_timer"][slot] > 0:
                self._circle(pen, s["hazard_position"][:, slot].tolist(), c.HAZARD_RADIUS, fill=(245, 190, 160))
        for slot in range(c.TRAP_SLOTS):
            kind = int(s["trap_type"][slot])
            if kind >= 0:
                armed = bool(s["trap_arm"][slot] <= 0)
                x, y = s["trap_position"][:, slot].tolist()
                self._circle(pen, (x, y), 0.5, outline=_INK, fill=_ELEMENT[TRAPS[kind]] if armed else None)

    def _draw_machine(self, pen: ImageDraw.ImageDraw, env: CombatEnv, s: dict, row: int, enemy: int) -> None:
        x, y = s["enemy_position"][:, enemy].tolist()
        radius, yaw = float(env.traits.radius[enemy, row]), float(s["enemy_yaw"][enemy])
        phase = int(s["phase"][enemy])
        alive = bool(s["enemy_hp"][enemy] > 0)
        colour = _PHASE[phase] if alive else _FAINT
        blow = env.traits.attacks[:, int(s["attack"][enemy]), enemy, row]
        if alive and phase in (TELEGRAPH, ACTIVE):
            self._draw_warning(pen, x, y, radius, yaw, KINDS[int(blow[KIND])], float(blow[FARTHEST]), colour)
        self._circle(pen, (x, y), radius, fill=colour, outline=_INK)
        for slot in range(s["count"].shape[0]):
            if s["count"][slot, enemy] > 0:
                dx, dy, _ = env.traits.offset[:, slot, enemy, row].tolist()
                px = x + math.cos(yaw) * dx - math.sin(yaw) * dy
                py = y + math.sin(yaw) * dx + math.cos(yaw) * dy
                kind = int(env.traits.part_type[:, slot, enemy, row].argmax())
                self._circle(pen, (px, py), 0.25 + 0.1 * radius, fill=_PARTS[kind], outline=_INK)
        self._arrow(pen, x, y, yaw, 1.6 * radius, _INK)
        for slot in range(c.SHOT_SLOTS):
            if s["land_timer"][slot, enemy] > 0:
                point = s["shot_point"][:, slot, enemy].tolist()
                self._circle(pen, point, c.SHOT_RADIUS, outline=(215, 40, 40), width=2)
        states = [name for i, name in enumerate(ELEMENTS) if s["state_timer"][i, enemy] > 0]
        for i, name in enumerate(states):
            self._circle(pen, (x, y), radius + 0.4 + 0.25 * i, outline=_ELEMENT[name], width=3)
        px, py = self._at(x, y + radius + 1.6)
        share = float(s["enemy_hp"][enemy] / env.traits.hp[enemy, row])
        self._bar(pen, px - 30, py - 4, 60, 7, share, (200, 50, 50))

    def _draw_warning(
        self,
        pen: ImageDraw.ImageDraw,
        x: float,
        y: float,
        radius: float,
        yaw: float,
        kind: str,
        far: float,
        fill: Colour,
    ) -> None:
        reach = radius + c.BODY_RADIUS + far
        if kind == "area":
            self._circle(pen, (x, y), reach, outline=fill, width=2)
        elif kind == "cone":
            px, py = self._at(x, y)
            r, degrees = reach * self._scale, -math.degrees(yaw)
            pen.arc((px - r, py - r, px + r, py + r), degrees - 60, degrees + 60, fill=fill, width=2)
        else:
            self._arrow(pen, x, y, yaw, reach, fill)

    def _draw_player(self, pen: ImageDraw.ImageDraw, s: dict) -> None:
        x, y = self._centre
        yaw = float(s["yaw"])
        for side in (-math.pi / 6, math.pi / 6):
            self._arrow(pen, x, y, yaw + side, 6.0, _FAINT)
        corners = [(0.9, 0.0), (0.6, 2.5), (0.6, -2.5)]
        pen.polygon(
            [self._at(x + r * math.cos(yaw + a), y + r * math.sin(yaw + a)) for r, a in corners],
            fill=_PLAYER,
            outline=_INK,
        )

    # -- the panel -------------------------------------------------------------------------------------------------

    def _bar(
        self, pen: ImageDraw.ImageDraw, x: float, y: float, width: float, height: float, share: float, fill: Colour
    ) -> None:
        pen.rectangle((x, y, x + width, y + height), fill=(250, 250, 250), outline=_INK)
        pen.rectangle((x, y, x + width * max(0.0, min(1.0, share)), y + height), fill=fill, outline=_INK)

    def _draw_panel(self, pen: ImageDraw.ImageDraw, env: CombatEnv, s: dict, row: int, site: str) -> None:
        top = self._map_height
        pen.rectangle((0, top, self.width, self.height), fill=(250, 250, 250))
        line = _PANEL / 5
        self._bar(pen, 8, top + 6, 150, 10, float(s["hp"]) / c.PLAYER_HP, _PLAYER)
        self._bar(pen, 8, top + 20, 150, 6, float(s["stamina"]) / c.STAMINA, (90, 170, 90))
        weapon, section = int(s["weapon"]), int(s["section"])
        gauges = [
            f"{name} {float(s['gauge'][i, 0]):.0%}" for i, name in enumerate(ELEMENTS) if float(s["gauge"][i, 0]) > 0.05
        ]
        active = [name.upper() for i, name in enumerate(ELEMENTS) if s["state_timer"][i, 0] > 0]
        machines = ", ".join(
            f"{MACHINE_NAMES[int(s['machine'][e])]} {float(s['enemy_hp'][e]):.0f} HP" for e in range(env.num_enemies)
        )
        left = int(s["magazine"][3 * weapon + section])
        lines = [
            f"{machines} | {site} | {float(s['steps']) * c.CONTROL_STEP:.1f} s",
            f"{WEAPONS[weapon]}: {AMMO[weapon][section]} ({left})  berries {int(s['berries'])}",
            "  ".join([*active, *gauges]) or "no element",
            describe(s["actions"][:24]).replace("✕", "cross").replace("○", "circle").replace("□", "square"),
        ]
        for i, text in enumerate(lines):
            text = text.replace("↑", "up").replace("↓", "down").replace("←", "left").replace("→", "right")
            pen.text((170, top + 4 + i * line), text, fill=_INK, font=self._font)
