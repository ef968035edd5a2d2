"""Words of the coach's commands to the player."""

from coachable.domain import Words

WORDS = Words(
    vocabulary={
        "": ("fight", "fighting", "weapon", "weapons"),
        "melee": ("spear", "close combat", "hand to hand"),
        "traps": ("tripwire", "ambush"),
        "part_weapon": (
            *("weapon part", "break weapon", "destroy weapon", "tear off weapon"),
            *("shoot off weapon", "cut off weapon", "disarm"),
        ),
        "part_canister": ("break canister", "destroy canister", "tear off canister", "shoot canister"),
        "part_shield": ("break shield", "destroy shield", "tear off shield", "take down shield", "armour", "armor"),
        "acid": ("corrode", "corrosion"),
        "purgewater": ("drench", "water"),
        "frost": ("freeze", "ice"),
        "shock": ("stun", "electrify"),
        "fire": ("burn", "burn it down", "ignite", "set on fire"),
        "adhesive": ("glue", "slow it", "slow it down", "slow them", "slow them down", "slow down"),
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
    names={
        "ancestors_return": "Ancestor's Return",
        "corrosive_blastsling": "Corrosive Blastsling",
        "carjas_bane": "Carja's Bane",
        "icestorm_boltblaster": "Icestorm Boltblaster",
        "sunscourge": "Sunscourge",
        "skykiller": "Skykiller",
        "part_weapon": "weapon parts",
        "part_canister": "canister parts",
        "part_shield": "shield parts",
        "style_score": "share of the damage in this style",
    },
    terminated="ended the fight",
)
