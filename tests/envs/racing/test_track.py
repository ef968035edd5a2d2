"""Circuits, files, the generator, and where points are on a track."""

import math

import numpy as np
import pytest
import torch

from coachable.envs.racing.circuit.circuits import CIRCUITS, load_track, oval, ring
from coachable.envs.racing.circuit.generator import generate_track
from coachable.envs.racing.circuit.line import minimum_curvature_line
from coachable.envs.racing.circuit.profile import Envelope, cornering_speed, speed_profiles
from coachable.envs.racing.circuit.track import Course, Track, clearance
from coachable.envs.racing.physics.cars import load_car
from coachable.envs.racing.race.driver import line_geometry


@pytest.mark.parametrize(("name", "length"), [("lakeside", 5733.0), ("ridge", 4090.0), ("endurance", 13600.0)])
def test_circuits_have_their_length_and_keep_clear_of_themselves(name, length):
    track = load_track(name)
    assert track.length == pytest.approx(length, rel=0.01)
    assert clearance(track, apart=150.0) > 70.0
    headings = torch.atan2(track.table[:, 3], track.table[:, 2])
    turned = torch.remainder(headings.roll(-1) - headings + math.pi, 2 * math.pi) - math.pi
    assert abs(abs(float(turned.sum())) - 2 * math.pi) < 1e-6
    # Curvature is the derivative of the heading.
    mean = (track.table[:, 4] + track.table[:, 4].roll(-1)) / 2 * track.spacing
    assert (turned - mean).abs().max() < 1e-2  # not exact where a ramp ends between two nodes


def test_ring_and_oval_have_closed_forms():
    assert ring(200.0).length == pytest.approx(2 * math.pi * 200.0)
    # Each half circle with ramps of 45 m is one ramp longer than the arc.
    assert oval(600.0, 120.0).length == pytest.approx(2 * (600.0 + math.pi * 120.0 + 45.0), rel=1e-6)


@pytest.mark.parametrize("name", CIRCUITS)
def test_projection_finds_the_nearest_point(name):
    """Carried from up to 10 m away, against the nearest of points 1 cm apart, to 1 mm."""
    track = load_track(name)
    course = Course(track, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    s, offset, error = torch.rand(3, 200, generator=generator, dtype=torch.float64)
    s, offset = s * track.length, (2 * offset - 1) * 14.0
    x, y, direction = course.place(s, offset)
    found, arc, _ = course.project(x, y, torch.remainder(s + 20 * error - 10, track.length))
    fine = s[:, None] + torch.arange(-2, 2, 0.01, dtype=torch.float64)
    line_x, line_y, _ = course.place(fine.reshape(-1), torch.zeros(fine.numel(), dtype=torch.float64))
    distance = torch.hypot(x[:, None] - line_x.reshape(fine.shape), y[:, None] - line_y.reshape(fine.shape))
    assert (distance.min(1).values - arc.offset.abs()).abs().max() < 2e-3
    ahead = torch.remainder(found - s + track.length / 2, track.length) - track.length / 2
    assert ahead.abs().max() < 2e-2
    assert (arc.nx + direction.sin()).abs().max() < 2e-3


def circle_file(path, lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def circle_lines(n=60, radius=100.0, width=5.0):
    angles = [2 * math.pi * k / n for k in range(n)]
    return [f"{radius * math.cos(a)}, {radius * math.sin(a)}, {width}, {width}" for a in angles]


def rounded(n):
    """A circle in decimetres, whose points are two thirds of a metre apart."""
    points = [[float(value) for value in line.split(",")] for line in circle_lines(n)]
    return [f"{x:.1f}, {y:.1f}, {right}, {left}" for x, y, right, left in points]


def test_a_track_from_a_file(tmp_path):
    track = Track.from_csv(circle_file(tmp_path / "circle.csv", ["# x_m,y_m,w_right,w_left", *circle_lines()]))
    assert track.name == "circle"
    assert track.length == pytest.approx(2 * math.pi * 100.0, rel=1e-3)
    torch.testing.assert_close(track.table[:, 4], torch.full((len(track.table),), 0.01).double(), rtol=2e-2, atol=0)


def test_a_first_point_that_is_repeated_changes_nothing():
    angle = np.linspace(0, 2 * np.pi, 61)
    points = 100.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    left, right = 6.0 + np.cos(angle), 7.0 + np.sin(angle)
    once = Track.from_points(points[:-1], left[:-1], right[:-1])
    for off in (0.0, 0.01):  # of a file with rounded numbers
        points[-1] = points[0] + [off, off]
        twice = Track.from_points(points, left, right)
        assert twice.spacing == once.spacing
        torch.testing.assert_close(twice.table, once.table, rtol=0, atol=1e-9)
    widths = torch.tensor([6.0, 7.0]) + once.table[:, :2] / 100.0
    torch.testing.assert_close(once.table[:, 5:7], widths, atol=0.01, rtol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:40], "is open"),
        (lambda lines: [*lines[:5], "nan, 1, 5, 5", *lines[5:]], r"line 6.*expected x, y"),
        (lambda lines: [*lines[:5], "1, 2, 3", *lines[5:]], r"line 6.*expected x, y"),
        (lambda lines: circle_lines(width=0.8), r"0\.80 m wide.*at least 3"),
        (lambda lines: lines[:4], "4 points"),
        (lambda lines: [line.replace(",", ";") for line in lines], r"line 1.*separated by commas"),
        (lambda lines: [*lines[:5], lines[4], *lines[5:]], "points 5 and 6 are the same"),
        (lambda lines: circle_lines(radius=9000.0), "is 56[0-9]{3} m long: expected 100 to 30000 m"),
        (lambda lines: [*lines[:5], "1e300, 1, 5, 5", *lines[5:]], r"line 6.*expected x, y"),
        (lambda lines: [*lines[:5], "1, \0, 5, 5", *lines[5:]], r"line 6.*expected x, y"),
        (lambda lines: ["100.0, oops, 5, 5", *lines], r"line 1.*expected x, y"),
        (lambda lines: [f"5.2e6, {line.split(',', 1)[1]}" for line in lines], r"below 1e\+06; of larger coordinates"),
        (lambda lines: rounded(1000), r"is 6.0 m from the centre line, which has a radius of 1.4 m there"),
    ],
    ids=[
        "open",
        "nan",
        "columns",
        "narrow",
        "short",
        "semicolons",
        "twice",
        "long",
        "far",
        "nul",
        "first",
        "utm",
        "kinks",
    ],
)
def test_bad_files_are_refused(tmp_path, change, message):
    path = circle_file(tmp_path / "bad.csv", change(circle_lines()))
    with pytest.raises(ValueError, match=message):
        Track.from_csv(path)


def test_a_file_that_is_no_text_is_refused(tmp_path):
    file = tmp_path / "picture.csv"
    file.write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ValueError, match="is not a text file: expected lines of x, y"):
        Track.from_csv(file)


def test_walls_move_closer_inside_tight_corners():
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    points = np.stack([200.0 * np.cos(angle), 60.0 * np.sin(angle)], axis=1)  # radius 18 m at its ends
    track = Track.from_points(points, np.full(60, 6.0), np.full(60, 6.0), margin=20.0)
    margin, curvature = track.table[:, 7], track.table[:, 4]
    assert margin.max() == 20.0 and 8.0 < margin.min() < 13.0
    torch.testing.assert_close(margin[curvature.argmax()], 0.94 / curvature.max() - 6.0)


def test_a_track_that_crosses_itself_is_refused():
    t = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    eight = np.stack([300 * np.sin(t), 150 * np.sin(2 * t)], axis=1)
    with pytest.raises(ValueError, match="crosses itself"):
        Track.from_points(eight, np.full(200, 5.0), np.full(200, 5.0), "eight")


def test_turns_that_do_not_close_are_refused():
    with pytest.raises(ValueError, match="270 degrees"):
        Track.from_turns([(100.0, 90.0, 50.0)] * 3)
    with pytest.raises(ValueError, match="is open"):
        Track.from_turns([(100.0, 90.0, 50.0), (300.0, 90.0, 50.0), (100.0, 90.0, 50.0), (200.0, 90.0, 50.0)])


def test_the_generator_repeats_itself():
    first, second = generate_track(3, 4000.0), generate_track(3, 4000.0)
    assert torch.equal(first.table, second.table)
    assert 3600 < first.length < 4400
    with pytest.raises(ValueError, match="2000 to 14000"):
        generate_track(0, 500.0)


def test_unknown_tracks_are_refused():
    with pytest.raises(ValueError, match=r"unknown track 'monza'.*lakeside"):
        load_track("monza")


@pytest.mark.parametrize(("car", "expected"), [("gt3", 113.9), ("x2019", 88.8)])
def test_quasi_steady_state_laps(car, expected):
    """Compare with known laps of Lakeside's centre line to 2 %; the line of least curvature is 4 to 8 % faster."""
    track = load_track("lakeside")
    line = minimum_curvature_line(track)
    assert (np.abs(line) <= 6.0 - 1.2 + 1e-9).all()
    points = track.table[:, :2].numpy() + line[:, None] * np.stack([-track.table[:, 3], track.table[:, 2]], axis=1)
    bend = points - 0.5 * (np.roll(points, 1, axis=0) + np.roll(points, -1, axis=0))
    assert (bend**2).sum() < 1.0005 * 2.25763  # with ten times the iterations
    times = []
    for offsets in (None, line):
        curvature, spacing = line_geometry(track, offsets)
        [speed] = speed_profiles(Envelope(load_car(car)), [curvature], [spacing])
        times.append(np.sum(2 * spacing / (speed + np.roll(speed, -1))))  # constant acceleration between points
    assert times[0] == pytest.approx(expected, rel=0.02)
    assert 0.92 < times[1] / times[0] < 0.96


def test_cornering_speed_without_downforce_is_the_square_root():
    from dataclasses import replace

    car = replace(load_car("gt3"), lift_area=0.0, grip_per_load=0.0)
    speed = cornering_speed(Envelope(car), np.array([1 / 50.0]))
    assert speed[0] == pytest.approx(math.sqrt(0.96 * 1.62 * 9.81 * 50.0), rel=1e-6)
