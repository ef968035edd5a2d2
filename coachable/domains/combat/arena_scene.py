"""Sites of fights: ground, walls, pillars and what lies around."""

import math

import numpy as np

from coachable.envs.combat import constants as c
from coachable.envs.combat.tables import SITES, load_table
from coachable.scene import palette
from coachable.scene.frame import Backdrop
from coachable.scene.palette import Colour
from coachable.scene.parts import Parts, Surface, about_y, about_z

_GROUND: dict[str, tuple[Colour, Colour]] = {  # of the ground and of its grid
    "Ice-lake": ((160, 184, 199), (198, 217, 228)),
    "Shining-wastes": ((178, 158, 120), (204, 187, 152)),
    "Arena": ((152, 148, 144), (184, 180, 175)),
}
_RADIUS = 90.0  # [m], of the ground
_GRID, _LINE = 5.0, 0.1  # [m], between lines on the ground and their width
_ROCKS = (42.0, 85.0, 70)  # [m], [m], number
_WALL_HEIGHT = 3.0  # [m]


def arena(site: int) -> Backdrop:
    """Return the scenery of a site by its number."""
    name = SITES[site]
    ground, line = _GROUND.get(name, _GROUND["Arena"])
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rim = np.stack([_RADIUS * np.cos(angle), _RADIUS * np.sin(angle), np.zeros(64)], axis=1)
    index = np.arange(64)
    faces = np.stack([np.full(64, 64), index, (index + 1) % 64], axis=1)
    surface = Surface("ground", np.concatenate([rim, np.zeros((1, 3))]), faces, ground)
    parts = Parts()
    reach = 40.0
    for place in np.arange(-reach, reach + _GRID, _GRID):
        parts.box((place, 0.0, 0.0), (_LINE, 2 * reach, 0.02), line)
        parts.box((0.0, place, 0.0), (2 * reach, _LINE, 0.02), line)
    radius = load_table("sites").number(name, "wall_radius")
    if math.isfinite(radius):
        _wall(parts, radius)
    if load_table("sites").number(name, "pillars"):
        for x, y in c.PILLARS:
            parts.cylinder((x, y, 2.5), (2 * c.PILLAR_RADIUS, 2 * c.PILLAR_RADIUS, 5.0), (150, 132, 104))
            parts.cylinder((x, y, 5.1), (2.4 * c.PILLAR_RADIUS, 2.4 * c.PILLAR_RADIUS, 0.3), (172, 154, 124))
    _rocks(parts, site, palette.mixed(ground, (0, 0, 0), 0.25))
    return Backdrop((surface,), parts)


def _wall(parts: Parts, radius: float) -> None:
    count = 48
    for index in range(count):
        angle = 2 * math.pi * index / count
        size = (0.8, 2 * math.pi * radius / count * 1.02, _WALL_HEIGHT + 0.5 * (index % 2))
        place = (radius * math.cos(angle), radius * math.sin(angle), size[2] / 2)
        parts.box(place, size, (120, 116, 112) if index % 2 else (138, 134, 128), about_z(angle))


def _rocks(parts: Parts, site: int, colour: Colour) -> None:
    """Add rocks around the place of the fight, which give it depth; they are always the same."""
    near, far, count = _ROCKS
    random = np.random.default_rng(site)
    for _ in range(count):
        radius, angle, size = random.uniform(near, far), random.uniform(0, 2 * np.pi), random.uniform(1.5, 6.0)
        place = (radius * math.cos(angle), radius * math.sin(angle), 0.25 * size)
        shade = palette.mixed(colour, palette.WHITE, float(random.uniform(0.0, 0.25)))
        if random.random() < 0.5:
            parts.ball(place, (size, 0.8 * size, 0.9 * size), shade, about_z(angle))
        else:
            parts.box(place, (0.8 * size, 0.6 * size, 1.1 * size), shade, about_y(random.uniform(-0.4, 0.4)))
