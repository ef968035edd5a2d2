"""Words of the coach's commands, by family of styles."""

from coachable.domain import Words

_DRIVING = ("drive", "driving")
_NAMES = {
    "survived": "not retired",
    "pace": "pace along the track",
    "off": "off the track",
    "steering_change": "change of the steering command",
    "place": "mean place",
    "contact": "in contact with another car",
}

WORDS = {
    "drift": Words(
        vocabulary={
            "": _DRIVING,
            "slip_angle_front slip_angle_rear": ("slip angle",),
            "slip_ratio_front slip_ratio_rear": ("slip ratio",),
            "slip_angle_rear": ("rear slip angle", "drift", "drifting", "slide", "sliding", "sideway", "oversteer"),
            "slip_angle_rear=low": ("grip", "grippy", "tidy"),
            "slip_angle_front": ("front slip angle", "understeer", "plough"),
            "slip_ratio_rear": ("rear slip ratio", "wheelspin", "burnout", "spin wheel", "spin the rear wheel"),
            "slip_ratio_front": ("front slip ratio", "lock wheel", "lock the front wheel"),
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
        names=_NAMES
        | {
            "slip_angle_front": "front slip angle",
            "slip_angle_rear": "rear slip angle",
            "slip_ratio_front": "front slip ratio",
            "slip_ratio_rear": "rear slip ratio",
            "sideslip_corners": "sideslip in corners",
            "sideslip_straights": "sideslip on straights",
            "turned_per_km": "turns to face backwards per km",
        },
        terminated="retired",
    ),
    "resources": Words(
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
            "tire fuel=0": (
                *("flat out", "push", "waste fuel and tyre", "waste tyre and fuel"),
                *("ignore fuel and tyre", "ignore tyre and fuel"),
            ),
            "": (*_DRIVING, "burn", "burning", "consume", "consuming", "spend", "spending", "wear out"),
            "overtake": ("attack", "pass"),
            "defend": ("block",),
            "defend=low": (
                *("let them pass", "let other pass", "let car pass", "let car behind pass"),
                *("let them by", "let him pass", "let him by"),
            ),
        },
        presets={
            "flat out": {"tire": 0.0, "fuel": 0.0},
            "save tyres": {"tire": 12000.0},
            "save fuel": {"fuel": 105.0},
            "attack": {"overtake": 2.0, "tire": 0.0, "fuel": 0.0},
        },
        examples=("save fuel", "save more tyres", "overtake more"),
        names=_NAMES
        | {
            "overtake": "overtaking",
            "defend": "defending",
            "tire": "tyres",
            "wear_per_km": "tyre wear per km",
            "fuel_per_km": "fuel per km",
        },
        terminated="retired",
    ),
    "aggressiveness": Words(
        vocabulary={
            "": _DRIVING,
            "longitudinal": ("following distance", "distance behind", "distance ahead"),
            "lateral": ("distance beside", "distance at side", "elbow room", "side", "sideway"),
            "longitudinal lateral": ("margin", "distance", "gap", "room", "space", "clearance"),
            "-longitudinal -lateral": (
                *("aggressive", "aggressively", "aggressiveness", "aggression", "bold", "boldly", "attack", "reckless"),
                *("pushy", "risky", "risk", "daring"),
            ),
            "+longitudinal +lateral": (
                *("careful", "carefully", "cautious", "cautiously", "caution", "defensive", "defensively", "polite"),
                *("timid", "safe", "safely", "calm", "calm down", "patient", "gentle"),
                *("keep distance", "give room", "leave room"),
            ),
        },
        presets={
            "door to door": {"longitudinal": 0.0, "lateral": 0.0},
            "room to breathe": {"longitudinal": 2.0, "lateral": 1.0},
        },
        examples=("be aggressive", "give more room", "0.3 m beside"),
        names=_NAMES
        | {
            "longitudinal": "gap ahead and behind",
            "lateral": "gap beside",
            "longitudinal_least": "smallest gap kept",
            "lateral_least": "smallest gap kept",
            "complied": "margins kept, of the time near other cars",
        },
        terminated="retired",
    ),
}
"""Words of each family."""
