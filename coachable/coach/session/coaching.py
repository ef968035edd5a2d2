"""What a domain adds to live coaching beyond its `Domain`: live controls, words, presets."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from torchrl.envs import EnvBase

from coachable.coach.phrases.grammar import read_meaning
from coachable.styles import Choice, Setpoint, StyleSpace


@dataclass(frozen=True)
class Control:
    """Something that is steered while the agent acts and is no style: the policy sees it in its observation.

    Attributes:
        parameter: name, range, unit and neutral value.
        apply: writes a value into the base environment.
        circular: values beyond one end go on at the other, such as angles.
    """

    parameter: Setpoint
    apply: Callable[[EnvBase, float], None]
    circular: bool = False

    def fit(self, value: float) -> float:
        """The value brought into the control's range.

        Raises:
            ValueError: if it is no finite number.
        """
        low, high = self.parameter.low, self.parameter.high
        if not math.isfinite(value):
            raise ValueError(f"{self.parameter.name} = {value}: expected a number in [{low:g}, {high:g}].")
        if self.circular and not low <= value <= high:
            return low + (value - low) % (high - low)
        return min(max(value, low), high)


@dataclass(frozen=True)
class Coaching:
    """A domain's additions.

    Attributes:
        controls: live controls, such as the humanoid's course.
        vocabulary: further words of the phrase box; see `StyleGrammar`.
        presets: named styles.
        examples: phrases that the phrase box suggests.
        terminated: what a terminated episode means here, in the past tense.
    """

    controls: Sequence[Control] = ()
    vocabulary: Mapping[str, Sequence[str]] = field(default_factory=dict)
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    examples: Sequence[str] = ()
    terminated: str = "ended"

    def fitting(self, space: StyleSpace) -> Coaching:
        """Without words and presets for what a style space lacks: an agent may have been trained on a smaller one."""
        options = {p.name: p.options for p in space.parameters if isinstance(p, Choice)}
        names = {*space.names, *(control.parameter.name for control in self.controls)}

        def known(name: str, value: Any) -> bool:
            return name in names and (name not in options or value in ("", *options[name]))

        def means(meaning: str) -> bool:
            named, _, value = read_meaning(meaning)
            return all(known(name, value) for name in named)

        vocabulary = {meaning: words for meaning, words in self.vocabulary.items() if means(meaning)}
        presets = {name: style for name, style in self.presets.items() if all(known(*item) for item in style.items())}
        return replace(self, vocabulary=vocabulary, presets=presets)


def _steer(env: EnvBase, course_deg: float) -> None:
    env.steer(math.radians(course_deg))  # pyright: ignore[reportCallIssue]


_COACHING = {
    "humanoid": Coaching(
        controls=(
            Control(
                Setpoint("course", -180.0, 180.0, unit="deg", help="direction of walking, left is positive"),
                _steer,
                circular=True,
            ),
        ),
        vocabulary={
            "pose": ("arm", "hand", "posture", "elbow"),
            "pose=arms_up": (
                *("up", "arms raised", "raise arms", "raise both arms", "lift arms", "hands up", "hands high"),
                *(
                    "overhead",
                    "above head",
                    "over head",
                    "reach up",
                    "arms high",
                    "arms in the air",
                    "hands in the air",
                ),
            ),
            "pose=arms_in_front": ("forward", "front", "in front", "ahead", "zombie", "sleepwalker"),
            "pose=t_pose": ("t shape", "t", "sideway", "to side", "out to side", "spread", "aeroplane", "airplane"),
            "step_length": ("step", "stride", "gait", "pace"),
            "step_length=low": ("baby step", "shuffle", "tiptoe"),
            "step_length=high": ("leap", "stretch your legs"),
            "course": ("turn", "heading", "veer", "steer"),
        },
        presets={
            "tightrope": {"pose": "t_pose", "step_length": 0.30},
            "sleepwalker": {"pose": "arms_in_front", "step_length": 0.40},
            "victory lap": {"pose": "arms_up", "step_length": 0.60},
        },
        examples=("shorter steps", "arms up", "0.4 m"),
        terminated="fell",
    ),
    "combat": Coaching(
        vocabulary={
            "melee": ("spear", "close combat", "hand to hand"),
            "traps": ("tripwire", "ambush"),
            "part_weapon": ("break weapon", "destroy weapon", "tear off weapon", "disarm"),
            "part_canister": ("break canister", "destroy canister", "tear off canister"),
            "part_shield": ("break shield", "destroy shield", "tear off shield", "armour", "armor"),
            "acid": ("corrode", "corrosion"),
            "purgewater": ("drench", "water"),
            "frost": ("freeze", "ice"),
            "shock": ("stun", "electrify"),
            "fire": ("burn", "ignite", "set on fire"),
            "adhesive": ("glue", "slow it", "slow down"),
            "carjas_bane sunscourge": ("bow",),
        },
        presets={
            "spear fighter": {"melee": 1.1},
            "archer": {"sunscourge": 1.6, "carjas_bane": 1.0},
            "trapper": {"traps": 0.15},
            "arsonist": {"fire": 0.9},
            "scavenger": {"part_weapon": 1.0, "part_canister": 1.0, "part_shield": 1.0},
        },
        examples=("use acid", "no traps", "more melee", "use the warrior bow"),
        terminated="ended the fight",
    ),
    "racing_drift": Coaching(
        vocabulary={
            "slip_angle_rear": ("drift", "drifting", "slide", "sliding", "sideway", "oversteer"),
            "slip_angle_rear=low": ("grip", "grippy", "tidy"),
            "slip_angle_front": ("understeer", "plough"),
            "slip_ratio_rear": ("wheelspin", "burnout", "spin wheel", "spin the rear wheel"),
            "slip_ratio_front": ("lock wheel", "lock the front wheel"),
        },
        presets={
            "drift": {"slip_angle_rear": 5.0, "slip_ratio_rear": 5.0},
            "donuts": {
                "slip_angle_front": 5.0,
                "slip_angle_rear": 5.0,
                "slip_ratio_front": 5.0,
                "slip_ratio_rear": 5.0,
            },
            "grip": {"slip_angle_front": -0.4, "slip_angle_rear": -0.4},
        },
        examples=("drift more", "no wheelspin", "grip"),
        terminated="retired",
    ),
    "racing_resources": Coaching(
        vocabulary={
            "tire": ("tyre", "rubber"),
            "fuel": ("petrol", "gas"),
            "+tire +fuel": (
                *("save", "saving", "spare", "sparing", "nurse", "protect", "preserve", "conserve", "look after"),
                *("economical", "economically", "economise", "save everything"),
            ),
            "-tire -fuel": ("consumption", "use of"),
            "+fuel": ("lift and coast",),
            "-fuel": ("use fuel", "fuel use", "use petrol", "use gas"),
            "-tire": ("use tyre", "tyre use", "wear", "tyre wear"),
            "tire=0": ("burn tyre", "waste tyre", "ignore tyre", "never mind tyre"),
            "fuel=0": ("burn fuel", "waste fuel", "ignore fuel", "never mind fuel"),
            "tire fuel=0": ("flat out", "push"),
            "": ("burn", "burning", "consume", "consuming", "spend", "spending", "wear out"),
            "overtake": ("attack", "pass"),
            "defend": ("block",),
        },
        presets={
            "flat out": {"tire": 0.0, "fuel": 0.0},
            "save tyres": {"tire": 12000.0},
            "save fuel": {"fuel": 105.0},
            "attack": {"overtake": 2.0, "tire": 0.0, "fuel": 0.0},
        },
        examples=("save fuel", "save more tyres", "overtake more"),
        terminated="retired",
    ),
    "racing_aggressiveness": Coaching(
        vocabulary={
            "longitudinal": ("following distance", "distance behind", "distance ahead"),
            "lateral": ("distance beside", "distance at side", "elbow room", "side", "sideway"),
            "longitudinal lateral": ("margin", "distance", "gap", "room", "space", "clearance"),
            "-longitudinal -lateral": (
                *("aggressive", "aggressively", "aggressiveness", "aggression", "bold", "boldly", "attack", "reckless"),
                *("pushy", "risky", "risk", "daring"),
            ),
            "+longitudinal +lateral": (
                *("careful", "carefully", "cautious", "cautiously", "caution", "defensive", "defensively", "polite"),
                *("timid", "safe", "safely", "calm", "patient", "gentle", "keep distance", "give room", "leave room"),
            ),
        },
        presets={
            "door to door": {"longitudinal": 0.0, "lateral": 0.0},
            "room to breathe": {"longitudinal": 2.0, "lateral": 1.0},
        },
        examples=("be aggressive", "give more room", "0.3 m beside"),
        terminated="retired",
    ),
}


def coaching_of(domain: str) -> Coaching:
    """The additions of a domain; none for one that declares none."""
    return _COACHING.get(domain, Coaching())
