"""The page's views: pictures, the scene and its camera."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

viser = pytest.importorskip("viser")


from coachable.coach.page import scene_view, views  # noqa: E402
from coachable.coach.session.session import CoachSession  # noqa: E402
from coachable.domains.combat.stage import CombatStage  # noqa: E402
from coachable.domains.humanoid.stage import HumanoidStage  # noqa: E402
from coachable.domains.racing.stage import RacingStage  # noqa: E402
from coachable.scene import palette  # noqa: E402
from coachable.scene.parts import Parts, rotated  # noqa: E402
from tests.coach.echo_domain import echo_session  # noqa: E402


def test_a_view_that_cannot_be_made_is_explained(server, monkeypatch):
    def no_library(session):
        raise RuntimeError("no OpenGL library was found")

    session = echo_session()
    monkeypatch.setattr(views, "PictureView", lambda server, session: no_library(session))
    view = views.make_view(server, session)
    view.update()
    view.close()
    assert type(view) is views.View and view.overlay == ""
    session.close()


def test_a_view_of_which_the_first_picture_fails_is_closed_and_not_made_again(server):
    made, closed = [], []

    class Broken:
        def __init__(self, width, height):
            made.append(self)

        def draw(self, env):
            raise ValueError("this domain draws nothing")

        def close(self):
            closed.append(self)

    session = echo_session()
    session.domain = replace(session.domain, make_renderer=Broken)
    assert type(views.make_view(server, session)) is views.View
    assert made == closed and len(made) == 1
    session.close()


def test_a_picture_is_drawn_only_while_somebody_looks(server, monkeypatch):
    session = echo_session()
    view = views.make_view(server, session)
    drawn = []
    scene = SimpleNamespace(set_background_image=lambda picture, **_: drawn.append(picture.shape))
    client = SimpleNamespace(scene=scene, camera=SimpleNamespace(aspect=2.0, image_width=1200))
    view.update()
    assert drawn == []
    monkeypatch.setattr(server, "get_clients", lambda: {0: client})
    view.update()
    view.update()
    assert drawn == [(600, 1200, 3)], "as wide as the window, and not faster than it can be watched"
    view.close()
    session.close()


def test_pictures_keep_their_proportions():
    picture = np.zeros((60, 80, 3), dtype=np.uint8)
    assert views.padded(picture, 4 / 3).shape == (60, 80, 3)
    wide, tall = views.padded(picture, 2.0), views.padded(picture, 1.0)
    assert wide.shape == (60, 120, 3) and (wide[:, 20:100] == 0).all() and (wide[:, :20] > 0).all()
    assert tall.shape == (80, 80, 3) and (tall[10:70] == 0).all() and (tall[70:] > 0).all()


@pytest.mark.parametrize("aspect", [0.0, -1.0, 1e-9, 1e9, math.inf, math.nan])
def test_no_window_makes_a_picture_huge(aspect):
    picture = np.zeros((60, 80, 3), dtype=np.uint8)
    assert views.padded(picture, aspect).size <= 4 * 4 * picture.size


def test_in_a_narrow_window_the_picture_lies_above_the_panel(server, monkeypatch):
    """viser's panel covers the lower 60 % of such a window."""
    session, shown = echo_session(), []
    view = views.make_view(server, session)
    scene = SimpleNamespace(set_background_image=lambda picture, **_: shown.append(picture))
    client = SimpleNamespace(scene=scene, camera=SimpleNamespace(aspect=0.5, image_width=400))
    monkeypatch.setattr(server, "get_clients", lambda: {0: client})
    view.update()
    drawn = (shown[0] != views._BORDER).any(-1).any(-1)
    assert shown[0].shape[:2] == (1600, 800) and drawn[:600].all() and not drawn[600:].any()
    view.close()
    session.close()


def test_the_camera_follows_turns_or_stays(server, monkeypatch):
    server.gui.reset()
    server.scene.reset()
    session = CoachSession.open("humanoid", seed=1)
    view = views.make_view(server, session)
    assert isinstance(view, scene_view.SceneView)
    view.update()
    assert view.frame is None, "nobody looks"
    monkeypatch.setattr(server, "get_clients", lambda: {0: None})
    session.run(0.5)
    view.update()
    position = session.base_env.simulation.positions[0, :2].copy()
    assert view._root.position[:2] == pytest.approx(-position)
    assert view._ground.position[:2] == pytest.approx(np.round(position)), "the pattern of the ground stays in place"
    assert "last steps" in view.overlay and '<div class="gauge">' in view.overlay

    view.mode.value = scene_view.TURN
    session.steer(course=90.0)
    session.run(2.1)  # until it has turned
    view.update()
    x, y = session.base_env.simulation.positions[0, :2]
    assert view._root.position[:2] == pytest.approx([-y, x], abs=1e-5), "what lies ahead is ahead in the picture"

    before = view._root.position.copy()
    view.mode.value = scene_view.STAY
    session.run(0.5)
    view.update()
    assert view._root.position == pytest.approx(before)
    session.close()


def test_a_browser_chooses_a_dark_scene_for_itself(server):
    server.gui.reset()
    server.scene.reset()
    session = CoachSession.open("humanoid", seed=1)
    view = scene_view.SceneView(server, session, HumanoidStage())
    chosen = {}

    def keep(name):
        return lambda *values, **named: chosen.setdefault(name, (*values, *named.values()))

    names = ("add_light_hemisphere", "add_light_directional", "configure_fog", "set_background_image")
    client = SimpleNamespace(scene=SimpleNamespace(**{name: keep(name) for name in names}))
    press = view.brightness._impl.update_cb[0]
    press(SimpleNamespace(client=None, target=SimpleNamespace(value="dark")))
    press(SimpleNamespace(client=client, target=SimpleNamespace(value="no such button")))
    assert not chosen
    press(SimpleNamespace(client=client, target=SimpleNamespace(value="dark")))
    assert set(chosen) == set(names)
    sky = chosen["set_background_image"][0]
    assert sky[0, 0].tolist() == list(palette.NIGHT_AIR) and sky[-1, 0].tolist() == list(palette.NIGHT_HAZE)
    session.close()


def test_slow_control_steps_are_drawn_in_between(server, monkeypatch):
    """A fight has five states per second."""
    server.gui.reset()
    server.scene.reset()
    monkeypatch.setattr(server, "get_clients", lambda: {0: None})
    session = CoachSession.open("combat", seed=1)
    view = views.make_view(server, session)
    view.mode.value = scene_view.FOLLOW
    focus = []
    for _ in range(2):
        session.step()
        view.update()
        focus.append(np.asarray(view.frame.focus)[:2])
    view.update(0.25)
    between = focus[0] + 0.25 * (focus[1] - focus[0])
    assert -view._root.position[:2] == pytest.approx(between, abs=1e-5)
    assert view._moving.position[:2] == pytest.approx(between, abs=1e-5)
    view.update()
    pose, boxes = view._moving, view.frame.parts.of("box")
    shown = view._nodes["parts", "box"].handle
    placed = rotated(pose.wxyz, shown.batched_positions) + pose.position
    assert placed[: len(boxes)] == pytest.approx(boxes.positions, abs=1e-4), "relative to what the camera follows"
    axes = [rotated(wxyzs, np.array([1.0, 0.0, 0.0])) for wxyzs in shown.batched_wxyzs[: len(boxes)]]
    expected = [rotated(wxyzs, np.array([1.0, 0.0, 0.0])) for wxyzs in boxes.wxyzs]
    assert rotated(pose.wxyz, np.array(axes)) == pytest.approx(np.array(expected), abs=1e-4)
    session.close()


def test_a_node_has_room_for_more_primitives(server):
    server.scene.reset()
    node = scene_view._Node(server, "/balls", "ball")
    node.show(Parts())
    assert node.handle is None
    for count in (4, 6, 7, 2):
        parts = Parts()
        for index in range(count):
            parts.ball((index, 0.0, 0.0), (1.0, 1.0, 1.0), (255, 188, 0))
        node.show(parts)
        shown = node.handle.batched_positions[:, 2] > -1.0
        assert shown.sum() == count and len(shown) == (6 if count in (4, 6) else 11)
        assert node.handle.batched_positions[shown, 0].tolist() == list(range(count))
    assert node.handle.batched_colors[0].tolist() == [255, 128, 0], "linear, as viser wants them"


@pytest.mark.parametrize("make", [HumanoidStage, RacingStage, CombatStage])
def test_in_a_narrow_window_the_camera_shows_the_agent_above_the_panel(make):
    viewpoint = make.viewpoint
    position, target = scene_view.camera_of(viewpoint, narrow=True)
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    up = np.cross(right / np.linalg.norm(right), ahead)
    for height in (0.0, 2.0):  # from the soles to the hands
        seen = np.array([0.0, 0.0, height]) - position
        share = (seen @ up) / (seen @ ahead) / np.tan(np.deg2rad(45.0) / 2)  # -1 below, 1 above
        assert 0.2 < share < 1.0, "above the panel's 60 %"
    position, target = scene_view.camera_of(viewpoint)
    assert np.linalg.norm(target - position) == pytest.approx(viewpoint.distance) and target[2] == viewpoint.height


def test_a_window_that_becomes_wide_again_gets_the_wide_camera_unless_somebody_moved_it():
    view = RacingStage.viewpoint
    wide, narrow = scene_view.camera_of(view), scene_view.camera_of(view, narrow=True)
    camera = SimpleNamespace(position=wide[0], look_at=wide[1], up_direction=None, image_width=360)
    scene_view.fit_camera(camera, view)
    assert np.array_equal(camera.position, narrow[0]) and np.array_equal(camera.look_at, narrow[1])
    camera.image_width = 1280
    scene_view.fit_camera(camera, view)
    assert np.array_equal(camera.position, wide[0]) and np.array_equal(camera.look_at, wide[1])
    camera.position, camera.image_width = wide[0] + 1.0, 360
    scene_view.fit_camera(camera, view)
    assert np.array_equal(camera.position, wide[0] + 1.0)
