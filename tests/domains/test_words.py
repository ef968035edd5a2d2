"""The additions of each domain: they fit its styles, and its words mean what they seem to mean."""

import pytest

from coachable.coach.phrases.grammar import StyleGrammar, fitting
from coachable.domain import load_domain
from coachable.domains.combat.styles import combat_style_space
from coachable.domains.humanoid import gait_style_space, humanoid_style_space
from coachable.domains.racing.styles import aggressiveness_style_space, drift_style_space, resource_style_space

SPACES = {
    "humanoid": humanoid_style_space,
    "humanoid_gait": gait_style_space,
    "combat": combat_style_space,
    "racing_drift": drift_style_space,
    "racing_resources": resource_style_space,
    "racing_aggressiveness": aggressiveness_style_space,
}


@pytest.mark.parametrize("domain", SPACES)
def test_words_and_presets_fit_the_styles(domain):
    space, declared = SPACES[domain](), load_domain(domain)
    parameters = [*space.parameters, *(control.parameter for control in declared.controls)]
    assert fitting(declared.words, parameters) == declared.words, "nothing is left out"
    for preset in declared.words.presets.values():
        space.make(strict=True, **preset)


def grammar_of(domain):
    declared = load_domain(domain)
    parameters = [*SPACES[domain]().parameters, *(control.parameter for control in declared.controls)]
    now = {parameter.name: parameter.default for parameter in parameters}
    return StyleGrammar(parameters, declared.words.vocabulary, declared.words.examples), now


# By default longitudinal is 1 m of 0 to 2 m, lateral 0.5 m of 0 to 1 m, and weights are 0.
@pytest.mark.parametrize(
    ("domain", "phrase", "changes"),
    [
        ("humanoid_gait", "walk faster", {"speed": 1.1}),
        ("humanoid_gait", "walk slower", {"speed": 0.7}),
        ("humanoid_gait", "walk much slower", {"speed": 0.5}),
        ("humanoid_gait", "a bit faster", {"speed": 1.0}),
        ("humanoid_gait", "slow down", {"speed": 0.55}),
        ("humanoid_gait", "walk fast", {"speed": 1.25}),
        ("humanoid_gait", "0.8 m/s", {"speed": 0.8}),
        ("humanoid_gait", "3.6 km/h", {"speed": 1.0}),
        ("humanoid_gait", "0.4 m", {"step_length": 0.4}),
        ("humanoid_gait", "shorter steps", {"step_length": 0.405}),
        ("humanoid_gait", "longer steps, slower", {"step_length": 0.545, "speed": 0.7}),
        ("humanoid_gait", "faster, arms up", {"speed": 1.1, "pose": "arms_up"}),
        ("humanoid", "shorter steps", {"step_length": 0.405}),
        ("combat", "freeze it", {"frost": 0.6}),
        ("combat", "burn it, but no plasma", {"fire": 0.9, "plasma": -0.03}),
        ("combat", "break its weapon", {"part_weapon": 1.0}),
        ("combat", "use acid", {"acid": 0.6}),
        ("combat", "fight with acid", {"acid": 0.6}),
        ("combat", "use more acid", {"acid": 0.126}),
        ("combat", "don't use acid", {"acid": -0.03}),
        ("combat", "less acid", {"acid": -0.03}),
        ("combat", "too much acid", {"acid": -0.03}),
        ("combat", "use acid too", {"acid": 0.6}),
        ("combat", "use the hunter bow", {"sunscourge": 1.6}),
        ("combat", "use your bow", {"sunscourge": 1.6, "carjas_bane": 1.0}),
        ("combat", "traps instead of melee", {"traps": 0.15, "melee": -0.055}),
        ("combat", "melee no traps", {"traps": -0.0075, "melee": 1.1}),
        ("combat", "prefer traps over melee", {"traps": 0.15, "melee": -0.055}),
        ("combat", "rather the spear than traps", {"traps": -0.0075, "melee": 1.1}),
        ("racing_drift", "rear slip angle 3", {"slip_angle_rear": 3.0}),
        ("racing_drift", "front slip ratio 2", {"slip_ratio_front": 2.0}),
        ("racing_drift", "slip angle 3", {"slip_angle_front": 3.0, "slip_angle_rear": 3.0}),
        ("racing_drift", "go sideways", {"slip_angle_rear": 5.0}),
        ("racing_drift", "no drifting", {"slip_angle_rear": -0.4}),
        ("racing_resources", "save your tyres", {"tire": 12000.0}),
        ("racing_resources", "let them pass", {}),
        ("racing_resources", "burn fuel", {}),
        ("racing_resources", "attack", {"overtake": 2.0}),
        ("racing_resources", "save fuel", {"fuel": 105.0}),
        ("racing_resources", "save fuel and tyres", {"fuel": 105.0, "tire": 12000.0}),
        ("racing_resources", "be economical", {"fuel": 105.0, "tire": 12000.0}),
        ("racing_resources", "save more fuel", {"fuel": 21.6}),
        ("racing_resources", "use less fuel", {"fuel": 21.6}),
        ("racing_resources", "less fuel", {"fuel": 21.6}),
        ("racing_resources", "a bit less fuel consumption", {"fuel": 10.8}),
        ("racing_resources", "save less fuel", {"fuel": -3.0}),
        ("racing_resources", "use more fuel", {"fuel": -3.0}),
        ("racing_resources", "don't save fuel", {}),
        ("racing_resources", "use fuel", {}),
        ("racing_resources", "don't waste fuel", {"fuel": 105.0}),
        ("racing_resources", "save fuel, not tyres", {"fuel": 105.0}),
        ("racing_aggressiveness", "keep 0.8 m distance beside", {"lateral": 0.8}),
        ("racing_aggressiveness", "be aggressive", {"longitudinal": 0.3, "lateral": 0.15}),
        ("racing_aggressiveness", "be very aggressive", {"longitudinal": 0.0, "lateral": 0.0}),
        ("racing_aggressiveness", "be more aggressive", {"longitudinal": 0.6, "lateral": 0.3}),
        ("racing_aggressiveness", "be less aggressive", {"longitudinal": 1.4, "lateral": 0.7}),
        ("racing_aggressiveness", "twice as aggressive", {"longitudinal": 0.5, "lateral": 0.25}),
        ("racing_aggressiveness", "too aggressive", {"longitudinal": 1.4, "lateral": 0.7}),
        ("racing_aggressiveness", "not so aggressive", {"longitudinal": 1.2, "lateral": 0.6}),
        ("racing_aggressiveness", "don't be aggressive", {"longitudinal": 1.7, "lateral": 0.85}),
        ("racing_aggressiveness", "drive carefully", {"longitudinal": 1.7, "lateral": 0.85}),
        ("racing_aggressiveness", "aggressive sideways", {"lateral": 0.15}),
        ("racing_aggressiveness", "give more room", {"longitudinal": 1.4, "lateral": 0.7}),
        ("racing_aggressiveness", "smaller margins", {"longitudinal": 0.6, "lateral": 0.3}),
        ("racing_aggressiveness", "closer", {"longitudinal": 0.6, "lateral": 0.3}),
        ("racing_aggressiveness", "0.4 m", {"longitudinal": 0.4, "lateral": 0.4}),
    ],
)
def test_phrases(domain, phrase, changes):
    grammar, now = grammar_of(domain)
    understood = grammar.read(phrase, now)
    assert understood.changes == pytest.approx(changes)
    assert understood.failed == ()
    assert understood.examples == ()


def test_left_and_right_are_no_more_and_less():
    grammar, now = grammar_of("racing_drift")
    understood = grammar.read("drift to the right", now)
    assert not understood.changes
    assert understood.failed == ("'drift to right' (slip angle rear has no left and right)",)


def test_what_is_taken_back_leaves_no_remainder():
    grammar, now = grammar_of("racing_resources")
    assert grammar.read("burn more fuel", now | {"fuel": 21.600000381469727}).changes == {"fuel": 0.0}


def test_a_bit_more_is_about_both_margins():
    grammar, now = grammar_of("racing_aggressiveness")
    first = grammar.read("be more aggressive", now)
    now |= first.changes
    assert grammar.read("a bit more", now, first).changes == pytest.approx({"longitudinal": 0.4, "lateral": 0.2})
    assert grammar.read("a bit less", now, first).changes == pytest.approx({"longitudinal": 0.8, "lateral": 0.4})


def test_the_answer_says_what_a_weight_or_margin_is_good_for():
    grammar, now = grammar_of("racing_resources")
    assert str(grammar.read("use less fuel", now)) == "fuel 0 → 21.6 (save fuel)"
    grammar, now = grammar_of("racing_aggressiveness")
    assert "longitudinal 1 → 0.3 m (distance to keep ahead and behind)" in str(grammar.read("be aggressive", now))


@pytest.mark.parametrize("domain", SPACES)
def test_the_hint_names_phrases_that_work_in_the_domain(domain):
    grammar, now = grammar_of(domain)
    answer = str(grammar.read("sing", now))
    assert answer.startswith("not understood: 'sing' (unknown: sing); try: ")
    examples = answer.partition("try: ")[2].split(", ")
    assert len(examples) == 3
    for example in examples:
        assert grammar.read(example, now).changes, example


def test_words_and_examples_fit_an_agent_with_fewer_styles():
    space = combat_style_space(("melee", "carjas_bane"))
    words = fitting(load_domain("combat").words, space.parameters)
    grammar = StyleGrammar(space, words.vocabulary, words.examples)
    assert grammar.examples == ("more melee", "use the warrior bow")
    assert grammar.read("use the bow", space.describe(space.default)).changes == {"carjas_bane": 1.0}


def test_everything_at_its_default_is_said_once():
    space = combat_style_space()
    understood = StyleGrammar(space).read("back to normal", space.describe(space.default))
    assert str(understood) == "everything stays at its default"
