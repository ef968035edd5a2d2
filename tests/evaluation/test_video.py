"""Films: encoders, captions and the tour of styles."""

import math
import re
import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence
from tensordict.nn import TensorDictModule

from coachable.domain import load_domain
from coachable.domains.humanoid import humanoid_style_space
from coachable.evaluation import video
from coachable.evaluation.video import (
    CAPTION,
    asked_line,
    caption,
    default_tour,
    measured_line,
    render,
    tiled,
    write_video,
)
from coachable.styles import StyleRangeWarning, StyleSpace, Weight
from coachable.training.weights import domain_of, load_policy
from tests.evaluation.test_style_grid import DOMAIN, SPACE


def frames(count=8):
    for index in range(count):
        frame = np.zeros((48, 64, 3), dtype=np.uint8)
        frame[:, : 8 * index] = 255
        yield frame


def test_mp4_holds_every_frame(tmp_path):
    av = pytest.importorskip("av")
    write_video(frames(), tmp_path / "film.mp4", fps=40)
    with av.open(str(tmp_path / "film.mp4")) as container:
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(decoded) == 8
    assert decoded[0].shape == (48, 64, 3)
    bright = [frame.mean() for frame in decoded]
    assert bright == sorted(bright)


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_gif_and_webp_keep_the_duration(suffix, tmp_path):
    write_video(frames(), tmp_path / f"film.{suffix}", fps=40)
    with Image.open(tmp_path / f"film.{suffix}") as image:
        assert image.n_frames == 8 and image.size == (64, 48)
        durations = [shown.info["duration"] for shown in ImageSequence.Iterator(image) if shown.load()]
    assert sum(durations) == 200


@pytest.mark.parametrize(
    ("suffix", "together", "count", "size"),
    [
        (".webp", True, 4, (3 * 160, 2 * 100)),
        (".gif", True, 4, (3 * 160, 2 * 100)),
        (".webp", False, 16, (160, 100)),
        (".png", True, 1, (3 * 160, 2 * 100)),
    ],
)
def test_styles_are_filmed_together_or_in_turn(tmp_path, monkeypatch, suffix, together, count, size):
    monkeypatch.setattr(video, "domain_of", lambda agent: replace(domain_of(agent), make_renderer=GreyRenderer))
    styles = [{"step_length": length} for length in (0.3, 0.4, 0.5, 0.6)]
    settings = {"styles": styles, "seconds_per_style": 0.2, "size": (160, 100), "together": together}
    out = render("humanoid", tmp_path / f"film{suffix}", **settings)
    with Image.open(out) as image:
        assert getattr(image, "n_frames", 1) == count and image.size == size


def test_tiles_fill_rows_of_three():
    tiles = [np.full((2, 3, 3), value, dtype=np.uint8) for value in (1, 2, 3, 4)]
    assert tiled(tiles)[::2, ::3, 0].tolist() == [[1, 2, 3], [4, 0, 0]]


def test_long_lines_of_the_caption_are_written_smaller():
    line, frame = "asked: pose arms in front, step length 0.475", np.zeros((10, 280, 3), dtype=np.uint8)
    shown = caption(frame, (line, line))
    assert shown.shape == (10 + CAPTION, 280, 3)
    background = shown[-1, -1]
    assert (shown[10:, -3:] == background).all(), "it ends before the edge"
    assert (shown[10:, 200:] != background).any()


def test_the_caption_names_what_belongs_to_the_request_first():
    domain, space = load_domain("humanoid"), humanoid_style_space()
    values = {"forward_speed": 1.234, "pose_held": 0.5, "step_length": 0.5, "power": 700.4, "step_length_error": 0.1}
    found = values | {"drift": math.nan}
    shown = partial(measured_line, domain, space, {"pose": "arms_up", "step_length": 0.4}, found)
    assert shown(0) == "measured: pose held 50%, step length 0.500 m, forward speed 1.23 m/s"
    assert shown(2).endswith("; 2 failures")
    assert shown(2, short=True) == "measured: pose held 50%, step length 0.500 m"
    found.clear()
    assert shown(0) == "measured: nothing yet"


@pytest.mark.parametrize(
    ("pictures", "shares"),
    [
        (0.5, [[], [1.0], [], [1.0]]),
        (1.0, [[1.0]] * 4),
        (2.0, [[0.5, 1.0]] * 4),
        (1.5, [[2 / 3], [1 / 3, 1.0], [2 / 3], [1 / 3, 1.0]]),
    ],
)
def test_pictures_are_due_at_equal_intervals(pictures, shares):
    for step, expected in enumerate(shares):
        assert video._shares(step, pictures) == pytest.approx(expected)


def test_the_tour_shows_every_pose_with_three_lengths():
    tour = default_tour(load_domain("humanoid"), humanoid_style_space())
    assert len(tour) == 9
    assert tour[0] == {"pose": "arms_in_front", "step_length": pytest.approx(0.30)}
    assert [round(stop["step_length"], 3) for stop in tour[:3]] == [0.3, 0.475, 0.65]


def test_another_suffix_is_refused_before_anything_is_drawn(tmp_path):
    with pytest.raises(ValueError, match=r"cannot write film.avi: expected a file ending in one of"):
        render("humanoid", tmp_path / "film.avi")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": (64, 44)}, "the size is 64x44: expected 64x60 to 4096x4096"),
        ({"size": (100_000, 480)}, "the size is 100000x480: expected"),
        ({"size": (641, 480)}, "mp4 needs an even width and height"),
        ({"seconds_per_style": float("nan")}, "seconds per style are nan: expected more than 0"),
        ({"fps": 0.5}, "0.5 pictures per second: expected 1 to 60"),
        ({"seconds_per_style": 0.0}, "seconds per style are 0.0: expected more than 0"),
        ({"seconds_per_style": float("inf")}, "seconds per style are inf: expected more than 0, at most 3600"),
    ],
)
def test_odd_settings_are_refused_before_anything_is_drawn(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        render("humanoid", tmp_path / "film.mp4", **settings)


def test_the_caption_shows_what_the_agent_is_asked():
    space = humanoid_style_space()

    def line(**request):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", StyleRangeWarning)
            return asked_line(space, request, space.describe(space.make(**request)))

    assert line(pose="t_pose", step_length=0.5) == "requested: pose t pose, step length 0.5 m"
    assert line(step_length=9.0) == "requested: pose arms in front, step length 0.65 m (clamped from 9)"
    assert line(pose="arms_up", step_length=0.0) == "requested: pose arms up, step length 0.3 m (clamped from 0)"
    assert line() == "requested: pose arms in front, step length 0.475 m"


def test_the_caption_leaves_out_weights_of_zero():
    space = StyleSpace([Weight("fire", 0.0, 1.0), Weight("tire", -60.0, 12000.0)])
    assert asked_line(space, {"fire": 0.0}, {"fire": 0.0, "tire": 0.0}) == "requested: every weight 0"
    assert asked_line(space, {"tire": 6000.0}, {"fire": 0.0, "tire": 6000.0}) == "requested: tire 6000"


def test_the_film_of_a_request_outside_the_range_says_so(monkeypatch):
    captions = []
    monkeypatch.setattr(video, "caption", lambda frame, lines: captions.append(lines))
    agent, domain = load_policy("humanoid"), replace(load_domain("humanoid"), make_renderer=BlankRenderer)
    film = video._film(domain, agent.actor, agent.space, [{"step_length": 9.0}], 1, (64, 64), 0, None)
    assert len(list(film)) == 1
    assert captions[0][0] == "requested: pose arms in front, step length 0.65 m (clamped from 9)"


class GreyRenderer:
    def __init__(self, width, height):
        self.picture = np.full((height, width, 3), 128, dtype=np.uint8)

    def draw(self, env):
        self.picture += 16  # an equal frame would be joined with the one before
        return self.picture.copy()

    def close(self):
        pass


class BlankRenderer:
    def __init__(self, width, height):
        pass

    def draw(self, env):
        return None

    def close(self):
        pass


def test_what_is_measured_begins_again_with_an_episode(monkeypatch):
    lengths = []
    monkeypatch.setattr(video, "caption", lambda frame, lines: None)
    monkeypatch.setattr(video, "_summary", lambda domain, recent: lengths.append(len(recent)) or {})
    racer = TensorDictModule(lambda style: torch.full_like(style[:, 2:], 2.0), in_keys=["style"], out_keys=["action"])
    domain = replace(DOMAIN, make_renderer=BlankRenderer)
    list(video._film(domain, racer, SPACE, [{}], 7, (64, 64), 0, 10.0))
    assert lengths == [1, 2, 3, 4, 5, 1, 2]  # it falls in the fifth step


def test_the_tour_of_weights_is_the_grid():
    domain = load_domain("racing_drift")
    assert default_tour(domain, domain.make_space()) == domain.cells()


def test_a_narrow_caption_measures_everything_that_is_asked_for(monkeypatch):
    captions = []
    monkeypatch.setattr(video, "caption", lambda frame, lines: captions.append(lines))
    agent, domain = load_policy("humanoid_gait"), replace(load_domain("humanoid_gait"), make_renderer=BlankRenderer)
    assert len(list(video._film(domain, agent.actor, agent.space, [{}], 60, (64, 64), 0, None))) == 1
    assert re.fullmatch(r"measured: pose held \d+%, step length [\d.]+ m, speed [\d.]+ m/s", captions[0][1])
