"""Pictures of scenes for films, drawn off-screen by MuJoCo, with labels, gauges and a map."""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torchrl.envs import EnvBase

from coachable.offscreen import OffscreenMujoco
from coachable.scene.between import between, continues
from coachable.scene.frame import Backdrop, Frame, Gauge, Map, Stage
from coachable.scene.palette import AIR, HAZE, INK, WHITE, Colour, mixed
from coachable.scene.parts import BALL, BOX, CYLINDER, SECTOR, SHAPES, rotated, unit_mesh

_GEOMS = {
    BOX: mujoco.mjtGeom.mjGEOM_BOX,
    BALL: mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER,
    SECTOR: mujoco.mjtGeom.mjGEOM_TRIANGLE,  # several of them
}
_NARROW, _COLUMNS = 480, 2  # [px], width below which the gauges stand in columns below the scene
_SMALLEST = 6  # [px], height of the text below which it is not made smaller
_BAR = 0.26  # of the width, least length of a gauge's bar
GLOW = 0.45  # opacity of the translucent primitives
_MOST = 4000  # primitives
_GROUND = "ground"
_FIELD = 45.0  # [deg], of view
_FINER = 2  # pixels drawn along each side of a pixel; software draws them faster than the samples of OpenGL
_FINEST = 4096  # [px], largest side that is drawn so


class SceneRenderer:
    """Renderer of a stage, which is a `coachable.domain.Renderer`.

    Args:
        make_stage: Makes the description of the scene.
        width: Width of the image [px].
        height: Height of the image [px].

    Raises:
        RenderingError: If no OpenGL library is installed.
    """

    def __init__(self, make_stage: Callable[[], Stage], width: int = 640, height: int = 480) -> None:
        self._stage, self._size = make_stage(), (width, height)
        self._finer = _FINER if _FINER * max(width, height) <= _FINEST else 1
        self._line = max(12, width // 50)  # [px], height of the text; the spaces of smaller letters vanish
        self._font = ImageFont.load_default(size=self._line)
        self._strip = 0  # [px], height of the gauges below the scene
        self._place: Hashable = None
        self._offscreen: OffscreenMujoco | None = None
        self._last: Frame | None = None
        self._build(Backdrop(()))  # raises here if there is no OpenGL

    def draw(self, env: EnvBase, row: int = 0) -> np.ndarray:
        """Draw the present state of one row of a base environment.

        Returns:
            Image (height, width, 3) uint8.
        """
        return self.draw_way(env, row)[0]

    def draw_way(
        self,
        env: EnvBase,
        row: int = 0,
        asked: Mapping[str, float | str] | None = None,
        shares: Sequence[float] = (1.0,),
    ) -> list[np.ndarray]:
        """Draw states on the way from that of the last call to the present one; call it once per control step.

        Args:
            env: The environment.
            row: Row of the environment.
            asked: The style in force, if known.
            shares: Shares of the way, from 0 to 1. If the two states are not continuous, every picture shows the
                present one.

        Returns:
            An image (height, width, 3) uint8 for each share.
        """
        frame, last = self._stage.frame(env, row, asked), self._last
        self._last = frame
        strip = self._strip_of(frame)
        if shares and (frame.place, strip) != (self._place, self._strip):
            self._strip = strip
            self._build(self._stage.backdrop(env, row))
            self._place = frame.place
        if last is None or not continues(last, frame):
            last = frame
        return [self._draw(between(last, frame, share) if share < 1.0 else frame) for share in shares]

    def _draw(self, frame: Frame) -> np.ndarray:
        assert self._offscreen is not None
        self._aim(frame)
        fine = self._offscreen.draw(self._data, lambda scene: _decorate(scene, frame))
        return self._overlay(Image.fromarray(fine).reduce(self._finer), frame)

    def close(self) -> None:
        """Release the OpenGL context."""
        if self._offscreen is not None:
            self._offscreen.close()
            self._offscreen = None

    def _build(self, backdrop: Backdrop) -> None:
        """Compile a model of what does not move."""
        self.close()
        spec = mujoco.MjSpec()
        width, height = self._finer * self._size[0], self._finer * self._height
        spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
        spec.visual.quality.offsamples = 0
        spec.visual.global_.fovy = _FIELD
        spec.visual.headlight.ambient[:], spec.visual.headlight.diffuse[:] = 0.42, 0.35
        spec.visual.headlight.specular[:] = 0.05
        spec.stat.extent = 1.0
        spec.visual.map.znear, spec.visual.map.zfar = 0.2, self._stage.viewpoint.far
        spec.visual.map.fogstart, spec.visual.map.fogend = self._stage.viewpoint.haze
        spec.visual.rgba.fog[:] = _rgba(HAZE)
        spec.add_texture(
            name="sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=np.divide(AIR, 255.0),
            rgb2=np.divide(mixed(AIR, HAZE, 2.0), 255.0),  # the horizon is halfway
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
        self._offscreen = OffscreenMujoco(self._model, width, height, most=_MOST + self._model.ngeom, haze=True)

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

    def _overlay(self, image: Image.Image, frame: Frame) -> np.ndarray:
        pen = ImageDraw.Draw(image, "RGBA")
        for label in frame.labels:
            self._write(pen, label.text, self._seen(np.asarray(label.position, dtype=float), frame))
        if frame.map is not None:
            self._draw_map(pen, frame.map)
        if self._strip:
            whole = Image.new("RGB", self._size, INK)
            whole.paste(image)
            self._draw_strip(ImageDraw.Draw(whole), frame.gauges)
            return np.asarray(whole)
        self._draw_gauges(pen, frame.gauges)
        return np.asarray(image)

    @property
    def _height(self) -> int:
        """Height of the scene [px]."""
        return self._size[1] - self._strip

    def _strip_of(self, frame: Frame) -> int:
        """Return the height of the gauges below a narrow scene [px]; 0 where they fit into its corner."""
        rows = -(-len(frame.gauges) // _COLUMNS)
        return rows * (self._line + 6) + 4 if rows and self._size[0] < _NARROW else 0

    def _draw_strip(self, pen: ImageDraw.ImageDraw, gauges: Sequence[Gauge]) -> None:
        """Write the gauges below the scene: names and texts, with thin bars below them."""
        gap, line, width = 6, self._line + 6, self._size[0] / _COLUMNS
        names = max(pen.textlength(gauge.name, self._font) for gauge in gauges)
        for index, gauge in enumerate(gauges):
            row, column = divmod(index, _COLUMNS)
            x, y = gap + column * width, self._height + 3 + row * line
            room = width - names - 3 * gap
            fonts = [self._font, *(ImageFont.load_default(size=size) for size in range(self._line - 1, _SMALLEST, -1))]
            fitting = next((font for font in fonts if pen.textlength(gauge.text, font) <= room), fonts[-1])
            middle = y + line / 2 - 3
            pen.text((x, middle), gauge.name, fill=mixed(WHITE, INK, 0.3), font=self._font, anchor="lm")
            pen.text((x + names + gap, middle), gauge.text, fill=WHITE, font=fitting, anchor="lm")
            if gauge.share is not None:
                foot, share = y + line - 4, min(max(gauge.share, 0.0), 1.0)
                pen.rectangle((x, foot, x + share * (width - 2 * gap), foot + 2), fill=gauge.colour)

    def _draw_gauges(self, pen: ImageDraw.ImageDraw, gauges: Sequence[Gauge]) -> None:
        """Write the gauges into the lower left corner: names, and texts on their bars, in columns as wide as needed."""
        if not gauges:
            return
        line, gap = self._line + 5, 6
        left = 2 * gap + max(pen.textlength(gauge.name, self._font) for gauge in gauges)
        widest = max(pen.textlength(gauge.text, self._font) for gauge in gauges)
        right = left + max(widest + 2 * gap, _BAR * self._size[0])
        top = self._size[1] - gap - line * len(gauges)
        pen.rectangle((0, top - 4, right + gap, self._size[1]), fill=(*INK, 170))
        style = {"fill": WHITE, "font": self._font, "anchor": "lm"}
        for index, gauge in enumerate(gauges):
            y = top + index * line
            if gauge.share is not None:
                share = min(max(gauge.share, 0.0), 1.0)
                pen.rectangle((left, y + 1, right, y + line - 4), fill=(255, 255, 255, 60))
                pen.rectangle((left, y + 1, left + share * (right - left), y + line - 4), fill=(*gauge.colour, 255))
            middle = y + line / 2 - 1
            pen.text((gap, middle), gauge.name, **style)
            pen.text((left + gap, middle), gauge.text, stroke_width=1, stroke_fill=(*INK, 255), **style)

    def _draw_map(self, pen: ImageDraw.ImageDraw, small: Map) -> None:
        side = 0.26 * self._height
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
        scale = 0.5 * self._height / math.tan(math.radians(_FIELD) / 2) / float(depth)
        across, upwards = float(offset @ right), float(offset @ np.cross(back, right))
        return self._size[0] / 2 + scale * across, self._height / 2 - scale * upwards


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
                if shape == SECTOR:
                    _fan(scene, at, wxyz, size, colour)
                    continue
                mujoco.mju_quat2Mat(turn, wxyz)
                geom = scene.geoms[scene.ngeom]
                mujoco.mjv_initGeom(geom, _GEOMS[shape], size / 2, at, turn, colour.astype(np.float32))
                geom.size[:] = size / 2  # also of cylinders, which may be elliptic
                geom.specular, geom.category = 0.1, mujoco.mjtCatBit.mjCAT_DYNAMIC
                scene.ngeom += 1


def _fan(scene: mujoco.MjvScene, at: np.ndarray, wxyz: np.ndarray, size: np.ndarray, colour: np.ndarray) -> None:
    """Add a sector as triangles; those of MuJoCo lie between two axes, which need not be orthogonal."""
    corners, faces = unit_mesh(SECTOR)
    corners = rotated(wxyz, corners * size)
    for tip, one, other in corners[faces]:
        if scene.ngeom == scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        axes = np.stack([one - tip, other - tip, rotated(wxyz, np.array([[0.0, 0.0, 1.0]]))[0]], axis=1)
        mujoco.mjv_initGeom(geom, _GEOMS[SECTOR], np.ones(3), at + tip, axes.ravel(), colour.astype(np.float32))
        geom.specular, geom.category = 0.1, mujoco.mjtCatBit.mjCAT_DYNAMIC
        scene.ngeom += 1


_STILL = {"contype": 0, "conaffinity": 0}


def _rgba(colour: Colour) -> np.ndarray:
    return np.array([*np.divide(colour, 255.0), 1.0])


def _half(shape: str, size: np.ndarray) -> np.ndarray:
    """Return MuJoCo's size of a primitive: half lengths, and radius and half length of a cylinder."""
    return np.array([size[0] / 2, size[2] / 2, 0.0]) if shape == CYLINDER else np.asarray(size) / 2
