"""Recordings of sessions, and their exact replays."""

import json
import math
from dataclasses import replace

import pytest
import torch
from tensordict.nn import TensorDictModule

from coachable.coach.session.recording import Recording, ReplayMismatch
from coachable.coach.session.session import CoachSession
from coachable.domain import Push
from coachable.keys import STYLE
from tests.coach.echo_domain import ECHO, echo_session


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


def test_a_request_after_a_replay_counts(session):
    """The recording ends with a request that no step followed."""
    session.set(target=0.1)
    session.run(0.5)
    session.set(target=0.2)
    recording = session.recording()
    session.replay(recording)
    session.run(0.5)
    session.set(target=0.7)
    session.step()
    assert session.style["target"] == pytest.approx(0.7)


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
        ({"version": 1, "endless": True}, "schema version 1: this release reads version 2"),
        ({"endless": True}, "unknown entries"),
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
        with pytest.raises(ValueError, match="not a recording"):
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
