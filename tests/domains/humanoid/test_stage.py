"""Scene of the humanoid: footprints lie where the feet struck, and a push is shown while it lasts."""

import numpy as np
import pytest

from coachable.coach.session.session import CoachSession
from coachable.domains.humanoid.stage import SIDES, HumanoidStage
from coachable.envs.humanoid.observation import rotate_to_course
from coachable.scene import palette


@pytest.fixture(scope="module")
def walk():
    """The frames of four seconds, the footprints that the simulation measured meanwhile, and the steps to them."""
    session, stage, frames, struck, steps = CoachSession.open("humanoid", seed=1), HumanoidStage(), [], [], []
    before = None
    for _ in range(160):
        session.step()
        frames.append(stage.frame(session.env, 0, session.style))
        prints = session.base_env.gait.prints[0].copy()
        for foot in range(2):
            if before is None or (prints[foot] != before[foot]).any():
                struck.append(prints[foot])
                steps.append(np.zeros(2) if before is None else prints[foot] - before[1 - foot])
        before = prints
    yield session, stage, frames, np.array(struck), np.array(steps)
    session.close()


def prints_of(frame):
    boxes = frame.marks.of("box")
    return boxes.positions[np.isclose(boxes.sizes[:, 0], 0.26), :2]


def test_footprints_lie_where_the_feet_struck(walk):
    *_, frames, struck, _ = walk
    assert 6 < len(struck) <= 24
    assert prints_of(frames[-1]) == pytest.approx(struck)


def test_beside_them_are_the_lengths_of_the_last_steps(walk):
    session, _, frames, struck, steps = walk
    lengths = rotate_to_course(steps, session.base_env.course.repeat(len(steps)))[:, 0]
    shown = np.flatnonzero(lengths >= 0.05)[-4:]  # a foot that strikes twice in one place makes no step
    lengths = lengths[shown]
    assert [label.text for label in frames[-1].labels] == [f"{length:.2f} m" for length in lengths]
    assert np.array([label.position for label in frames[-1].labels])[:, :2] == pytest.approx(struck[shown])
    assert frames[-1].gauges[1].text == " ".join(f"{length:.2f}" for length in lengths) + " m"


def test_a_line_shows_where_a_step_of_the_requested_length_ends(walk):
    session, stage, frames, struck, _ = walk
    boxes = frames[-1].marks.of("box")
    line = boxes.positions[(boxes.colours == palette.REQUESTED).all(1)]
    assert line[0, :2] - struck[-1] == pytest.approx([session.style["step_length"], 0.0])  # along the course
    without = stage.frame(session.env).marks.of("box").colours
    assert not (without == palette.REQUESTED).all(1).any()


def test_the_body_has_a_colour_for_each_side_and_moves_as_the_simulation_does(walk):
    session, _, frames, *_ = walk
    first, last = frames[0].parts, frames[-1].parts
    for shape in ("ball", "cylinder"):
        assert len(first.of(shape)) == len(last.of(shape)) > 15
    torso = session.base_env.simulation.positions[0, :2]
    assert np.asarray(frames[-1].focus)[:2] == pytest.approx(torso)
    assert np.abs(last.of("ball").positions[:, :2] - torso).max() < 1.2
    assert last.of("ball").positions[:, 2].min() > 0.0
    right, left = (palette.mixed(SIDES[side], (214, 208, 196), 0.25) for side in ("right", "left"))
    colours = last.of("cylinder").colours
    assert (colours == right).all(1).sum() == (colours == left).all(1).sum() > 4


def test_the_ground_is_marked_every_half_metre(walk):
    session, stage, *_ = walk
    lines = stage.backdrop(session.env).parts.of("box")
    along = np.unique(lines.positions[lines.sizes[:, 0] > 1.0, 1])
    assert np.diff(along) == pytest.approx(0.5)
    metres = (lines.sizes[:, :2].min(1) > 0.02) & (lines.sizes[:, 0] > 1.0)
    assert np.diff(np.unique(lines.positions[metres, 1])) == pytest.approx(1.0)


def test_a_push_is_shown_while_it_lasts():
    session, stage = CoachSession.open("humanoid", seed=1), HumanoidStage()
    session.step()
    assert len(stage.frame(session.env).glows) == 0
    session.push(left=100.0)
    shown = []
    for _ in range(12):
        frame = stage.frame(session.env)
        shown.append(len(frame.glows))
        if frame.glows.of("cylinder"):
            assert frame.glows.of("cylinder").positions[0, 1] < frame.focus[1], "it comes from the right"
        session.step()
    assert all(shown[:8]) and not any(shown[8:])  # 0.2 s
    session.close()


def test_an_episode_begins_without_footprints(walk):
    session, stage, frames, *_ = walk
    session.reset()
    session.step()
    frame = stage.frame(session.env)
    assert len(prints_of(frame)) == 2 and not frame.labels and frame.episode != frames[-1].episode
