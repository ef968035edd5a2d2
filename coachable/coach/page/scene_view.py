"""3-D view of a domain's scene on the live page."""

from __future__ import annotations

import contextlib
import html
import math
from collections.abc import Hashable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from coachable.coach.page.looks import DAY, NIGHT
from coachable.coach.session.session import CoachSession
from coachable.scene.between import between, continues
from coachable.scene.frame import Frame, Map, Stage, Viewpoint
from coachable.scene.palette import AIR, HAZE, NIGHT_AIR, NIGHT_HAZE, css
from coachable.scene.parts import SHAPES, Batch, Parts, about_z, multiplied, rotated, unit_mesh
from coachable.scene.renderer import GLOW

if TYPE_CHECKING:
    import viser

PHONE = 576  # [px]; in narrower windows viser's panel covers the lower right
FOLLOW, TURN, STAY = "follow", "follow and turn", "stay"
_LIGHTS = {DAY: (1.5, 1.4), NIGHT: (0.45, 0.75)}  # brightness of the even and of the directed light
_SKIES = {DAY: (AIR, HAZE), NIGHT: (NIGHT_AIR, NIGHT_HAZE)}
_ROOT, _MOVING = "/scene", "/scene/moving"
_FARTHER = 2.2  # factor on the camera's distance in narrow windows
_LABELS = 12
_SPARE = 1.5  # room for more marks than there are, before viser gets a larger node
_HIDDEN = -1000.0  # [m], height of spare primitives
_START = (3.0, 3.0, 3.0)  # [m], viser's position of the camera until the browser receives ours


class View:
    """View of a session, used only in the thread that steps it; this one shows nothing.

    Attributes:
        overlay: HTML that is laid over the view.
    """

    overlay = ""

    def update(self, share: float = 1.0) -> None:
        """Show the present state.

        Args:
            share: Share of the control step that has passed; views that can show states between two steps use it.
        """

    def close(self) -> None:
        """Release the view's resources."""


class SceneView(View):
    """3-D view of a stage.

    The world moves instead of the camera, because each viewer controls their own camera.

    Attributes:
        frame: The frame of the last update.
        mode: Dropdown of what the camera does.
        brightness: Buttons that make the scene light or dark in the browser that presses them.
    """

    def __init__(self, server: viser.ViserServer, session: CoachSession, stage: Stage) -> None:
        self._server, self._session, self._stage = server, session, stage
        self.frame: Frame | None = None
        self._before: Frame | None = None
        self._seen: Hashable = None
        self._stale = False  # whether steps were not shown because there was no browser
        self._place: Hashable = None
        self._still: list[Any] = []
        # What moves is placed relative to the agent, whose pose is a frame of its own: browsers that draw slowly show
        # the pose of a frame sooner than the many places in it.
        self._nodes = {
            (group, shape): _Node(server, f"{parent}/{group}_{shape}", shape, glows=group == "glows")
            for group, parent in (("parts", _MOVING), ("marks", _ROOT), ("glows", _MOVING))
            for shape in SHAPES
        }
        server.scene.set_up_direction("+z")
        server.scene.configure_default_lights(enabled=False, cast_shadow=False)
        server.scene.configure_environment_map(None)
        _light(server.scene, stage.viewpoint, DAY)
        self._root = server.scene.add_frame(_ROOT, show_axes=False)
        self._moving = server.scene.add_frame(_MOVING, show_axes=False)
        self._ground = server.scene.add_frame(f"{_ROOT}/ground", show_axes=False)
        self._labels = [
            server.scene.add_label(f"{_ROOT}/label_{index}", "", visible=False, anchor="bottom-center")
            for index in range(_LABELS)
        ]
        modes = (TURN, FOLLOW, STAY) if stage.viewpoint.turns else (FOLLOW, TURN, STAY)
        self.mode = server.gui.add_dropdown("camera", modes, hint="drag to look around; the wheel zooms")
        self.brightness = server.gui.add_button_group("scene", (DAY, NIGHT), hint="in this browser")
        self.brightness.on_click(self._change_brightness)
        server.gui.add_html(_legend(stage))
        self._look(stage.viewpoint)

    def update(self, share: float = 1.0) -> None:
        """Show the present state, or one between the last two states; see `View.update`."""
        session = self._session
        if not self._server.get_clients():
            self._stale = True
            return
        if self._stale and session.domain.make_stage is not None:  # what it remembers is not of the last step
            self._stage, self._stale = session.domain.make_stage(), False
        present = (session.seed, session.step_count, session.episode, tuple(session.style.items()))
        if present != self._seen or self.frame is None:
            self._seen, self._before = present, self.frame
            self.frame = self._stage.frame(session.env, 0, session.style)
        frame = self.frame
        if share < 1.0 and self._before is not None and continues(self._before, frame):
            frame = between(self._before, frame, share)
        with self._server.atomic():
            if frame.place != self._place:
                self._build()
                self._place = frame.place
            self._show(frame)

    def _change_brightness(self, event: viser.GuiEvent) -> None:
        if event.client is not None and event.target.value in _LIGHTS:
            _light(event.client.scene, self._stage.viewpoint, event.target.value)

    def _show(self, frame: Frame) -> None:
        focus = np.array([*frame.focus[:2], 0.0])
        pose = focus, np.array(about_z(frame.heading))
        for (group, _), node in self._nodes.items():
            node.show(getattr(frame, group), None if group == "marks" else pose)
        self._moving.position, self._moving.wxyz = pose
        self._move(focus, frame.heading)
        for index, handle in enumerate(self._labels):
            label = frame.labels[index] if index < len(frame.labels) else None
            if label is not None:
                handle.text, handle.position = label.text, np.asarray(label.position, dtype=float)
            handle.visible = label is not None
        self.overlay = overlay_html(frame)

    def _move(self, focus: np.ndarray, heading: float) -> None:
        """Move the world so that the agent stays in the middle, as the chosen mode of the camera wants it."""
        mode = self.mode.value
        if mode == STAY:
            return
        turn = np.array(about_z(-heading if mode == TURN else 0.0))
        self._root.wxyz, self._root.position = turn, -rotated(turn, focus[None])[0]
        if self._travels:
            self._ground.position = np.round(focus)

    def _build(self) -> None:
        """Send what does not move."""
        for handle in self._still:
            handle.remove()
        backdrop = self._stage.backdrop(self._session.env, 0)
        self._travels = backdrop.travels
        scene, name = self._server.scene, f"{_ROOT}/ground"
        self._still = [
            scene.add_mesh_simple(
                f"{name}/{surface.name}", surface.vertices.astype(np.float32), surface.faces, color=surface.colour
            )
            for surface in backdrop.surfaces
        ]
        for shape in SHAPES:
            if len(backdrop.parts.of(shape)):
                node = _Node(self._server, f"{name}/{shape}", shape, spare=1.0)
                node.show(backdrop.parts)
                self._still.append(node.handle)

    def _look(self, view: Viewpoint) -> None:
        """Set the initial camera, and keep it fitted to each browser's window."""
        camera = self._server.initial_camera
        camera.position, camera.look_at = camera_of(view)
        camera.fov = math.radians(45.0)
        camera.far = 4 * view.far

        def on_connect(client: viser.ClientHandle) -> None:
            fit_camera(client.camera, view)
            client.camera.on_update(partial(fit_camera, view=view))

        self._server.on_client_connect(on_connect)


# viser takes the colours of batches and of fog as linear ones, unlike those of meshes.
_LINEAR = np.array(
    [round(255 * (v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4)) for v in np.arange(256) / 255], np.uint8
)


class _Node:
    """Primitives of one shape as one node of viser's scene, which is replaced when it has too little room."""

    def __init__(
        self, server: viser.ViserServer, name: str, shape: str, glows: bool = False, spare: float = _SPARE
    ) -> None:
        self._server, self._name, self._shape, self._spare = server, name, shape, spare
        self._options: dict[str, Any] = {"opacity": GLOW} if glows else {}
        self.handle: Any = None
        self._room = 0

    def show(self, parts: Parts, pose: tuple[np.ndarray, np.ndarray] | None = None) -> None:
        """Show the primitives of this node's shape.

        Args:
            parts: The primitives.
            pose: Position (3,) [m] and orientation (4,), a quaternion, of the frame in which the node lies; None for
                the world's.
        """
        batch = parts.of(self._shape)
        if pose is not None:
            origin, turn = pose
            back = turn * (1, -1, -1, -1)
            places = rotated(back, batch.positions - origin)
            batch = replace(batch, positions=places, wxyzs=multiplied(back, batch.wxyzs))
        if len(batch) > self._room:
            self._make(batch)
        elif self._room:
            full = self._filled(batch)
            self.handle.batched_positions, self.handle.batched_wxyzs = full.positions, full.wxyzs
            self.handle.batched_scales, self.handle.batched_colors = full.sizes, full.colours

    def _make(self, batch: Batch) -> None:
        self._room = math.ceil(self._spare * len(batch))
        full = self._filled(batch)
        vertices, faces = unit_mesh(self._shape)
        self.handle = self._server.scene.add_batched_meshes_simple(
            self._name,
            vertices.astype(np.float32),
            faces.astype(np.uint32),
            batched_wxyzs=full.wxyzs,
            batched_positions=full.positions,
            batched_scales=full.sizes,
            batched_colors=full.colours,
            lod="off",
            **self._options,
        )

    def _filled(self, batch: Batch) -> Batch:
        """Return the primitives and as many hidden ones as there is room for, as float32."""
        free = self._room - len(batch)
        return Batch(
            np.concatenate([batch.positions, np.full((free, 3), _HIDDEN)]).astype(np.float32),
            np.concatenate([batch.wxyzs, np.tile((1.0, 0.0, 0.0, 0.0), (free, 1))]).astype(np.float32),
            np.concatenate([batch.sizes, np.full((free, 3), 1e-3)]).astype(np.float32),
            np.concatenate([_LINEAR[batch.colours], np.zeros((free, 3), np.uint8)]),
        )


def fit_camera(camera: viser.CameraHandle, view: Viewpoint) -> None:
    """Move a browser's camera if its window has become narrow or wide, unless somebody has moved it by hand."""
    wide, narrow = camera_of(view), camera_of(view, narrow=True)
    phone = camera.image_width <= PHONE
    expected = (wide[0], _START) if phone else (narrow[0],)
    if any(np.allclose(camera.position, position, atol=1e-3) for position in expected):
        with contextlib.suppress(ValueError):  # the browser reported an invalid camera
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.position, camera.look_at = narrow if phone else wide


def camera_of(view: Viewpoint, narrow: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return position and target of the camera (3,) [m], with the agent at x = y = 0.

    Args:
        view: The stage's viewpoint.
        narrow: Whether the lower 60 % of the window are covered, so that the camera is farther away and points lower.
    """
    azimuth, elevation = math.radians(view.azimuth), math.radians(view.elevation)
    direction = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    focus = np.array([0.0, 0.0, view.height])
    if not narrow:
        return focus + view.distance * direction, focus
    position = focus + _FARTHER * view.distance * direction
    above = np.cross(direction, np.array([-math.sin(azimuth), math.cos(azimuth), 0.0]))
    return position, focus - 0.6 * _FARTHER * view.distance * math.tan(math.radians(45.0) / 2) * above


def overlay_html(frame: Frame) -> str:
    """Return gauges and map of a frame as HTML, which `coachable.coach.page.looks` lays over the scene."""
    rows = []
    for gauge in frame.gauges:
        name, text = html.escape(gauge.name), html.escape(gauge.text)
        bar = ""
        if gauge.share is not None:
            width = 100.0 * min(max(gauge.share, 0.0), 1.0)
            bar = f'<i style="width:{width:.0f}%;background:{css(gauge.colour)}"></i>'
        rows.append(f'<div class="gauge"><b>{name}</b><span>{bar}<em>{text}</em></span></div>')
    picture = "" if frame.map is None else _map_html(frame.map)
    return f'{picture}<div class="gauges" role="group" aria-label="gauges">{"".join(rows)}</div>'


def _map_html(small: Map) -> str:
    outline, places = small.scaled(100.0, 100.0)
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in outline)
    colours = [css(small.colours[index % len(small.colours)]) for index in range(len(places))]
    dots = [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{c}"/>' for (x, y), c in zip(places, colours, strict=True)
    ]
    return (
        '<svg class="map" viewBox="0 0 100 100" role="img" aria-label="map">'
        f'<polygon points="{line}" fill="none" stroke="#f0f0ec" stroke-width="1.6"/>{"".join(reversed(dots))}</svg>'
    )


def _light(scene: viser.SceneApi, view: Viewpoint, brightness: str) -> None:
    """Set the lights of the scene of all browsers, or of one, and a sky into which distant objects fade.

    There is an even and a directed light; shadows are several times slower without a graphics card.
    """
    even, directed = _LIGHTS[brightness]
    air, haze = _SKIES[brightness]
    scene.add_light_hemisphere("/sky", sky_color=(255, 255, 255), ground_color=(150, 150, 155), intensity=even)
    scene.add_light_directional("/sun", intensity=directed, position=(-4.0, -3.0, 9.0))
    red, green, blue = _LINEAR[list(haze)].tolist()
    scene.configure_fog(*view.haze, color=(red, green, blue))
    share = np.clip(np.linspace(0.0, 2.0, 64), 0.0, 1.0)[:, None, None]
    sky = np.array(air) + share * np.subtract(haze, air)
    scene.set_background_image(np.repeat(sky, 8, axis=1).round().astype(np.uint8), format="png")


def _legend(stage: Stage) -> str:
    rows = "".join(
        f'<div><i style="background:{css(colour)}"></i>{html.escape(meaning)}</div>' for colour, meaning in stage.legend
    )
    return f'<details class="legend"><summary>colours</summary>{rows}</details>'
