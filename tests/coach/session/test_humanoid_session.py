"""Sessions of the shipped humanoid."""

import math

import pytest

from coachable.coach.phrases.grammar import fitting
from coachable.coach.session.recording import Recording
from coachable.coach.session.session import CoachSession
from coachable.domain import load_domain
from coachable.domains.humanoid import humanoid_style_space
from coachable.styles import Choice


@pytest.fixture(scope="module")
def humanoid():
    session = CoachSession.open("humanoid", seed=1)
    yield session
    session.close()


def test_words_and_presets_of_what_the_style_space_lacks_are_left_out():
    """An agent may have been trained on fewer styles than its domain has now."""
    humanoid = load_domain("humanoid")
    course = humanoid.controls[0].parameter
    fewer = fitting(humanoid.words, [Choice("pose", ("arms_up", "t_pose")), course])
    assert not any(meaning.startswith("step_length") for meaning in fewer.vocabulary)
    assert "pose=arms_in_front" not in fewer.vocabulary and "pose=t_pose" in fewer.vocabulary
    assert "course" in fewer.vocabulary
    assert fewer.presets == {}
    assert fitting(humanoid.words, [*humanoid_style_space().parameters, course]) == humanoid.words


class TestHumanoid:
    def test_it_acts_and_is_measured(self, humanoid):
        humanoid.reset(seed=1)
        humanoid.say("T-pose, 0.5 m")
        humanoid.run(1.0)
        report = humanoid.report()
        assert report.requested == {"pose": "t_pose", "step_length": 0.5}
        assert {"forward_speed", "pose_held"} <= set(report.measured)

    def test_it_is_judged_by_footsteps(self, humanoid):
        humanoid.reset(seed=1)
        humanoid.set(pose="arms_up", step_length=0.5)
        assert humanoid.report().measured == {}, "nothing before a step was made"
        humanoid.step()
        report = humanoid.report()
        assert report.unmeasured[:2] == ("step_length", "step_length_error") and report.needs == "a footstep"
        assert set(report.measured) == {"task_reward", "forward_speed", "pose_held", "power", "drift"}
        assert report.complying is None and report.complied_after is None
        while humanoid.report().complied_after is None:
            humanoid.step()
        report = humanoid.report()
        assert report.complying is not None and "step_length" in report.measured

    def test_the_course_turns_and_wraps_around(self, humanoid):
        humanoid.steer(course=0.0)
        humanoid.reset(seed=1)
        humanoid.steer(course=190.0)
        assert humanoid.controls == {"course": -170.0}
        assert humanoid.base_env.course[0] == 0.0
        humanoid.run(0.1)
        assert humanoid.base_env.course[0] == pytest.approx(math.radians(-4.5)), "45 deg/s, on the shorter way"
        recording = humanoid.recording()
        assert [event["controls"] for event in recording.events][-1] == {"course": pytest.approx(-4.5)}
        humanoid.reset(seed=1)
        assert humanoid.base_env.course[0] == pytest.approx(math.radians(-170.0)), "an episode begins there"
        humanoid.say("turn left by 30 degrees")
        assert humanoid.controls == {"course": -140.0}
        for bad, message in [({"course": math.nan}, "course = nan"), ({"altitude": 1.0}, "no live control named")]:
            with pytest.raises(ValueError, match=message):
                humanoid.steer(**bad)

    def test_a_push_lasts_a_moment_and_is_replayed(self, humanoid):
        humanoid.steer(course=0.0)
        humanoid.reset(seed=1)
        humanoid.run(0.5)
        humanoid.push(left=-100.0)
        assert humanoid.base_env.pushing[0] == pytest.approx([0.0, -100.0, 0.0])
        humanoid.run(0.25)
        assert not humanoid.base_env.pushing.any()
        velocity = humanoid.base_env.simulation.velocities[0, :2].copy()
        recording = Recording.from_json(humanoid.recording().to_json())
        assert [event["step"] for event in recording.events] == [20]
        humanoid.replay(recording)
        humanoid.run(0.75)
        assert (humanoid.base_env.simulation.velocities[0, :2] == velocity).all()
        assert not humanoid.replaying

    def test_a_replay_repeats_every_bit(self, humanoid):
        humanoid.reset(seed=5)
        humanoid.steer(course=0.0)
        humanoid.reset(seed=5)
        states = []

        def note(session):
            states.append(session.base_env.simulator_state()["state"])

        humanoid.run(0.5, note)
        humanoid.set(pose="arms_up", step_length=0.6)
        humanoid.steer(course=30.0)
        humanoid.run(1.5, note)
        recording = Recording.from_json(humanoid.recording().to_json())
        humanoid.steer(course=77.0)
        humanoid.replay(recording)
        for state in states:
            humanoid.step()
            assert humanoid.base_env.simulator_state()["state"].equal(state)
