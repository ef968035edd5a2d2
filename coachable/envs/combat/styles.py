"""Styles of the combat domain: 18 weights, their ranges and the training mixture (paper, Appendix C)."""

from __future__ import annotations

from collections.abc import Sequence

from coachable.envs.combat.rewards import REWARD_SCALES
from coachable.envs.combat.tables import STYLES, load_table
from coachable.styles import (
    ContinuousOneHot,
    Mixture,
    OneHot,
    PointMass,
    StyleReward,
    StyleSpace,
    Uniform,
    Weight,
    WeightedSum,
)

MIXTURE = (0.03, 0.10, 0.87)
"""Shares of no style, of every weight at once, and of one weight (paper)."""

COMBAT_COMPONENTS = ("continuous_one_hot", "one_hot", "independent")


def check_styles(styles: Sequence[str] | None) -> tuple[str, ...]:
    """The chosen styles in the order given; all 18 if None.

    Raises:
        ValueError: if one is unknown or repeated.
    """
    chosen = STYLES if styles is None else tuple(styles)
    unknown = [name for name in chosen if name not in STYLES]
    if unknown or not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(f"styles are {list(chosen)}: expected distinct ones of {list(STYLES)}")
    return chosen


def combat_style_space(
    styles: Sequence[str] | None = None,
    reward_scale: str = "sim",
    combat_component: str = "continuous_one_hot",
) -> StyleSpace:
    """The style weights and the mixture that they are drawn from at every reset.

    Args:
        styles: names of the weights, as in `CombatEnv(styles=...)`; all 18 if None.
        reward_scale: "sim" ranges fit the damage rates of this simulator, "paper" are the paper's.
        combat_component: third component of the mixture. "continuous_one_hot" (paper): one weight, uniform over its
            range; "one_hot" (ablation): one weight at its maximum; "independent" (ablation): all of them.

    Raises:
        ValueError: if a name or an option is unknown.
    """
    names = check_styles(styles)
    if reward_scale not in REWARD_SCALES:
        raise ValueError(f"reward_scale is {reward_scale!r}: expected one of {REWARD_SCALES}")
    if combat_component not in COMBAT_COMPONENTS:
        raise ValueError(f"combat_component is {combat_component!r}: expected one of {COMBAT_COMPONENTS}")
    table = load_table("styles")
    low = [table.number(name, f"{reward_scale}_low") for name in names]
    high = [table.number(name, f"{reward_scale}_high") for name in names]
    together = Uniform(low, high)
    single = {
        "continuous_one_hot": ContinuousOneHot(low, high),
        "one_hot": OneHot(high),
        "independent": together,
    }[combat_component]
    weights = [
        Weight(name, a, b, help=table.rows[name]["help"], evaluation=(a if -a == b else 0.0, b))
        for name, a, b in zip(names, low, high, strict=True)
    ]
    return StyleSpace(weights, Mixture([PointMass([0.0] * len(names)), together, single], MIXTURE), name="combat")


def combat_style_reward(space: StyleSpace) -> StyleReward:
    """Style part of the reward, sum_i w_i g_i: `style_features` holds the g_i in the order of the space's weights.

    Args:
        space: of `combat_style_space`, with the same styles as the environment.
    """
    return StyleReward(space, {"styles": WeightedSum(space.names)})
