"""The coaching session: when requests act, what is measured, and exact replays."""

import json
import math
from dataclasses import replace

import pytest
import torch
from tensordict.nn import TensorDictModule

from coachable.coach.phrases.fitting import fitting
from coachable.coach.session.live_episodes import TIME_IS_UP
from coachable.coach.session.recording import Recording, ReplayMismatch
from coachable.coach.session.session import CoachSession
from coachable.domain import Push, load_domain
from coachable.domains.humanoid import humanoid_style_space
from coachable.keys import STYLE
from coachable.styles import Choice, StyleRangeWarning, StyleReward, StyleSpace, Term, Weight
from coachable.training.checkpoint import CheckpointError
from tests.coach.echo_domain import ECHO, EchoMeasures, echo_session


@pytest.fixture
def session():
    session = echo_session(seed=3)
    yield session
    session.close()


def test_a_request_acts_at_the_next_observation(session):
    session.set(target=0.25)
    first = session.step()
    assert first[STYLE][0, 0] == 0.25
    assert first["action"].item() == 0.25
    session.set(target=-0.5, mood="wild_card")
    assert first[STYLE][0, 0] == 0.25, "the transition before keeps its style"
    second = session.step()
    assert second["observation"].equal(first["next", "observation"])
    assert second["action"].item() == -0.5
    assert session.style == {"target": -0.5, "mood": "wild_card", "fire": 0.0}


def test_outside_the_trained_range_is_clamped_with_a_warning_and_flagged(session):
    with pytest.warns(StyleRangeWarning, match=r"target = 1.5 m lies outside \[-0.8, 0.8\] m"):
        session.set(target=1.5)
    assert session.style["target"] == pytest.approx(0.8)
    assert session.report().outside == {"target": 1.5}
    session.set(fire=1.0)
    assert session.report().outside == {"target": 1.5}
    session.set(target=0.8)
    assert session.report().outside == {}


def test_a_drawn_style_is_within_the_trained_range(session):
    with pytest.warns(StyleRangeWarning):
        session.set(target=1.5)
    session.hold = False
    session.reset()
    assert session.report().outside == {}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"target": math.nan}, "NaN"),
        ({"speed": 1.0}, "unknown style parameter 'speed'"),
        ({"mood": "angry"}, "no option"),
        ({"target": "fast"}, "is no number"),
    ],
)
def test_a_bad_request_changes_nothing(session, values, message):
    before = session.style
    with pytest.raises(ValueError, match=message):
        session.set(**values)
    assert session.style == before
    assert session.recording().events == []


def test_strict_sessions_refuse():
    session = echo_session(strict=True)
    with pytest.raises(ValueError, match="lies outside"):
        session.set(target=0.9)
    with pytest.raises(ValueError, match="lies outside"):
        session.schedule({0.0: {"target": 0.9}})
    assert session.style["target"] == 0.0 and session.scheduled == 0


def test_measured_beside_requested(session):
    session.set(target=0.5)
    session.run(0.5)
    report = session.report()
    assert report.requested["target"] == 0.5
    assert report.measured == {"task_reward": 0.0, "target": 0.5, "pace": 0.5, "fire": 0.25}
    assert report.complied_after == pytest.approx(0.05)
    assert report.since_request == pytest.approx(0.5)


def test_compliance_counts_from_the_latest_request(session):
    session.run(0.2)
    stubborn = TensorDictModule(lambda style: torch.zeros_like(style[..., :1]), in_keys=[STYLE], out_keys=["action"])
    session.policy = stubborn
    session.set(target=0.5)
    session.run(0.2)
    assert session.report().complied_after is None
    session.set(target=0.0)
    session.step()
    assert session.report().complied_after == pytest.approx(0.05)


def test_the_window_begins_anew_with_a_request(session):
    session.set(target=0.5)
    session.run(0.5)
    session.set(target=-0.5)
    report = session.report()
    assert report.measured == {} and report.seconds == 0.0 and report.complying is None
    session.step()
    report = session.report()
    assert report.measured["target"] == -0.5 and report.seconds == pytest.approx(0.05) and report.complying == 1.0


def test_compliance_is_a_share_of_the_steps_that_can_be_judged(session):
    class Measures(EchoMeasures):
        needs = "a full moon"

        def judged(self, record):
            return record["fire"] > 0.1

    session._recent.measures = Measures()
    session.set(target=0.1)
    session.run(0.5)
    report = session.report()
    assert (report.complying, report.complied_after, report.needs) == (None, None, "a full moon")
    session.set(target=0.5)
    session.step()
    session.policy = TensorDictModule(lambda style: -style[..., :1], in_keys=[STYLE], out_keys=["action"])
    session.run(0.15)
    report = session.report()
    assert report.complying == pytest.approx(0.25) and report.complied_after == pytest.approx(0.05)


def test_what_has_no_value_is_named(session):
    class Measures(EchoMeasures):
        def summarise(self, record, alive):
            return super().summarise(record, alive) | {"target": torch.tensor([math.nan])}

    session._recent.measures = Measures()
    session.step()
    report = session.report()
    assert report.unmeasured == ("target",) and "target" not in report.measured


def test_a_style_of_zero_weights_asks_for_nothing():
    """Of the domains whose styles are weights only."""
    space = StyleSpace([Weight("fire", -1.0, 2.0)])
    policy = TensorDictModule(lambda style: style[..., :1] * 0.0, in_keys=[STYLE], out_keys=["action"])
    reward = StyleReward(space, {"fire": Term(lambda f, s: f[..., 0] * s["fire"], parameters=("fire",))})
    session = CoachSession(policy, space, replace(ECHO, make_reward=lambda _: reward))
    assert not session.report().asks
    session.set(fire=1.0)
    assert session.report().asks
    session.close()


def test_seeds_have_a_range(session):
    for seed in (-1, 2**63):
        with pytest.raises(ValueError, match="expected a whole number from 0"):
            session.reset(seed)
    session.step()


def run_until_ended(session: CoachSession) -> None:
    session.set(target=0.8)
    while session.ended is None:
        session.step()


def test_an_ended_episode_is_reset_by_the_next_step(session):
    run_until_ended(session)
    assert session.report().endings == {"ended": 1}
    assert session.report().episode == 1
    session.step()
    report = session.report()
    assert report.ended is None and report.episode == 2
    assert report.episode_time == pytest.approx(0.05)
    assert report.requested["target"] == pytest.approx(0.8), "the request is held"


def test_without_hold_each_episode_draws_a_style(session):
    session.hold = False
    run_until_ended(session)
    session.step()
    assert session.style["target"] != pytest.approx(0.8)
    assert session.recording().events[-1]["style"]["target"] == session.style["target"]


def test_time_limits_are_ignored_unless_wanted(session):
    session.set(target=0.0)
    limited = echo_session(seed=3, endless=False)
    reasons = set()
    for _ in range(60):
        limited.step()
        reasons.add(limited.ended)
    assert TIME_IS_UP in reasons
    while session.ended is None and session.step_count < 60:
        session.step()
    assert session.ended != TIME_IS_UP
    assert TIME_IS_UP not in session.report().endings


def test_schedules(session):
    session.presets["sprint"] = {"target": 0.75, "fire": 1.0}
    session.step()
    session.schedule({0.1: {"target": 0.25}, 0.2: "sprint", 0.0: {"mood": "wild_card"}})
    assert session.scheduled == 3
    seen = []
    for _ in range(6):
        session.step()
        seen.append((session.style["target"], session.style["mood"], session.style["fire"]))
    assert seen == [(0.0, "wild_card", 0.0)] * 2 + [(0.25, "wild_card", 0.0)] * 2 + [(0.75, "wild_card", 1.0)] * 2
    session.schedule({1.0: {"target": 0.0}})
    session.cancel()
    assert session.scheduled == 0
    for plan, message in [({-1.0: {}}, "time -1"), ({0.0: "walk"}, "no preset named 'walk'"), ({0.0: {"x": 1}}, "'x'")]:
        with pytest.raises(ValueError, match=message):
            session.schedule(plan)


def test_phrases_and_presets(session):
    understood = session.say("wild card, target 0.3 m, sing")
    assert session.style["mood"] == "wild_card" and session.style["target"] == pytest.approx(0.3)
    assert understood.failed == ("'sing' (unknown: sing)",)
    assert session.understand("target 0.5 m").changes == {"target": 0.5}
    assert session.style["target"] == pytest.approx(0.3), "understanding asks for nothing"
    session.say("a bit more")
    assert session.style["target"] == pytest.approx(0.46)  # a tenth of the range, upwards as before
    assert session.say("Default").said == ("preset default",)
    assert session.style == {"target": 0.0, "mood": "calm", "fire": 0.0}
    with pytest.raises(ValueError, match="no preset named 'jog'"):
        session.apply("jog")


def coached(session: CoachSession) -> list[torch.Tensor]:
    """A session with everything that can happen; the states after each step."""
    states = []

    def note(session: CoachSession) -> None:
        states.append(session.base_env.simulator_state()["position"].clone())

    session.set(target=0.1)
    session.run(0.5, note)
    session.set(target=1 / 3, mood="wild_card")
    session.run(2.0, note)
    session.reset()
    session.hold = False
    session.run(1.5, note)
    session.schedule({0.1: {"target": -0.7}, 0.5: "default"})
    session.run(3.0, note)
    return states


def test_a_replay_repeats_every_bit(session, tmp_path):
    states = coached(session)
    recording = session.recording()
    assert recording.steps == len(states) == 140
    file = recording.save(tmp_path / "session.json")
    fresh = echo_session(seed=99)
    fresh.replay(Recording.load(file))
    for state in states:
        assert fresh.replaying
        fresh.step()
        assert fresh.base_env.simulator_state()["position"].equal(state)
    assert not fresh.replaying
    assert fresh.recording() == recording


def test_a_replay_in_the_same_session(session):
    states = coached(session)
    session.replay(session.recording())
    for state in states:
        session.step()
        assert session.base_env.simulator_state()["position"].equal(state)


def test_a_request_takes_over_from_a_replay(session):
    coached(session)
    recording = session.recording()
    session.replay(recording)
    session.step()
    session.set(target=0.0)
    assert not session.replaying and session.scheduled == 0
    session.run(1.0)
    assert session.style["target"] == 0.0


def test_a_replay_with_other_weights_is_noticed(session):
    coached(session)
    recording = session.recording()
    other = echo_session()
    other.policy = TensorDictModule(lambda style: style[..., :1] * 0.5, in_keys=[STYLE], out_keys=["action"])
    other.replay(recording)
    with pytest.raises(ReplayMismatch, match="differs from the recording at step 40"):
        other.run(7.0)
    other.step()


def test_bad_recordings(session):
    good = json.loads(session.recording().to_json())
    for change, message in [
        ({"version": 2}, "schema version 2"),
        ({"colour": 1}, "unknown entries"),
        ({"domain": "racing"}, "belongs to 'racing'"),
        ({"style": {"speed": 1.0}}, "unknown style parameter 'speed'"),
        ({"controls": {"altitude": 1.0}}, "no live control named 'altitude'"),
        ({"events": [{"step": 0, "controls": {"altitude": 1.0}}]}, "no live control named 'altitude'"),
        ({"events": [{"step": 0, "style": {"speed": 1.0}}]}, "unknown style parameter 'speed'"),
        ({"events": [{"step": 0, "style": {"target": 7.0}}]}, "lies outside"),
        ({"events": [{"step": 0, "reset": 1}]}, "'events' is not what"),
        ({"events": [{"step": 0, "explode": True}]}, "'events' is not what"),
        ({"events": [{"style": {}}]}, "'events' is not what"),
        ({"events": [{"step": 3, "reset": True}, {"step": 1, "reset": True}]}, "'events' is not what"),
        ({"events": 5}, "'events' is not what"),
        ({"controls": {"course": math.inf}}, "'controls' is not what"),
        ({"events": [{"step": 0, "push": [1.0]}]}, "'events' is not what"),
        ({"events": [{"step": 0, "push": [1.0, 0.0]}]}, "the recording has a push"),
        ({"checks": [[1, 2, 3]]}, "'checks' is not what"),
        ({"seed": -1}, "'seed' is not what"),
        ({"seed": 10**30}, "expected a whole number"),
        ({"steps": "many"}, "'steps' is not what"),
    ]:
        with pytest.raises(ValueError, match=message):
            session.replay(Recording.from_json(json.dumps(good | change)))
        before = session.step_count
        session.set(target=0.25)
        session.step()
        assert session.step_count == before + 1 and session.style["target"] == 0.25, "the session goes on"
    for text in ("", "[1]", "{}", "nonsense", "[" * 100_000):
        with pytest.raises(ValueError, match="no recording"):
            Recording.from_json(text)


def test_pushes_are_limited_recorded_and_replayed(session):
    def shove(env, forward, left):
        env.position += forward

    domain = replace(ECHO, push=Push(shove, largest=0.5, unit="m"))
    pushed = CoachSession(session.policy, session.space, domain, seed=3)
    before = pushed.base_env.position.item()
    pushed.push(3.0, left=4.0)
    assert pushed.base_env.position.item() == pytest.approx(before + 0.3), "0.5 m in its direction"
    states = []
    for _ in range(5):
        pushed.step()
        states.append(pushed.base_env.position.clone())
    recording = Recording.from_json(pushed.recording().to_json())
    assert recording.events == [{"step": 0, "push": [pytest.approx(0.3), pytest.approx(0.4)]}]
    pushed.replay(recording)
    pushed.step()
    with pytest.raises(ValueError, match=r"a push of nan forward and 0\.0 left: expected numbers in m"):
        pushed.push(math.nan)
    assert pushed.replaying and pushed.base_env.position.equal(states[0])
    for state in states[1:]:
        pushed.step()
        assert pushed.base_env.position.equal(state)
    with pytest.raises(ValueError, match="echo has no push"):
        session.push(1.0)
    with pytest.raises(ValueError, match="the recording has a push: echo has none"):
        session.replay(recording)
    recording.events[0]["push"] = [1.0, 0.0]
    with pytest.raises(ValueError, match=r"a push of \[1.0, 0.0\]: expected at most 0.5 m"):
        pushed.replay(recording)
    pushed.close()


def test_seeding_starts_over(session):
    first = [session.step()["next", "observation"] for _ in range(5)]
    session.reset(seed=3)
    assert session.step_count == 0 and session.recording().events == []
    second = [session.step()["next", "observation"] for _ in range(5)]
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_a_missing_agent():
    with pytest.raises(CheckpointError, match="no checkpoint at nowhere"):
        CoachSession.open("nowhere")


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
        humanoid.reset(seed=1)
        humanoid.steer(course=190.0)
        assert humanoid.controls == {"course": -170.0}
        assert humanoid.base_env.course[0] == pytest.approx(math.radians(-170.0))
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
