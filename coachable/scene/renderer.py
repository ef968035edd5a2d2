"""Pictures of scenes for films, drawn off-screen by MuJoCo, with labels, gauges and a legend."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torchrl.envs import EnvBase

from coachable.offscreen import OffscreenMujoco
from coachable.scene.frame import Backdrop, Frame, Map, Stage
from coachable.scene.palette import INK, SILVER, WHITE, Colour
from coachable.scene.parts import BALL, BOX, CYLINDER, SHAPES

_GEOMS = {
    BOX: mujoco.mjtGeom.mjGEOM_BOX,
    BALL: mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER,
}
_SKY: Colour = (214, 224, 234)
GLOW = 0.45  # opacity of the translucent primitives
_MOST = 4000  # primitives
_GROUND = "ground"
_FIELD = 45.0  # [deg], of view


class SceneRenderer:
    """Renderer of a stage, which is a `coachable.domain.Renderer`.

    Args:
        stage: Description of the scene.
        width: Width of the image [px].
        height: Height of the image [px].

    Raises:
        RenderingError: If no OpenGL library is installed.
    """

    def __init__(self, make_stage: Callable[[], Stage], width: int = 640, height: int = 480) -> None:
        self._stage, self._size = make_stage(), (width, height)
        self._line = max(10, width // 50)  # [px], height of the text
        self._font = ImageFont.load_default(size=self._line)
        self._place: Hashable = None
        self._offscreen: OffscreenMujoco | None = None
        self._build(Backdrop(()))  # raises here if there is no OpenGL

    def draw(self, env: EnvBase, row: int = 0) -> np.ndarray:
        """Return an image (height, width, 3) uint8 of the present state of one row."""
        frame = self._stage.frame(env, row)
        if frame.place != self._place:
            self._build(self._stage.backdrop(env, row))
            self._place = frame.place
        assert self._offscreen is not None
        self._aim(frame)
        picture = self._offscreen.draw(self._data, lambda scene: _decorate(scene, frame))
        return self._overlay(picture, frame)

    def close(self) -> None:
        """Release the OpenGL context."""
        if self._offscreen is not None:
            self._offscreen.close()
            self._offscreen = None

    def _build(self, backdrop: Backdrop) -> None:
        """Compile a model of what does not move."""
        self.close()
        spec = mujoco.MjSpec()
        spec.visual.global_.offwidth, spec.visual.global_.offheight = self._size
        spec.visual.global_.fovy = _FIELD
        spec.visual.headlight.ambient[:], spec.visual.headlight.diffuse[:] = 0.42, 0.35
        spec.visual.headlight.specular[:] = 0.05
        spec.stat.extent = 1.0
        spec.visual.map.znear, spec.visual.map.zfar = 0.2, self._stage.viewpoint.far
        spec.add_texture(
            name="sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=np.divide(_SKY, 255.0),
            rgb2=np.divide(SILVER, 255.0),
            width=64,
            height=384,
        )
        light = spec.worldbody.add_light(pos=(0, 0, 50), dir=(-0.4, 0.3, -1.0))
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        light.diffuse[:], light.specular[:] = 0.5, 0.1
        ground = spec.worldbody.add_body(name=_GROUND, mocap=True)
        for surface in backdrop.surfaces:
            spec.add_mesh(
                name=surface.name,
                uservert=surface.vertices.astype(float).ravel().tolist(),
                userface=surface.faces.ravel().tolist(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
            )
            ground.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH, meshname=surface.name, rgba=_rgba(surface.colour), **_STILL
            )
        for shape in SHAPES:
            batch = backdrop.parts.of(shape)
            for at, turn, size, colour in zip(
                batch.positions, batch.wxyzs, batch.sizes, batch.colours.tolist(), strict=True
            ):
                ground.add_geom(
                    type=_GEOMS[shape], pos=at, quat=turn, size=_half(shape, size), rgba=_rgba(colour), **_STILL
                )
        self._travels = backdrop.travels
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._offscreen = OffscreenMujoco(self._model, *self._size, most=_MOST + self._model.ngeom)

    def _aim(self, frame: Frame) -> None:
        assert self._offscreen is not None
        view, camera = self._stage.viewpoint, self._offscreen.camera
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = frame.focus
        camera.distance, camera.elevation = view.distance, -view.elevation
        # MuJoCo's azimuth is the direction in which the camera looks.
        camera.azimuth = view.azimuth + 180.0 + (math.degrees(frame.heading) if view.turns else 0.0)
        self._data.mocap_pos[0] = (*np.round(frame.focus[:2]), 0.0) if self._travels else (0.0, 0.0, 0.0)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)

    def _overlay(self, picture: np.ndarray, frame: Frame) -> np.ndarray:
        image = Image.fromarray(picture)
        pen = ImageDraw.Draw(image, "RGBA")
        for label in frame.labels:
            self._write(pen, label.text, self._seen(np.asarray(label.position, dtype=float), frame))
        if frame.map is not None:
            self._draw_map(pen, frame.map)
        line = self._line + 6
        top = self._size[1] - 6 - line * len(frame.gauges)
        for index, gauge in enumerate(frame.gauges):
            y = top + index * line
            if index == 0:
                pen.rectangle((0, y - 4, 0.44 * self._size[0], self._size[1]), fill=(*INK, 170))
            if gauge.share is not None:
                left, right = 0.17 * self._size[0], 0.43 * self._size[0]
                share = min(max(gauge.share, 0.0), 1.0)
                pen.rectangle((left, y + 1, right, y + line - 4), fill=(255, 255, 255, 60))
                pen.rectangle((left, y + 1, left + share * (right - left), y + line - 4), fill=(*gauge.colour, 255))
            style = {"fill": WHITE, "font": self._font, "stroke_width": 1, "stroke_fill": (*INK, 255)}
            pen.text((6, y), gauge.name, **style)
            pen.text((0.18 * self._size[0], y), gauge.text, **style)
        return np.asarray(image)

    def _draw_map(self, pen: ImageDraw.ImageDraw, small: Map) -> None:
        side = 0.26 * self._size[1]
        corner = np.array([self._size[0] - side, 0.0])
        pen.rectangle((*corner, self._size[0], side), fill=(*INK, 120))
        outline, places = small.scaled(side, side)
        points = [tuple(point) for point in [*(outline + corner), outline[0] + corner]]
        pen.line(points, fill=(*WHITE, 255), width=2)
        for index in reversed(range(len(places))):  # the agent's last, above the others
            x, y = places[index] + corner
            pen.ellipse((x - 4, y - 4, x + 4, y + 4), fill=(*small.colours[index % len(small.colours)], 255))

    def _write(self, pen: ImageDraw.ImageDraw, text: str, at: tuple[float, float] | None) -> None:
        if at is not None:
            style = {"font": self._font, "anchor": "mb", "stroke_width": 2, "stroke_fill": (*WHITE, 255)}
            pen.text(at, text, fill=INK, **style)

    def _seen(self, place: np.ndarray, frame: Frame) -> tuple[float, float] | None:
        """Return the pixel of a place, or None behind the camera."""
        view = self._stage.viewpoint
        azimuth = math.radians(view.azimuth) + (frame.heading if view.turns else 0.0)
        up = math.radians(view.elevation)
        back = np.array([math.cos(up) * math.cos(azimuth), math.cos(up) * math.sin(azimuth), math.sin(up)])
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        offset = place - (np.asarray(frame.focus) + view.distance * back)
        depth = -offset @ back
        if depth < 0.1:
            return None
        scale = 0.5 * self._size[1] / math.tan(math.radians(_FIELD) / 2) / float(depth)
        across, upwards = float(offset @ right), float(offset @ np.cross(back, right))
        return self._size[0] / 2 + scale * across, self._size[1] / 2 - scale * upwards


def _decorate(scene: mujoco.MjvScene, frame: Frame) -> None:
    """Add the primitives of a frame to MuJoCo's scene, as many as there is room for."""
    for parts, opacity in ((frame.parts, 1.0), (frame.marks, 1.0), (frame.glows, GLOW)):
        for shape in SHAPES:
            batch = parts.of(shape)
            colours = np.concatenate([batch.colours / 255.0, np.full((len(batch), 1), opacity)], axis=1)
            turn = np.zeros(9)
            for at, wxyz, size, colour in zip(batch.positions, batch.wxyzs, batch.sizes, colours, strict=True):
                if scene.ngeom == scene.maxgeom:
                    return
                mujoco.mju_quat2Mat(turn, wxyz)
                geom = scene.geoms[scene.ngeom]
                mujoco.mjv_initGeom(geom, _GEOMS[shape], size / 2, at, turn, colour.astype(np.float32))
                geom.size[:] = size / 2  # also of cylinders, which may be elliptic
                geom.specular, geom.category = 0.1, mujoco.mjtCatBit.mjCAT_DYNAMIC
                scene.ngeom += 1


_STILL = {"contype": 0, "conaffinity": 0}


def _rgba(colour, opacity: float = 1.0) -> np.ndarray:
    return np.array([*np.divide(colour, 255.0), opacity])


def _half(shape: str, size: np.ndarray) -> np.ndarray:
    """Return MuJoCo's size of a primitive: half lengths, and radius and half length of a cylinder."""
    return np.array([size[0] / 2, size[2] / 2, 0.0]) if shape == CYLINDER else np.asarray(size) / 2
