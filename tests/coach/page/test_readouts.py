"""What the page shows of the measured style: charts, read-outs and the verdict."""

import re
import warnings

import numpy as np
import pytest

viser = pytest.importorskip("viser")


from coachable.coach.page.coach_page import listed, verdict  # noqa: E402
from coachable.coach.page.looks import pad_page  # noqa: E402
from coachable.coach.page.widgets import MeasuredText, _ends  # noqa: E402
from coachable.coach.session.readout import StyleReport  # noqa: E402
from coachable.scene.look import icon_link, stylesheet  # noqa: E402
from coachable.styles import Choice, Setpoint, StyleSpace  # noqa: E402
from tests.coach.echo_domain import ECHO  # noqa: E402
from tests.coach.page.driving import do, say, wait_for  # noqa: E402


def test_the_chart_follows_what_was_asked_for_last(page):
    page._press("Step")
    do(page)
    page.widgets["fire"].handle.value = 1.0
    wait_for(lambda: page.chart.shown == "fire" and page.chart.choice.value == "fire")
    page.widgets["mood"].handle.value = "wild card"
    wait_for(lambda: page.chart.shown == "mood")
    say(page, "target 0.4 m")
    assert page.chart.shown == "target"
    page.chart.choice.value = "fire"
    wait_for(lambda: page.chart.shown == "fire")
    page.widgets["target"].handle.value = 0.5
    wait_for(lambda: page.chart.shown == "target")


def test_the_chart_has_a_fixed_axis_of_time_and_says_when_nothing_was_measured(page):
    for _ in range(2):
        page._press("Step")
        do(page)
    assert page.chart.plot.scales["x"]["range"] == (-30.0, 0.0)
    ago, asked, measured = page.chart.plot.data
    assert ago == pytest.approx([-0.05, 0.0]) and measured == pytest.approx(asked)
    assert not page.chart.note.visible
    page.chart.choice.value = "mood"
    wait_for(lambda: "mood: nothing was measured" in page.chart.note.content and page.chart.note.visible)
    assert len(page.chart.plot.data) == 2, "what was asked for only"


def test_what_is_shown_is_measured_or_says_that_it_is_not(page):
    page.widgets["target"].handle.value = 0.5
    do(page)
    texts = {name: text.handle.content for name, text in page.measured.items()}
    assert texts["target"] == "not measured yet · trained -0.8 to 0.8 m"
    page._press("Step")
    do(page)
    texts = {name: text.handle.content for name, text in page.measured.items()}
    assert texts["target"] == "measured **0.5 m** in 0.1 s · trained -0.8 to 0.8 m"
    assert texts["mood"] == "no measure of its own"
    assert "pace **0.5 m/step**" in page.others.content, "the domain declares the unit"
    do(page, lambda session: session.set(target=-0.5))
    assert "not measured yet" in page.measured["target"].handle.content, "0.5 m belongs to the request before"


def test_the_measure_without_a_name_comes_first(page):
    text = page.measured["target"]
    text.update(report(measured={"target": 0.5, "pace": 0.25}), ["pace", "target"])
    assert text.handle.content.startswith("measured **0.5 m**, pace **0.25 m/step** in 2.0 s")


def test_texts_of_a_weights_file_are_no_markup(server):
    """viser renders HTML in Markdown, scripts included."""
    space = StyleSpace([Setpoint("target", -0.8, 0.8, unit="<img src=x onerror=alert(1)>")])
    text = MeasuredText(server, space["target"], ECHO, space)
    shown = [text.handle.content]
    text.update(report(outside={"target": 2.0}), ["target"])
    shown += [text.handle.content, listed(ECHO, space, {"target": 0.5})]
    assert [content.count(r"\<img src=x onerror=alert(1)\>") for content in shown] == [1, 4, 1]
    assert not any(re.search(r"(?<!\\)[<>]", content) for content in shown)


def report(**changes):
    """Of a request that was met, with changes."""
    values = {
        "requested": {"target": 0.5},
        "measured": {"target": 0.5},
        "unmeasured": (),
        "seconds": 2.0,
        "outside": {},
        "asks": True,
        "complying": 1.0,
        "needs": "a footstep",
        "complied_after": 0.5,
        "since_request": 9.0,
        "episode": 1,
        "episode_time": 9.0,
        "ended": None,
        "endings": {},
    }
    return StyleReport(**values | changes)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, "**Request met**, first after 0.5 s: 100% of what was judged in the last 2.0 s."),
        ({"complying": 0.25}, "Request met first after 0.5 s, but only 25% of what was judged in the last 2.0 s."),
        ({"complying": None}, "Request met first after 0.5 s; nothing to judge in the last 2.0 s."),
        ({"complying": 0.0, "complied_after": None}, "Request not yet met, after 9.0 s."),
        (
            {"complying": None, "complied_after": None},
            "Request not judged yet, after 9.0 s: that takes a footstep.",
        ),
        ({"asks": False, "complied_after": None}, "Nothing is asked for: every weight is 0."),
    ],
)
def test_the_verdict_says_what_it_rests_on(changes, text):
    assert verdict(report(**changes)) == text


def test_outside_the_trained_range_is_flagged(page):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        say(page, "target 2 m")
    assert page.widgets["target"].handle.value == pytest.approx(0.8)
    assert "**Outside the trained range:** 2 m was asked for, 0.8 m is used" in page.measured["target"].handle.content
    page.widgets["target"].handle.value = 0.1
    do(page)
    assert "Outside" not in page.measured["target"].handle.content


def test_a_failing_view_leaves_the_read_outs(page, monkeypatch):
    def torn(share):
        raise RuntimeError("the canvas is torn")

    do(page)
    monkeypatch.setattr(page._view, "update", torn)
    page._press("Resume")
    wait_for(lambda: "the canvas is torn" in page.status.content)
    count = page.session.step_count
    wait_for(lambda: page.session.step_count > count)


def test_a_weight_and_what_it_brings_about_have_an_axis_each(page):
    page._press("Step")
    do(page)
    assert page.chart.choice.value == "target" and len(page.chart.plot.axes) == 2
    page.chart.choice.value = "fire"
    wait_for(lambda: len(page.chart.plot.axes) == 3)
    assert page.chart.plot.series[2]["label"] == "measured (right)"
    page.chart.choice.value = "target"
    wait_for(lambda: len(page.chart.plot.axes) == 2)


def test_measures_that_the_domain_does_not_publish_are_folded(page):
    page._press("Step")
    do(page)
    assert "pace" in page.others.content and "task reward" not in page.others.content
    assert page.further.content.startswith("also measured: task reward **")


def test_the_axis_of_the_request_shows_the_trained_range_and_what_was_measured(page):
    do(page, lambda session: session.set(target=0.0))
    page._press("Step")
    do(page)
    target = page.session.space["target"]
    assert page.chart.plot.scales["y"]["range"] == pytest.approx((1.2 * target.low, 1.2 * target.high))
    page.chart.choice.value = "fire"
    wait_for(lambda: len(page.chart.plot.axes) == 3)
    assert page.chart.plot.scales["y"]["range"] == (-0.75, 2.25) and page.chart.plot.scales["right"]["range"] == (0, 1)


def test_the_ends_of_an_axis_move_in_fifths_of_the_range():
    number = Setpoint("length", 1.0, 2.0)
    assert _ends(number, [np.array([1.4, 1.5]), np.array([1.45, 1.6])]) == pytest.approx((0.9, 2.1))
    assert _ends(number, [np.array([1.5]), np.array([0.7])]) == pytest.approx((0.6, 2.1))
    assert _ends(number, [np.array([1.5]), np.array([2.01])]) == pytest.approx((0.9, 2.2))
    assert _ends(Choice("mood", ["calm", "wild"]), [np.array([1.0])]) == pytest.approx((-0.1, 1.1))


def test_the_page_for_keys_has_the_shared_look():
    text = pad_page()
    assert stylesheet() in text and icon_link() in text and "LOOK" not in text
