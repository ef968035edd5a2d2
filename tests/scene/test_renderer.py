"""Pictures of scenes: primitives, labels and gauges are where they belong."""

import numpy as np
import pytest

from coachable.gl import NO_BACKEND, choose_gl_backend

pytestmark = pytest.mark.skipif(choose_gl_backend() == NO_BACKEND, reason="no OpenGL library is installed")

from coachable.scene.frame import Backdrop, Frame, Gauge, Label, Map, Viewpoint  # noqa: E402
from coachable.scene.parts import Parts, Surface  # noqa: E402
from coachable.scene.renderer import SceneRenderer  # noqa: E402

GREEN, RED, BLUE = (0, 200, 0), (220, 0, 0), (0, 0, 220)
SQUARE = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [9.0, 9.0, 0.0], [-9.0, 9.0, 0.0]])


class Still:
    """A red ball on green ground, seen from -y."""

    viewpoint = Viewpoint(distance=10.0, elevation=30.0, azimuth=-90.0, height=0.0)
    legend = ()

    def __init__(self, **further):
        self.further = further
        self.backdrops, self.place = 0, 0.0

    def backdrop(self, env, row=0):
        self.backdrops += 1
        return Backdrop((Surface("ground", SQUARE, np.array([[0, 1, 2], [0, 2, 3]]), GREEN),))

    def frame(self, env, row=0, asked=None):
        parts = Parts().ball((self.place, 0.0, 0.0), (2.0, 2.0, 2.0), RED)
        return Frame(parts, (0.0, 0.0, 0.0), 0.0, place="here", **self.further)


def picture(stage, width=200, height=160):
    renderer = SceneRenderer(lambda: stage, width, height)
    image = renderer.draw(None).astype(int)
    again = renderer.draw(None)
    renderer.close()
    assert image.shape == (height, width, 3) and np.array_equal(image, again)
    return image


def hue(image):
    """The index of the strongest channel of each pixel."""
    return image.argmax(-1)


def test_primitives_and_surfaces_have_their_places_and_colours():
    stage = Still()
    image = picture(stage)
    assert hue(image)[80, 100] == 0 and hue(image)[140, 100] == 1
    assert stage.backdrops == 1, "what does not move is built once"


def test_a_label_stands_above_its_place():
    image = picture(Still(labels=[Label("MMM", (0.0, 0.0, 2.0))]))
    dark = (image.max(-1) < 90) & (np.arange(200) > 60)
    rows, columns = np.nonzero(dark)
    assert abs(columns.mean() - 100) < 8 and 20 < rows.mean() < 45


def test_a_label_behind_the_camera_is_left_out():
    assert np.array_equal(picture(Still(labels=[Label("MMM", (0.0, -30.0, 0.0))])), picture(Still()))


def test_states_between_two_steps_are_drawn():
    stage = Still()
    renderer = SceneRenderer(lambda: stage, 200, 160)
    (before,) = renderer.draw_way(None)
    stage.place = 2.0
    assert renderer.draw_way(None, shares=()) == []
    stage.place = 0.0
    middle, after = renderer.draw_way(None, shares=(0.5, 1.0))
    renderer.close()
    columns = [np.nonzero(hue(picture.astype(int)) == 0)[1].mean() for picture in (before, middle, after)]
    assert columns[0] == columns[2] and columns[1] > columns[0] + 10
    assert stage.backdrops == 1


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_bar_of_a_gauge_is_as_long_as_its_share(share):
    image = picture(Still(gauges=[Gauge("", "", share, BLUE)]), 500, 400)
    row = image[390]
    blue = np.flatnonzero((row[:, 2] > 150) & (row[:, 0] < 60) & (row[:, 1] < 60))
    assert len(blue) == pytest.approx(share * 0.26 * 500, abs=2)


def test_gauges_stand_below_a_narrow_scene():
    gauges = [Gauge("one", "1", 1.0, BLUE), Gauge("two", "a text that is too long for its column", 0.5, RED)]
    image = picture(Still(gauges=[*gauges, Gauge("three", "3")]))
    strip = 2 * 18 + 4
    assert np.array_equal(image[: 160 - strip], picture(Still(), 200, 160 - strip))
    bars = hue(image[160 - strip + 18])
    assert (bars[8:94] == 2).all() and (bars[108:150] == 0).all()


def test_the_map_is_in_the_corner():
    small = Map(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), [(0.5, 0.5)], [BLUE])
    image, without = picture(Still(map=small)), picture(Still())
    changed = (image != without).any(-1)
    assert changed[:41, 158:].any() and not changed[42:].any() and not changed[:, :156].any()
    assert hue(image)[21, 179] == 2


def test_translucent_primitives_let_the_ground_shine_through():
    glows = Parts().box((0.0, -3.0, 0.1), (2.0, 2.0, 0.1), RED)
    image = picture(Still(glows=glows))
    red, green, _ = image[116, 100]
    assert red > 40 and green > 40
