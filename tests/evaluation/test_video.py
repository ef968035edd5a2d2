"""Films: encoders, captions and the tour of styles."""

import numpy as np
import pytest
from PIL import Image

from coachable.domain import load_domain
from coachable.envs.humanoid import humanoid_style_space
from coachable.evaluation.video import default_tour, render, write_video


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


def test_gif_keeps_the_duration(tmp_path):
    write_video(frames(), tmp_path / "film.gif", fps=40)
    with Image.open(tmp_path / "film.gif") as image:
        assert image.n_frames == 4  # 20 a second
        assert image.info["duration"] == 50


def test_the_tour_shows_every_pose_with_three_lengths():
    tour = default_tour(load_domain("humanoid"), humanoid_style_space())
    assert len(tour) == 9
    assert tour[0] == {"pose": "arms_in_front", "step_length": pytest.approx(0.30)}
    assert [round(stop["step_length"], 3) for stop in tour[:3]] == [0.3, 0.475, 0.65]


def test_another_suffix_is_refused_before_anything_is_drawn(tmp_path):
    with pytest.raises(ValueError, match=r"cannot write film.avi: expected a file ending in one of"):
        render("humanoid", tmp_path / "film.avi")


def test_the_tour_of_weights_is_the_grid():
    domain = load_domain("racing_drift")
    assert default_tour(domain, domain.make_space()) == domain.cells()
