"""The coaching session: when requests act, and what is measured."""

import math
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule

from coachable.coach.session.plan import read_plan
from coachable.coach.session.session import CoachSession
from coachable.keys import STYLE
from coachable.styles import StyleRangeWarning, StyleReward, StyleSpace, Term, Weight
from coachable.training.checkpoint import CheckpointError
from tests.coach.echo_domain import ECHO, EchoMeasures, echo_session


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


@pytest.mark.parametrize(("value", "outside"), [("0.5", {}), ("1.5", {"target": 1.5}), (1e300, {"target": 1e300})])
def test_what_lies_outside_are_numbers(session, value, outside):
    """A number may be given as text, and need not fit into a float32."""
    with pytest.warns(StyleRangeWarning) if outside else nullcontext():
        session.set(target=value)
    assert session.report().outside == outside


@pytest.mark.parametrize("value", ["inf", "-1e999"])
def test_what_lies_outside_can_be_written_as_json(session, value):
    with pytest.warns(StyleRangeWarning):
        session.set(target=value)
    assert abs(session.report().outside["target"]) == sys.float_info.max


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
        ({"mood": "angry"}, "is not an option"),
        ({"target": "fast"}, "is not a number"),
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
    for seed in (-1, 2**63, "1"):
        with pytest.raises(ValueError, match="expected a whole number from 0"):
            session.reset(seed)
    session.step()


@pytest.mark.parametrize("seconds", [-1.0, float("nan"), float("inf")])
def test_run_takes_a_finite_time(session, seconds):
    with pytest.raises(ValueError, match=r"seconds = .*: expected 0 or more"):
        session.run(seconds)


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


def test_time_limits_are_ignored(session):
    session.set(target=0.0)
    truncated = sum(bool(session.step()["next", "truncated"]) for _ in range(25))
    assert truncated and session.ended is None and session.episode == 1
    assert session.report().endings == {}


def test_a_time_limit_ends_an_episode_where_the_environment_cannot_go_on():
    gymnasium = pytest.importorskip("gymnasium")
    from coachable.gym import GymnasiumEnv

    def features(observation, action, info):
        return [observation[1]]

    domain = replace(
        ECHO,
        make_env=lambda num_envs, **_: GymnasiumEnv(
            lambda: gymnasium.wrappers.TimeLimit(gymnasium.make("Pendulum-v1").unwrapped, 5), features, num_envs
        ),
    )
    policy = TensorDictModule(lambda style: style[..., :1].clone(), in_keys=[STYLE], out_keys=["action"])
    session = CoachSession(policy, domain.make_space(), domain, seed=0)
    for _ in range(5):
        session.step()
    assert session.ended == "reached the time limit" and session.episode == 1
    session.step()
    assert session.ended is None and session.episode == 2
    session.close()


def test_a_scheduled_value_outside_the_range_is_flagged_when_it_comes(session):
    with pytest.warns(StyleRangeWarning):
        session.schedule({0.1: {"target": 2.0}})
    session.step()
    assert session.report().outside == {}
    session.run(0.2)
    assert session.style["target"] == pytest.approx(0.8) and session.report().outside == {"target": 2.0}


def test_minutes_and_seconds_are_no_time_of_a_plan(session):
    with pytest.raises(ValueError, match="'1:30: fire' is not of the form SECONDS: PHRASE"):
        read_plan("1:30: fire", session)


def test_a_plan_goes_back_to_normal_whatever_is_steered():
    session = CoachSession.open("humanoid", seed=1)
    session.steer(course=90.0)
    session.run(0.5)
    assert session.controls["course"] != 0.0
    session.set(pose="t_pose")
    assert read_plan("3: back to normal", session) == {3.0: {"pose": "arms_in_front"}}
    session.close()


def test_a_recording_that_cannot_be_written_leaves_the_old_one(session, tmp_path, monkeypatch):
    file = session.recording().save(tmp_path / "session.json")
    before = file.read_text()
    session.step()
    monkeypatch.setattr(Path, "write_text", lambda *_, **__: (_ for _ in ()).throw(OSError("no space left")))
    with pytest.raises(OSError, match="no space left"):
        session.recording().save(file)
    assert file.read_text() == before and list(tmp_path.iterdir()) == [file]


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
    session.schedule({0.10: {"mood": "calm"}, 0.11: {"target": 0.5}, 1e308: {"target": 0.0}})  # in one step, and never
    session.run(0.2)
    assert (session.style["target"], session.style["mood"]) == (0.5, "calm")
    session.schedule({1.0: {"target": 0.0}})
    session.cancel()
    assert session.scheduled == 0
    for plan, message in [
        ({-1.0: {}}, "time -1"),
        ({"1": {}}, "time '1'"),
        ({0.0: "walk"}, "no preset named 'walk'"),
        ({0.0: {"x": 1}}, "'x'"),
    ]:
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


def test_seeding_starts_over(session):
    first = [session.step()["next", "observation"] for _ in range(5)]
    session.reset(seed=3)
    assert session.step_count == 0 and session.recording().events == []
    second = [session.step()["next", "observation"] for _ in range(5)]
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_a_missing_agent():
    with pytest.raises(CheckpointError, match="no checkpoint at nowhere"):
        CoachSession.open("nowhere")


def test_the_entries_of_a_plan_are_read_in_the_order_of_their_times(session):
    plan = read_plan("3: target 0.1 m more; 0: target 0.5 m", session)
    assert plan == {0.0: {"target": 0.5}, 3.0: {"target": pytest.approx(0.6)}}
