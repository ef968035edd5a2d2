"""Primitives: their meshes are closed, and figures move as rigid bodies."""

import numpy as np
import pytest

from coachable.envs.combat.constants import CONE_COSINE
from coachable.scene import palette
from coachable.scene.between import between, continues
from coachable.scene.frame import Frame, Map
from coachable.scene.parts import (
    SECTOR_ANGLE,
    SHAPES,
    Batch,
    Parts,
    about_x,
    about_y,
    about_z,
    multiplied,
    plain,
    rotated,
    towards,
    unit_mesh,
)

RED = (200, 0, 0)


@pytest.mark.parametrize("shape, volume", [("box", 1.0), ("ball", np.pi / 6), ("cylinder", np.pi / 4)])
def test_unit_meshes_are_closed_and_face_outwards(shape, volume):
    """The volume from the divergence theorem is negative if the triangles face inwards."""
    vertices, faces = unit_mesh(shape)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(volume, rel=0.05)
    assert np.cross(b - a, c - a).sum(0) == pytest.approx(0.0, abs=1e-9), "the surface has a hole"
    assert np.abs(vertices).max() == pytest.approx(0.5)


def test_a_sector_is_a_third_of_a_disc_and_faces_up():
    vertices, faces = unit_mesh("sector")
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0).all() and np.abs(normals[:, :2]).max() < 1e-12
    assert normals[:, 2].sum() / 2 == pytest.approx(np.pi / 12, rel=0.02)
    assert np.abs(np.arctan2(vertices[1:, 1], vertices[1:, 0])).max() == pytest.approx(SECTOR_ANGLE)
    assert np.cos(SECTOR_ANGLE) == pytest.approx(CONE_COSINE), "as far as a bite reaches to either side"


def test_rotations():
    quarter = np.pi / 2
    x, y, z = np.eye(3)[:, None]
    assert rotated(np.array(about_z(quarter)), x) == pytest.approx(y)
    assert rotated(np.array(about_x(quarter)), y) == pytest.approx(z)
    assert rotated(np.array(about_y(quarter)), z) == pytest.approx(x)
    both = multiplied(np.array(about_z(quarter)), np.array([about_x(quarter)]))[0]
    assert rotated(both, y) == pytest.approx(z)  # x first, then z
    for direction in ([0.0, 0.0, 2.0], [0.0, 0.0, -1.0], [1.0, -2.0, 0.5]):
        turned = rotated(towards(np.array(direction)), z)[0]
        assert turned == pytest.approx(np.array(direction) / np.linalg.norm(direction))


def test_a_figure_is_placed_as_a_whole():
    figure = Parts().box((1.0, 0.0, 0.0), (2.0, 1.0, 1.0), RED).ball((0.0, 0.0, 3.0), (1.0, 1.0, 1.0), RED)
    placed = Parts().figure(figure, (10.0, 0.0, 0.0), about_z(np.pi / 2))
    assert placed.of("box").positions == pytest.approx(np.array([[10.0, 1.0, 0.0]]))
    assert placed.of("ball").positions == pytest.approx(np.array([[10.0, 0.0, 3.0]]))
    assert rotated(placed.of("box").wxyzs[0], np.array([[1.0, 0.0, 0.0]])) == pytest.approx(np.array([[0.0, 1.0, 0.0]]))
    assert placed.of("box").colours.tolist() == [list(RED)] and len(placed) == 2


def test_a_rod_joins_two_points():
    start, end = np.array([1.0, 2.0, 3.0]), np.array([4.0, 6.0, 3.0])
    rod = Parts().rod(start, end, 0.5, RED).of("cylinder")
    half = rotated(rod.wxyzs[0], np.array([[0.0, 0.0, rod.sizes[0, 2] / 2]]))[0]
    assert rod.positions[0] - half == pytest.approx(start) and rod.positions[0] + half == pytest.approx(end)
    assert rod.sizes[0].tolist() == [1.0, 1.0, 5.0]
    assert len(Parts().capsule(start, end, 0.5, RED)) == 3


def frame(x, yaw, **further):
    return Frame(Parts().box((x, 0.0, 0.0), (1.0, 1.0, 1.0), RED, about_z(yaw)), (x, 0.0, 0.0), yaw, **further)


def test_frames_in_between_move_and_turn():
    halfway = between(frame(0.0, 3.0), frame(2.0, -3.0), 0.5)  # across the half turn, the short way
    assert halfway.focus[0] == pytest.approx(1.0)
    assert np.cos(halfway.heading) == pytest.approx(-1.0)
    box = halfway.parts.of("box")
    assert box.positions[0, 0] == pytest.approx(1.0)
    assert rotated(box.wxyzs[0], np.array([[1.0, 0.0, 0.0]]))[0] == pytest.approx([-1.0, 0.0, 0.0], abs=1e-6)


def test_only_the_same_things_continue():
    assert continues(frame(0.0, 0.0), frame(2.0, 0.0))
    assert not continues(frame(0.0, 0.0), frame(2.0, 0.0, episode=1))
    assert not continues(frame(0.0, 0.0), frame(500.0, 0.0)), "it was put somewhere else"
    more = Frame(Parts(), (0.0, 0.0, 0.0), 0.0)
    assert not continues(frame(0.0, 0.0), more)


def test_a_map_keeps_its_proportions():
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    outline, places = Map(square, [(5.0, 5.0), (0.0, 10.0)], [RED]).scaled(200.0, 100.0)
    assert np.ptp(outline, axis=0) == pytest.approx([84.0, 84.0])
    assert places[0] == pytest.approx([100.0, 50.0]) and places[1] == pytest.approx([58.0, 8.0])


def test_every_shape_has_all_its_primitives():
    parts = Parts()
    for shape in SHAPES:
        assert len(parts.of(shape)) == 0
        empty = parts.of(shape)
        parts.batch(shape, Batch(empty.positions, empty.wxyzs, empty.sizes, empty.colours))
    assert len(parts) == 0


def test_a_plain_is_made_of_small_triangles_that_face_up():
    surface = plain("ground", (-1.0, 0.0), (3.0, 5.0), 0.5, 2.0, (1, 2, 3))
    corners = surface.vertices[surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (across[:, 2] > 0).all() and across[:, 2].sum() / 2 == pytest.approx(4.0 * 5.0)
    assert (corners[..., 2] == 0.5).all() and len(corners) == 2 * 2 * 3


# Machado, Oliveira and Fernandes 2009, severity 1, for linear RGB.
BLINDNESS = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def linear(colour):
    value = np.asarray(colour) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    """CIELAB of linear RGB, for distances as they are seen."""
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    x, y, z = np.cbrt(np.clip(np.array(to_xyz) @ rgb, 0.0, None) / [0.9505, 1.0, 1.089])
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def luminance(colour):
    return float(linear(colour) @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("kind", [None, *BLINDNESS])
def test_hues_are_distinct_for_the_colour_blind(kind):
    hues = ("ORANGE", "SKY", "GREEN", "YELLOW", "BLUE", "VERMILION", "PURPLE", "INK", "WHITE")
    seen = np.eye(3) if kind is None else np.array(BLINDNESS[kind])
    labs = {name: lab(seen @ linear(getattr(palette, name))) for name in hues}
    for one in hues:
        for other in hues:
            assert one == other or np.linalg.norm(labs[one] - labs[other]) > 12, f"{one} and {other}"


@pytest.mark.parametrize("colour", [palette.REQUESTED, palette.MEASURED])
@pytest.mark.parametrize("page", [(255, 255, 255), (36, 36, 36)], ids=["light", "dark"])
def test_lines_of_charts_have_the_contrast_that_graphics_need(colour, page):
    """At least 3 to 1, as WCAG 2.1 asks for graphical objects."""
    high, low = sorted((luminance(colour) + 0.05, luminance(page) + 0.05), reverse=True)
    assert high / low >= 3.0


def test_css_and_mixtures():
    assert palette.css((0, 114, 178)) == "#0072b2"
    assert palette.mixed((0, 0, 0), (100, 200, 50), 0.5) == (50, 100, 25)
