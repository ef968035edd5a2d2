"""Every parameter of any declaration can be reached with keys, and numbers with a gamepad."""

import pytest

from coachable.coach.session.bindings import make_bindings
from coachable.domain import load_domain
from coachable.styles import Choice, Setpoint, StyleSpace, Weight


def test_each_key_axis_and_button_is_bound_once():
    space = StyleSpace([Choice("hat", ("red", "blue", "green")), *(Weight(f"w{i}", -1.0, 3.0) for i in range(5))])
    bindings = make_bindings(space)
    assert [b.name for b in bindings] == list(space.names)
    keys = [key for b in bindings for key in b.keys]
    assert len(keys) == 12 == len(set(keys))
    assert [b.axis for b in bindings] == [None, 0, 1, 2, 3, None]
    buttons = [button for b in bindings for button in b.buttons]
    assert len(buttons) == 4 == len(set(buttons)), "of the choice, and of the number without an axis"


@pytest.mark.parametrize("name", ["humanoid", "combat", "racing_resources"])
def test_the_domains_have_keys_for_what_they_declare(name):
    domain = load_domain(name)
    bindings = make_bindings(domain.make_space(), domain.controls)
    assert all(b.keys for b in bindings)
    assert len(bindings) == len(domain.make_space().names) + len(domain.controls)


def test_more_parameters_than_keys():
    bindings = make_bindings(StyleSpace([Weight(f"w{i}", -1.0, 1.0) for i in range(20)]))
    assert (
        [b.keys for b in bindings[17:]] == [("9", "0"), (), ()]
        and bindings[-1].axis is None
        and bindings[-1].buttons == ()
    )


def test_steps_and_positions_stay_within_the_range():
    number, choice = make_bindings(StyleSpace([Setpoint("gap", 1.0, 3.0), Choice("hat", ("red", "blue"))]))
    assert number.stepped(1.0, -1) == 1.0 and number.stepped(2.95, 1) == 3.0
    assert (number.at(-1.0), number.at(0.0), number.at(5.0)) == (1.0, 2.0, 3.0)
    assert (choice.stepped("red", 1), choice.stepped("red", -1), choice.stepped("blue", 1)) == ("blue", "blue", "red")
    with pytest.raises(ValueError, match="hat is a choice and has no range"):
        choice.at(0.0)


def test_a_course_wraps_around():
    course, *_ = make_bindings(load_domain("humanoid").make_space(), load_domain("humanoid").controls)
    assert course.is_control and course.stepped(170.0, 1) == pytest.approx(-154.0)
