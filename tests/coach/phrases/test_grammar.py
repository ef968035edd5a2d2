"""Phrases: a table of what each means, and the share of thirty-six requests that is understood."""

import re
from functools import cache

import pytest

from coachable.coach.phrases import segments
from coachable.coach.phrases.grammar import MAX_PHRASE, StyleGrammar, fitting
from coachable.coach.phrases.vocabulary import tokenise
from coachable.domain import load_domain
from coachable.domains.humanoid import humanoid_style_space
from coachable.styles import Choice, Setpoint, Weight
from coachable.training.weights import domain_of, load_policy
from tests.coach.phrases.requests import REQUESTS

NOW = {"pose": "arms_in_front", "step_length": 0.475, "course": 0.0}


@pytest.fixture(scope="module")
def grammar():
    domain = load_domain("humanoid")
    parameters = [*humanoid_style_space().parameters, *(control.parameter for control in domain.controls)]
    return StyleGrammar(parameters, domain.words.vocabulary, domain.words.examples)


# Steps of the range 0.35 m: a bit 0.035, plain 0.07, much 0.14.
UNDERSTOOD = [
    ("T-pose", {"pose": "t_pose"}),
    ("t_pose", {"pose": "t_pose"}),
    ("raise your arms", {"pose": "arms_up"}),
    ("hands over your head", {"pose": "arms_up"}),
    ("shorter steps", {"step_length": 0.405}),
    ("a bit longer", {"step_length": 0.51}),
    ("much shorter steps", {"step_length": 0.335}),
    ("shorter steps, just a bit", {"step_length": 0.44}),
    ("steps, shorter", {"step_length": 0.405}),
    ("your steps are too long", {"step_length": 0.405}),
    ("not so long", {"step_length": 0.44}),
    ("baby steps", {"step_length": 0.30}),
    ("as long as possible", {"step_length": 0.65}),
    ("short steps", {"step_length": 0.3525}),
    ("0.4 m", {"step_length": 0.4}),
    ("0,4m", {"step_length": 0.4}),
    (".4", {"step_length": 0.4}),
    ("40 cm", {"step_length": 0.4}),
    ("half a metre", {"step_length": 0.5}),
    ("1/2 metre", {"step_length": 0.5}),
    ("one and a half feet", {"step_length": 0.4572}),
    ("steps of forty five centimetres", {"step_length": 0.45}),
    ("reduce the step length to 0.4", {"step_length": 0.4}),
    ("reduce the step length by 0.1", {"step_length": 0.375}),
    ("5 cm longer", {"step_length": 0.525}),
    ("+5 cm", {"step_length": 0.525}),
    ("10 % longer steps", {"step_length": 0.5225}),
    ("half as long", {"step_length": 0.2375}),
    ("shorter steps, arms up", {"step_length": 0.405, "pose": "arms_up"}),
    ("longest steps arms up", {"step_length": 0.65, "pose": "arms_up"}),
    ("short steps but raise your arms", {"step_length": 0.3525, "pose": "arms_up"}),
    ("keep the arms, shorter steps", {"step_length": 0.405}),
    ("arms up instead of in front", {"pose": "arms_up"}),
    ("turn left", {"course": 45.0}),
    ("turn right by 90 degrees", {"course": -90.0}),
]

UNCHANGED = ["not a T-pose", "don't raise your arms", "no longer steps", "keep the steps", "normal steps", "in front"]

NOT_UNDERSTOOD = [
    ("sing", "unknown: sing"),
    ("jump higher", "unknown: jump"),
    ("don't wave", "unknown: wave"),
    ("walk faster", "nothing here has a speed"),
    ("0.4 kg", "unknown: kg"),
    ("0.5 yards longer", "unknown: yards"),
    ("0.4 s", "nothing here has a time"),
    ("step length 20 degrees", "step length is not an angle, it is in m"),
    ("steps", "how much"),
    ("not arms in front", "say what instead: arms up or t pose"),
    ("change your arms", "pose can be arms in front or arms up or t pose"),
    ("not 0.4 m", "say what instead"),
    ("don't reset", "say what instead"),
    ("not normal", "say what instead"),
    ("don't reset the arms", "pose can be arms in front or arms up or t pose"),
    ("", "an empty phrase"),
    ("?!", "'?!'"),
    ("step length " + "9" * 400, "how much"),
]


@pytest.mark.parametrize(("phrase", "changes"), UNDERSTOOD)
def test_phrases_that_are_understood(grammar, phrase, changes):
    understood = grammar.read(phrase, NOW)
    assert understood.changes == {n: v if isinstance(v, str) else pytest.approx(v) for n, v in changes.items()}
    assert not understood.failed
    assert all(name.replace("_", " ") in str(understood) for name in changes)


@pytest.mark.parametrize("phrase", UNCHANGED)
def test_requests_that_are_met_already(grammar, phrase):
    understood = grammar.read(phrase, NOW)
    assert not understood.changes and not understood.failed
    assert "stays" in str(understood)


@pytest.mark.parametrize(("phrase", "reason"), NOT_UNDERSTOOD)
def test_phrases_that_are_not_understood_say_so(grammar, phrase, reason):
    understood = grammar.read(phrase, NOW)
    assert not understood.changes
    assert f"not understood: {understood.failed[0]}" in str(understood)
    assert ("try: shorter steps, arms up, 0.4 m" in str(understood)) == bool(understood.examples)
    assert reason in understood.failed[0]


def test_what_is_not_understood_beside_what_is(grammar):
    understood = grammar.read("arms up, whistle, and 0.5 m", NOW)
    assert understood.changes == {"pose": "arms_up", "step_length": 0.5}
    assert understood.failed == ("'whistle' (unknown: whistle)",)


def test_a_bit_more_goes_on_in_the_same_direction(grammar):
    first = grammar.read("shorter steps", NOW)
    style = NOW | first.changes
    assert grammar.read("a bit more", style, first).changes == {"step_length": pytest.approx(0.37)}
    assert grammar.read("again", style, first).changes == {"step_length": pytest.approx(0.335)}
    assert grammar.read("a bit less", style, first).changes == {"step_length": pytest.approx(0.44)}
    turned = grammar.read("turn right", NOW)
    assert grammar.read("a bit more", NOW | turned.changes, turned).changes == {"course": -60.0}


def test_directions_go_round(grammar):
    turned = grammar.read("turn left", NOW | {"course": 170.0})
    assert turned.changes == {"course": -145.0}
    assert "outside" not in str(turned)
    assert grammar.read("a bit more", NOW | {"course": -145.0}, turned).changes == {"course": -130.0}


def test_changes_stop_at_the_end_of_the_range_and_numbers_are_flagged(grammar):
    lowest = NOW | {"step_length": 0.3}
    assert "already at its lowest" in str(grammar.read("shorter", lowest))
    assert grammar.read("much shorter", NOW | {"step_length": 0.35}).changes == {"step_length": pytest.approx(0.3)}
    beyond = grammar.read("step length 0.9", NOW)
    assert beyond.changes == {"step_length": 0.9}
    assert "outside the trained range 0.3 to 0.65 m" in str(beyond)


def test_both_and_all_change_every_parameter_that_fits():
    gaps = [Setpoint("ahead", 0.0, 2.0, unit="m"), Setpoint("beside", 0.0, 1.0, unit="m")]
    grammar = StyleGrammar([*gaps, Weight("fuel", 0.0, 1.0)])
    now = {"ahead": 1.0, "beside": 0.25, "fuel": 0.5}
    first = grammar.read("ahead 1.5 m", now)
    assert grammar.read("both 0.5 m", now, first).changes == {"ahead": 0.5, "beside": 0.5}
    assert grammar.read("all higher", now, first).changes == {"ahead": 1.4, "beside": 0.45, "fuel": 0.7}


def test_a_parameter_that_is_called_a_speed_is_one_whatever_its_unit():
    grammar = StyleGrammar([Setpoint("speed", 0.0, 0.05, unit="m/step", default=0.02)])
    assert grammar.read("faster", {"speed": 0.02}).changes == {"speed": pytest.approx(0.03)}
    assert grammar.read("0.02 m/step", {"speed": 0.03}).changes == {"speed": 0.02}


@pytest.mark.parametrize(
    "unit", ["rad/s", "deg/s", "°/s", "N m", "N·m", "W/kg", "Hz", "rpm", "1/s", "m/s²", "A", "bar"]
)
def test_a_number_may_have_the_unit_of_its_parameter_whatever_that_is(unit):
    grammar = StyleGrammar([Setpoint("spin", -3.0, 3.0, unit=unit), Weight("thrift", 0.0, 2.0)])
    now = {"spin": 0.0, "thrift": 0.0}
    for phrase in (f"spin 2 {unit}", f"2{unit.lower()}", f"2 {unit} more spin"):
        read = grammar.read(phrase, now)
        assert read.changes == {"spin": 2.0} and not read.failed, phrase
    assert grammar.read(f"spin 2 {unit}, thrift max", now).changes == {"spin": 2.0, "thrift": 2.0}
    assert grammar.read(f"thrift 1 {unit}", now).failed == ("'thrift 1' (thrift has no unit)",)


def test_the_unit_tells_which_parameter_is_meant():
    grammar = StyleGrammar([Setpoint("spin", -3.0, 3.0, unit="rad/s"), Setpoint("lift", -3.0, 3.0, unit="N m")])
    now = {"spin": 0.0, "lift": 0.0}
    assert grammar.read("1 N m", now).changes == {"lift": 1.0}
    assert grammar.read("lift 2 rad/s", now).failed == ("'lift 2' (lift is in N m)",)
    assert grammar.read("spin 1 rad", now).failed == ("'spin 1 rad' (spin is not an angle, it is in rad/s)",)


def test_back_to_normal_means_everything(grammar):
    understood = grammar.read("back to normal", {"pose": "t_pose", "step_length": 0.6, "course": 90.0})
    assert understood.changes == {"pose": "arms_in_front", "step_length": 0.475, "course": 0.0}


@pytest.mark.parametrize(
    ("phrase", "changes"), [("longer than usual", {"step_length": 0.62}), ("reset to 0.4 m", {"step_length": 0.4})]
)
def test_words_for_normal_beside_another_request_reset_nothing_else(grammar, phrase, changes):
    understood = grammar.read(phrase, {"pose": "t_pose", "step_length": 0.55, "course": 90.0})
    assert understood.changes == {name: pytest.approx(value) for name, value in changes.items()}


def test_weights_are_encouraged_and_discouraged():
    grammar = StyleGrammar(
        [
            Weight("melee", -0.5, 2.0, help="prefer the spear"),
            Weight("fire", 0.0, 1.0, help="prefer burning arrows"),
            Weight("frost", 0.0, 1.0, help="prefer freezing arrows"),
            Setpoint("speed", 0.0, 50.0, unit="m/s"),
            Choice("side", ("left", "right")),
        ]
    )
    now = {"melee": 0.0, "fire": 0.0, "frost": 0.0, "speed": 10.0, "side": "left"}
    for phrase, changes in [
        ("melee", {"melee": 2.0}),
        ("use the spear", {"melee": 2.0}),
        ("avoid melee", {"melee": -0.5}),
        ("more melee", {"melee": 0.5}),
        ("a bit of fire", {"fire": 0.25}),
        ("more melee less speed", {"melee": 0.5, "speed": 0.0}),
        ("much more melee and no fire", {"melee": 1.0}),
        ("freezing arrows", {"frost": 1.0}),
        ("faster", {"speed": 20.0}),
        ("90 km/h", {"speed": 25.0}),
        ("side right", {"side": "right"}),
    ]:
        assert grammar.read(phrase, now).changes == pytest.approx(changes), phrase
    assert grammar.read("not left", now).changes == {"side": "right"}
    assert "of what: melee or fire or frost or speed?" in grammar.read("more", now).failed[0]


def test_options_that_are_common_words_need_their_parameter():
    gap, now = Setpoint("gap", 0.0, 5.0, unit="m"), {"gap": 2.5, "mode": "b", "lights": "off", "gear": "3"}
    choices = [Choice("mode", ("a", "b")), Choice("lights", ("off", "on")), Choice("gear", ("1", "2", "3"))]
    grammar = StyleGrammar([gap, *choices])
    for phrase, changes in [
        ("gap 2 m", {"gap": 2.0}),
        ("a wider gap", {"gap": 3.5}),
        ("gear 2", {"gear": "2"}),
        ("lights on", {"lights": "on"}),
        ("mode a", {"mode": "a"}),
    ]:
        assert grammar.read(phrase, now).changes == pytest.approx(changes), phrase


class CountingLexicon(dict):
    """Counts what is looked up in it."""

    looked_up = 0

    def __contains__(self, words):
        self.looked_up += 1
        return super().__contains__(words)


@pytest.mark.parametrize("piece", ["shorter steps ", "a ", "arms ", "x ", "not ", ", ", "0.4 m ", "steps much more "])
def test_the_work_grows_with_the_length_of_the_phrase(grammar, piece):
    lexicon = CountingLexicon(grammar.lexicon)
    longest = max(map(len, lexicon))
    for repeats in (10, MAX_PHRASE // len(piece)):
        tokens = tokenise(piece * repeats)
        lexicon.looked_up = 0
        segments.split(tokens, lexicon)
        assert lexicon.looked_up <= longest * len(tokens)


def test_a_phrase_that_is_too_long_is_refused_in_a_sentence(grammar):
    longest = "arms up," + "a" * (MAX_PHRASE - 8)
    assert grammar.read(longest, NOW).changes == {"pose": "arms_up"}
    refused = grammar.read(longest + "a", NOW)
    assert refused.changes == {}
    assert refused.failed == ("the phrase has 2,001 characters, at most 2,000 are read",)


def test_an_unknown_word_is_answered_with_what_works_without_examples():
    grammar = StyleGrammar([Weight("melee", 0.0, 1.0), Choice("side", ("left", "right_hand"))])
    answer = str(grammar.read("sing", {"melee": 0.0, "side": "left"}))
    assert answer == "not understood: 'sing' (unknown: sing); try: more melee, right hand"


def test_the_vocabulary_is_checked():
    with pytest.raises(ValueError, match="words for 'poses': expected one of"):
        StyleGrammar(humanoid_style_space(), {"poses": ("arms",)})
    with pytest.raises(ValueError, match=r"'pose=down': options are"):
        StyleGrammar(humanoid_style_space(), {"pose=down": ("arms down",)})
    with pytest.raises(ValueError, match="words for 'stride': expected one of"):
        StyleGrammar(humanoid_style_space(), {"-step_length -stride": ("arms down",)})
    for meaning in ("+gap -speed", "gap -speed", "-gap +speed"):
        with pytest.raises(ValueError, match=re.escape(f"words for {meaning!r}: expected the same sign")):
            StyleGrammar([Setpoint("gap", 0.0, 2.0), Setpoint("speed", 0.0, 2.0)], {meaning: ("patient",)})


def test_tokens():
    assert tokenise("Don\u2019t go 0.4m/s, twenty five cm!") == ["do", "not", "go", "0.4", "m/s", ",", "25", "cm", "!"]
    for number, read in {
        "1,000": "1000",
        "1,234,567.5": "1234567.5",
        "0,400": "0.400",
        "1,5": "1.5",
        "1,0000": "1.0000",
    }.items():
        assert tokenise(f"{number} mm") == [read, "mm"]


def meets(value, wanted) -> bool:
    if wanted in ("shorter", "longer"):
        return value is not None and (value < 0.475) == (wanted == "shorter") and value != 0.475
    return value == (wanted if wanted is None else pytest.approx(wanted))


def test_most_of_36_requests_are_understood_and_none_wrongly(grammar):
    assert len(REQUESTS) == 36
    right = {"pose": 0, "gait": 0, "both": 0}
    for phrase, pose, gait in REQUESTS:
        start = NOW | {"pose": "t_pose" if pose == "arms_up" else "arms_up"}
        changes = grammar.read(phrase, start).changes
        posed, walked = changes.get("pose") == pose, meets(changes.get("step_length"), gait)
        right["pose"] += posed and pose is not None
        right["gait"] += walked and gait is not None
        right["both"] += posed and walked and pose is not None and gait is not None
        assert posed or "pose" not in changes, phrase
        assert walked or "step_length" not in changes, phrase
        assert "course" not in changes, phrase
    assert right == {"pose": 23, "gait": 21, "both": 13}  # of 28, 24 and 16


FIGHT = {"acid": 0.3, "fire": 0.3}
SAVING = {"fuel": 20.0, "tire": 3000.0}
OF_AGENTS = [
    # agent, style in force beside the default, phrase, changes
    ("combat_full", FIGHT, "no traps, fire or acid", {"traps": -0.0075, "fire": -0.045, "acid": -0.03}),
    ("combat_full", FIGHT, "stop using traps and melee", {"traps": -0.0075, "melee": -0.055}),
    ("combat_full", FIGHT, "no traps, fire", {"traps": -0.0075, "fire": 0.9}),
    ("combat_full", FIGHT, "no traps but melee", {"traps": -0.0075, "melee": 1.1}),
    ("combat_full", FIGHT, "no traps, use melee", {"traps": -0.0075, "melee": 1.1}),
    ("combat_full", FIGHT, "use fire and acid", {"fire": 0.9, "acid": 0.6}),
    ("combat_full", FIGHT, "a bit of fire and acid", {"fire": 0.225, "acid": 0.15}),
    ("combat_full", FIGHT, "prefer acid to fire", {"acid": 0.6, "fire": -0.045}),
    ("combat_full", FIGHT, "more fire than acid", {"fire": 0.489}),
    ("combat_full", FIGHT, "everything but fire", {"fire": -0.045}),
    ("combat_full", FIGHT, "no more melee", {"melee": -0.055}),
    ("combat_full", FIGHT, "slow it down", {"adhesive": 0.9}),
    ("combat_full", FIGHT, "cut off the weapon", {"part_weapon": 1.0}),
    ("racing_resources", SAVING, "don't save fuel and tyres", {"fuel": 0.0, "tire": 0.0}),
    ("racing_resources", SAVING, "waste fuel and tyres", {"fuel": 0.0, "tire": 0.0}),
    ("racing_resources", SAVING, "use less fuel and tyres", {"fuel": 41.6, "tire": 5412.0}),
    ("racing_resources", SAVING, "you use too much fuel", {"fuel": 63.2}),
    ("racing_resources", SAVING, "use half the fuel", {"fuel": 40.0}),
    ("racing_resources", SAVING, "overtake without using fuel", {"overtake": 2.0, "fuel": 105.0}),
    ("racing_resources", SAVING, "tyres wear too fast", {"tire": 5412.0}),
    ("racing_resources", {"defend": 1.0}, "let him pass", {"defend": 0.0}),
    ("racing_drift", {}, "no drift or wheelspin", {"slip_angle_rear": -0.4, "slip_ratio_rear": -0.4}),
    ("racing_aggressiveness", {}, "calm down", {"longitudinal": 1.7, "lateral": 0.85}),
    ("racing_aggressiveness", {}, "as aggressive as possible", {"longitudinal": 0.0, "lateral": 0.0}),
    ("racing_aggressiveness", {}, "a little aggressive", {"longitudinal": 0.65, "lateral": 0.325}),
    ("humanoid", {"course": 60.0}, "turn 20 degrees to the right", {"course": 40.0}),
    ("humanoid", {}, "less short steps", {"step_length": 0.545}),
    ("humanoid", {}, "increase the step length by half", {"step_length": 0.7125}),
    ("humanoid", {}, "up the step length", {"step_length": 0.545}),
    ("humanoid", {}, "steps a little shorter", {"step_length": 0.44}),
    ("humanoid_gait", {"speed": 0.9}, "slow down a little", {"speed": 0.725}),
    ("humanoid_gait", {"speed": 0.9}, "slow down by 10%", {"speed": 0.81}),
    ("humanoid_gait", {"speed": 0.9}, "slow down by 0.2 m/s", {"speed": 0.7}),
    ("humanoid_gait", {"speed": 0.9}, "slow down to 0.6 m/s", {"speed": 0.6}),
    ("humanoid_gait", {"speed": 0.9}, "don't slow down", {}),
]
REFUSED = [
    ("combat_full", "melee off", "unknown: off"),
    ("combat_full", "use your weapon", "weapon"),
    ("racing_resources", "fuel max", "save fuel, or use it?"),
    ("racing_drift", "less grip", "say how much instead"),
    ("racing_aggressiveness", "aggressiveness 0", "on which scale? longitudinal goes from 0 to 2 m"),
    ("humanoid", "faster steps", "step length is not a speed, it is in m"),
    ("humanoid", "turn slower", "course is not a speed, it is in deg"),
    ("humanoid", "short fast steps", "step length is not a speed, it is in m"),
    ("humanoid", "walk forward", "unknown: forward"),
    ("humanoid", "fewer baby steps", "say how much instead"),
]


@cache
def grammar_of(name):
    agent = load_policy(name)
    domain = domain_of(agent)
    parameters = [*agent.space.parameters, *(control.parameter for control in domain.controls)]
    words = fitting(domain.words, parameters)
    return StyleGrammar(parameters, words.vocabulary), {p.name: p.default for p in parameters}


@pytest.mark.parametrize(("name", "now", "phrase", "changes"), OF_AGENTS, ids=[row[2] for row in OF_AGENTS])
def test_phrases_about_the_shipped_agents(name, now, phrase, changes):
    grammar, defaults = grammar_of(name)
    understood = grammar.read(phrase, {**defaults, **now})
    assert understood.changes == pytest.approx(changes) and not understood.failed


@pytest.mark.parametrize(("name", "phrase", "reason"), REFUSED, ids=[row[1] for row in REFUSED])
def test_phrases_about_the_shipped_agents_that_are_not_guessed_at(name, phrase, reason):
    grammar, defaults = grammar_of(name)
    assert reason in str(grammar.read(phrase, defaults))
    assert grammar.read(phrase, defaults).failed
