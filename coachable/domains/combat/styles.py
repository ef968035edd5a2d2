"""Style space of the combat domain, with 18 weights, their ranges and the training mixture (paper, Appendix C)."""

from collections.abc import Sequence

from coachable.envs.combat.rewards import REWARD_SCALES
from coachable.envs.combat.tables import check_styles, load_table
from coachable.styles import StyleReward, StyleSpace, Weight, WeightedSum
from coachable.styles.mixtures import style_mixture


def combat_style_space(styles: Sequence[str] | None = None, reward_scale: str = "sim") -> StyleSpace:
    """Return the space of the style weights with the mixture from which they are drawn at a reset.

    Args:
        styles: Names of the weights, as in `CombatEnv(styles=...)`; all 18 by default.
        reward_scale: "sim" for ranges that fit the damage rates of this simulator, or "paper" for the paper's.

    Raises:
        ValueError: If a name or an option is unknown.
    """
    names = check_styles(styles)
    if reward_scale not in REWARD_SCALES:
        raise ValueError(f"reward_scale is {reward_scale!r}: expected one of {REWARD_SCALES}")
    table = load_table("styles")
    low = [table.number(name, f"{reward_scale}_low") for name in names]
    high = [table.number(name, f"{reward_scale}_high") for name in names]
    weights = [
        Weight(name, a, b, help=table.rows[name]["help"], evaluation=(a if -a == b else 0.0, b))
        for name, a, b in zip(names, low, high, strict=True)
    ]
    space = StyleSpace(weights, name="combat")
    return space.with_sampler(style_mixture(space))


def single_styles(space: StyleSpace) -> list[dict[str, float]]:
    """Return the neutral style, and each weight alone at the upper and, if it is not 0, the lower end of its range.

    The range is the one that reports sweep.
    """
    neutral = dict.fromkeys(space.names, 0.0)
    cells = [neutral]
    for weight in space.parameters:
        assert isinstance(weight, Weight)
        low, high = weight.evaluation_range
        cells += [neutral | {weight.name: end} for end in (high, low) if end]
    return cells


def combat_style_reward(space: StyleSpace) -> StyleReward:
    """Return the style reward sum_i w_i g_i, where `style_features` has the g_i in the order of the space's weights.

    Args:
        space: Result of `combat_style_space` with the styles of the environment.
    """
    return StyleReward(space, {"styles": WeightedSum(space.names)})
