"""Recorded scenes: what is decoded is what was seen."""

import gzip
import json

import numpy as np
import pytest

from coachable.scene.frame import Backdrop, Frame, Gauge, Label, Map
from coachable.scene.parts import BOX, Batch, Parts, Surface, about_z, multiplied, rotated
from coachable.scene.recorded import encode_backdrop, encode_figures, encode_frames

GREY, RED = (90, 90, 90), (200, 30, 30)


def decoded(content):
    """Header and arrays of a file."""
    plain = gzip.decompress(content)
    begin = 4 + int.from_bytes(plain[:4], "little")
    header = json.loads(plain[4:begin])
    arrays = {
        row["name"]: np.frombuffer(plain, row["type"], int(np.prod(row["shape"])), begin + row["offset"]).reshape(
            row["shape"]
        )
        for row in header["arrays"]
    }
    return header, arrays


def car_frame(step, **further):
    """A body with two wheels that drives in a circle, and a post that stands still."""
    turn, wheel = np.array(about_z(0.3 * step)), Parts().cylinder((0, 0, 0), (0.6, 0.6, 0.2), GREY)
    body = Parts().box((0.0, 0.0, 0.5), (2.0, 1.0, 0.5), RED).box((0.5, 0.0, 1.0), (0.5, 1.0, 0.5), GREY)
    place = np.array([10 * np.cos(0.3 * step), 10 * np.sin(0.3 * step), 0.0])
    parts = Parts().box((3.0, 3.0, 1.0), (0.1, 0.1, 2.0), GREY).figure(body, place, turn)
    for x in (-1.0, 1.0):
        spun = multiplied(turn, np.array([[np.cos(step), 0.0, np.sin(step), 0.0]]))[0]
        parts.figure(wheel, place + rotated(turn, np.array([[x, 0.0, 0.3]]))[0], spun)
    return Frame(parts, focus=place, heading=0.3 * step, **further)


def placed(arrays, segment, at):
    """Places of all primitives in a frame of a segment."""
    part = {name: arrays[f"{segment}/{name}"] for name in ("figure", "own_positions", "positions", "turns")}
    places = part["own_positions"].astype(float).copy()
    for index, figure in enumerate(part["figure"]):
        if figure:
            turn = part["turns"][at, figure - 1] / 32767
            places[index] = part["positions"][at, figure - 1] + rotated(turn, places[index][None])[0]
    return places


def test_primitives_that_move_together_are_one_figure():
    frames = [car_frame(step) for step in range(12)]
    header, arrays = decoded(encode_frames(frames, {"": 0}))
    counts = {"box": 3, "ball": 0, "cylinder": 2, "sector": 0}
    assert header["segments"] == [{"first": 0, "frames": 12, "counts": counts, "place": 0}]
    assert arrays["0/figure"].tolist() == [0, 1, 1, 2, 3]  # the post, the body, and a wheel each
    for step, frame in enumerate(frames):
        seen = np.concatenate([frame.parts.of(shape).positions for shape in ("box", "cylinder")])
        np.testing.assert_allclose(placed(arrays, 0, step), seen, atol=2e-3)
    np.testing.assert_allclose(arrays["focus"], [frame.focus for frame in frames], atol=1e-5)


def test_changes_of_size_and_colour_are_kept():
    def bar(step):
        shade = RED if step > 2 else GREY
        return Frame(Parts().box((0, 0, 0), (1.0 + (step > 1), 1, 1), shade), focus=(0, 0, 0), heading=0.0)

    _, arrays = decoded(encode_frames([bar(step) for step in range(5)], {"": 0}))
    assert arrays["0/sizes"].tolist() == [[1, 1, 1]] and arrays["0/colours"].tolist() == [list(GREY)]
    assert arrays["0/changed_at"].tolist() == [2, 3] and arrays["0/changed_part"].tolist() == [0, 0]
    assert arrays["0/changed_size"].tolist() == [[2, 1, 1]] * 2
    assert arrays["0/changed_colour"].tolist() == [list(GREY), list(RED)]


def test_another_number_of_primitives_begins_a_segment():
    frames = [Frame(Parts(), (0, 0, 0), 0.0), car_frame(0), car_frame(1), car_frame(2, episode=1)]
    header, _ = decoded(encode_frames(frames, {"": 0}))
    assert [(segment["first"], segment["frames"]) for segment in header["segments"]] == [(0, 1), (1, 2), (3, 1)]


def test_marks_last_from_their_first_to_their_last_frame():
    marks = [Parts().box((i, 0, 0), (1, 1, 1), GREY) for i in range(3)]
    shown = [[0], [0, 1], [1], [1, 2], [0]]  # the first one comes again
    frames = [Frame(Parts(), (0, 0, 0), 0.0, marks=sum_of([marks[i] for i in which])) for which in shown]
    _, arrays = decoded(encode_frames(frames, {"": 0}))
    rows = zip(arrays["marks/first"], arrays["marks/last"], arrays["marks/positions"][:, 0], strict=True)
    assert [tuple(map(int, row)) for row in rows] == [(0, 1, 0), (1, 3, 1), (3, 3, 2), (4, 4, 0)]


def sum_of(collections):
    joined = Parts()
    for parts in collections:
        joined.batch(BOX, parts.of(BOX))
    return joined


def test_texts_map_and_backdrop():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    frame = Frame(
        Parts(),
        (0, 0, 0),
        0.0,
        labels=[Label("Scrounger", (1.0, 2.0, 3.0))],
        gauges=[Gauge("speed", "3 m/s", 0.25, RED), Gauge("site", "Arena")],
        map=Map(square, [(0.5, 0.5)], (RED,)),
    )
    header, arrays = decoded(encode_frames([frame], {"": 0}))
    assert header["labels"] == [[["Scrounger", 1.0, 2.0, 3.0]]]
    assert [row[:3] for row in header["gauges"][0]] == [["speed", "3 m/s", 0.25], ["site", "Arena", None]]
    assert header["map"]["colours"] == ["#c81e1e"] and arrays["map"].tolist() == [[[50.0, 50.0]]]
    surface = Surface("ground", np.eye(3), np.array([[0, 1, 2]]), GREY)
    header, arrays = decoded(encode_backdrop(Backdrop([surface], Parts().ball((0, 0, 1), (1, 1, 2), RED))))
    assert header["surfaces"] == [{"name": "ground", "colour": "#5a5a5a"}] and header["counts"]["ball"] == 1
    assert arrays["0/vertices"].tolist() == np.eye(3).tolist() and arrays["0/faces"].tolist() == [[0, 1, 2]]
    assert arrays["sizes"].tolist() == [[1, 1, 2]]


def test_the_same_frames_give_the_same_bytes():
    frames = [car_frame(step) for step in range(3)]
    assert encode_frames(frames, {"": 0}) == encode_frames(frames, {"": 0})


def test_a_place_without_a_backdrop_is_an_error():
    with pytest.raises(KeyError):
        encode_frames([car_frame(0, place="elsewhere")], {"": 0})


def test_turned_quaternions_may_change_their_sign():
    turns = [about_z(angle) for angle in np.linspace(0, 7, 9)]
    signs = [1, -1, 1, 1, -1, -1, 1, -1, 1]
    frames = []
    for turn, sign in zip(turns, signs, strict=True):
        wxyzs = np.array([turn, sign * np.array(turn)])
        batch = Batch(np.zeros((2, 3)), wxyzs, np.ones((2, 3)), np.zeros((2, 3), np.uint8))
        frames.append(Frame(Parts().batch(BOX, batch), (0, 0, 0), 0.0))
    _, arrays = decoded(encode_frames(frames, {"": 0}))
    assert arrays["0/figure"].tolist() == [1, 1]


def test_figures_are_written_in_the_order_of_the_shapes():
    wheel = Parts().cylinder((0, 0, 0), (0.6, 0.6, 0.2), GREY)
    body = Parts().box((0.0, 0.0, 0.5), (2.0, 1.0, 0.5), RED, about_z(0.3)).ball((1.0, 0.0, 1.0), (0.5, 0.5, 0.5), GREY)
    header, arrays = decoded(encode_figures([wheel, body, wheel]))
    assert header["figures"] == 3
    assert header["counts"] == {"box": 1, "ball": 1, "cylinder": 2, "sector": 0}
    assert arrays["figure"].tolist() == [2, 2, 1, 3]
    assert arrays["own_positions"].tolist() == [[0.0, 0.0, 0.5], [1.0, 0.0, 1.0], [0.0] * 3, [0.0] * 3]
    assert arrays["own_turns"][0] == pytest.approx(about_z(0.3))
    assert arrays["sizes"][2] == pytest.approx([0.6, 0.6, 0.2]) and arrays["colours"].tolist()[0] == list(RED)
