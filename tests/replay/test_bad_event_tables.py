"""Event tables that cannot be built, and steps that they refuse."""

import pytest
import torch

from coachable.replay import EventTableBuffer, KeyEvents, KeyRoute, PredicateEvents, StyleEvents
from coachable.styles import StyleSpace, Weight
from tests.replay.one_event import one_event_buffer, steps

HIT = StyleSpace([Weight("hit", 0.0, 1.0)])
BAD_CONSTRUCTIONS = {
    "empty": (dict(table_capacities={}), "lacks"),
    "capacity": (dict(table_capacities={"default": 0}), "positive integer"),
    "capacity type": (dict(table_capacities={"default": 1.5}), "positive integer"),
    "missing table": (dict(table_capacities={"default": 9}, events=KeyEvents(["hit"]), event_horizon=1), r"\['hit'\]"),
    "stray table": (dict(table_capacities={"default": 9, "hit": 9}), r"no use for \['hit'\]"),
    "no horizon": (dict(events=KeyEvents(["hit"])), "event_horizon is None"),
    "horizon alone": (dict(table_capacities={"default": 9}, event_horizon=3), "no event tables"),
    "horizon zero": (dict(events=KeyEvents(["hit"]), event_horizon=0), "at least 1"),
    "horizon too long": (dict(events=KeyEvents(["hit"]), event_horizon=6), "larger than table_capacities"),
    "default too small": (dict(events=KeyEvents(["hit"]), event_horizon=5, num_envs=3), r"event_horizon \* num_envs"),
    "num_envs": (dict(table_capacities={"default": 9}, num_envs=0), "num_envs"),
    "sum": (dict(table_capacities={"default": 9}, table_proportions={"default": 0.9}), "sum to 1"),
    "negative": (
        dict(
            events=KeyEvents(["hit"]), event_horizon=1, table_proportions={"default": 1.5, "hit": -0.5},
        ),
        "sum to 1",
    ),
    "proportion names": (dict(table_capacities={"default": 9}, table_proportions={"all": 1.0}), "exactly the tables"),
    "batch": (dict(events=KeyEvents(["hit"]), event_horizon=1, batch_size=1), "batch of 1"),
    "gamma": (dict(table_capacities={"default": 9}, n_steps=3), "gamma"),
    "gamma range": (dict(table_capacities={"default": 9}, n_steps=3, gamma=1.1), "gamma"),
    "n_steps": (dict(table_capacities={"default": 9}, n_steps=0, gamma=0.9), "n_steps"),
    "repeated": (dict(events=lambda: KeyEvents(["hit", "hit"])), "repeat"),
    "both": (dict(events=KeyEvents(["default"]), event_horizon=1), "both routed"),
    "prefetch": (dict(table_capacities={"default": 9}, prefetch=2, batch_size=2), "prefetch"),
    "alpha": (dict(table_capacities={"default": 9}, prioritized=True, priority_alpha=-1.0), "priority_alpha"),
    "beta": (dict(table_capacities={"default": 9}, prioritized=True, priority_beta=-1.0), "priority_beta is -1.0"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_CONSTRUCTIONS)
def test_bad_construction(case):
    arguments, message = BAD_CONSTRUCTIONS[case]
    arguments = {"table_capacities": {"default": 9, "hit": 5}, **arguments}
    with pytest.raises(ValueError, match=message):
        if case == "repeated":
            arguments["events"]()
        EventTableBuffer(**arguments)


class Returns:
    """A predicate or route that returns whatever it is told to."""

    def __init__(self, names, value):
        self.names, self.value = names, value

    def __call__(self, steps):
        return self.value


@pytest.mark.parametrize(
    "value", [torch.zeros(3, 2, dtype=torch.bool), torch.zeros(3, dtype=torch.bool), torch.zeros(3, 1), None]
)
def test_predicate_of_wrong_shape_is_reported_at_the_first_extend(value):
    buffer = EventTableBuffer({"default": 9, "hit": 5}, events=Returns(("hit",), value), event_horizon=1, num_envs=1)
    with pytest.raises(ValueError, match=r"event predicate Returns .* expected torch.bool \(3, 1\)"):
        buffer.extend(steps([0, 1, 2], [False] * 3))
    assert len(buffer) == 0


@pytest.mark.parametrize("value", [torch.zeros(3, 1).long(), torch.zeros(3), torch.tensor([0, 1, 2]), None])
def test_route_of_wrong_shape_or_range_is_reported(value):
    buffer = EventTableBuffer({"a": 9, "b": 5}, route=Returns(("a", "b"), value))
    with pytest.raises(ValueError, match="the route Returns"):
        buffer.extend(steps([0, 1, 2], [False] * 3))


@pytest.mark.parametrize(
    "given, lacking, message",
    [
        ({"events": KeyEvents(["hit"])}, ("next", "events"), "'next', 'events'"),
        ({"events": StyleEvents(HIT)}, ("next", "events"), "'next', 'events'"),
        ({"events": StyleEvents(HIT)}, "style", "no 'style'"),
        ({"route": KeyRoute(["default", "hit"])}, "scenario", "no 'scenario'"),
    ],
)
def test_steps_without_the_entry_that_decides_on_tables_are_refused(given, lacking, message):
    horizon = {"event_horizon": 1} if "events" in given else {}
    buffer = EventTableBuffer({"default": 9, "hit": 5}, num_envs=1, **horizon, **given)
    whole = steps([0, 1], [False] * 2, style=torch.ones(2, 1), scenario=torch.zeros(2, 1, dtype=torch.long))
    with pytest.raises(ValueError, match=message):
        buffer.extend(whole.exclude(lacking))
    buffer.extend(whole)


def test_wrong_event_columns_name_the_tables():
    events = StyleEvents(StyleSpace([Weight("melee", -1.0, 1.0), Weight("traps", 0.0, 1.0)]))
    capacities = {"default": 9, "melee": 5, "traps": 5}
    buffer = EventTableBuffer(capacities, events=events, event_horizon=1, num_envs=1)
    with pytest.raises(ValueError, match="melee, traps"):
        buffer.extend(steps([0], [[True]], style=torch.ones(1, 2)))


def test_a_predicate_without_events_is_refused():
    with pytest.raises(ValueError, match="events has no names"):
        EventTableBuffer.for_events(KeyEvents([]), capacity=9, event_capacity=9, event_horizon=1, num_envs=1)


def test_predicate_columns_must_match_the_steps():
    events = PredicateEvents({"hit": lambda td: td["next", "events"]})
    buffer = EventTableBuffer({"default": 9, "hit": 5}, events=events, event_horizon=1, num_envs=1)
    with pytest.raises(ValueError, match="predicate of table 'hit'"):
        buffer.extend(steps([0, 1], [False] * 2))


def test_streams_that_cannot_be_told_apart_are_an_error():
    buffer = EventTableBuffer({"default": 9, "hit": 5}, events=KeyEvents(["hit"]), event_horizon=1)
    with pytest.raises(ValueError, match="num_envs"):
        buffer.extend(steps([0, 1], [False] * 2))
    buffer = EventTableBuffer({"default": 9, "hit": 5}, events=KeyEvents(["hit"]), event_horizon=1, num_envs=3)
    with pytest.raises(ValueError, match="expected a multiple"):
        buffer.extend(steps([0, 1], [False] * 2))
    with pytest.raises(ValueError, match=r"expected .steps,."):
        buffer.extend(steps([0, 1], [False] * 2).reshape(1, 2, 1))
    with pytest.raises(ValueError, match="done"):
        buffer.extend(steps([0, 1, 2], [False] * 3).exclude(("next", "done")))


def test_unknown_table():
    with pytest.raises(KeyError, match="hit"):
        one_event_buffer(1).table("miss")


def test_a_batch_of_another_number_of_environments_is_refused():
    """Exchanged dimensions would be read as steps of other environments."""
    rb = EventTableBuffer({"default": 9, "hit": 9}, events=KeyEvents(["hit"]), event_horizon=1, num_envs=2)
    with pytest.raises(ValueError, match=r"shape \(3, 2\), and the buffer has num_envs=2: expected \(num_envs, time\)"):
        rb.extend(steps(range(6), [False] * 6).reshape(3, 2))
