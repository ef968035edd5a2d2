"""What is measured of a step, from components written by hand."""

import pytest
import torch
from tensordict import TensorDict

from coachable.domains.combat.metrics import CombatMeasures
from coachable.domains.combat.styles import combat_style_space
from coachable.envs.combat.env import COMPONENTS_KEY
from coachable.envs.combat.rewards import COMPONENT_SLICES, NUM_COMPONENTS
from coachable.envs.combat.tables import STYLES, WEAPONS
from coachable.keys import STYLE


def transition(theta, terminated=False, **amounts):
    """One step with the given components; a weapon's damage under its name."""
    components = torch.zeros(1, NUM_COMPONENTS)
    for name, amount in amounts.items():
        column = COMPONENT_SLICES["weapon_damage"].start + WEAPONS.index(name) if name in WEAPONS else None
        components[0, COMPONENT_SLICES[name].start if column is None else column] = amount
    following = {COMPONENTS_KEY: components, "terminated": torch.tensor([[terminated]])}
    return TensorDict({STYLE: theta[None], "next": following}, [1])


@pytest.mark.parametrize("asked, counted", [("melee", 7.0), ("skykiller", 4.0)])
def test_the_style_asked_for_most_is_the_one_closest_to_its_own_limit(asked, counted):
    """Ranges of the weights differ, so that shares of them are compared, not the weights themselves."""
    styles = ("melee", "skykiller")
    space = combat_style_space(styles)
    high = dict(zip(styles, space.high.tolist(), strict=True))
    smaller = min(high, key=high.__getitem__)
    assert high["melee"] != high["skykiller"]
    other = next(name for name in styles if name != asked)
    # The other's weight is the larger number where the asked one's range is the smaller, yet a smaller share.
    shares = {asked: 0.9, other: 0.8} if asked == smaller else {asked: 0.9, other: 0.0}
    theta = torch.tensor([shares[name] * high[name] for name in styles])
    row = CombatMeasures(styles).step(transition(theta, damage=11.0, melee_damage=7.0, Skykiller=4.0))
    assert row["requested"].item() == counted
    assert (row["damage"].item(), row["melee"].item(), row["skykiller"].item()) == (11.0, 7.0, 4.0)


def test_the_papers_weights_have_ranges_of_their_own():
    styles = ("skykiller", "icestorm_boltblaster")
    high = combat_style_space(styles, "paper").high
    row = CombatMeasures(styles, "paper").step(transition(high * torch.tensor([1.0, 0.1]), damage=5.0, Skykiller=5.0))
    assert row["requested"].item() == 5.0


def test_shares_not_products_decide():
    """For every pair of styles, 0.9 of one range beats 0.8 of another, whichever range is wider."""
    space = combat_style_space()
    measures = CombatMeasures()
    for first, second in ((0, 5), (5, 0), (0, 17), (17, 0), (8, 12), (12, 8)):
        theta = torch.zeros(len(STYLES))
        theta[first], theta[second] = 0.9 * space.high[first], 0.8 * space.high[second]
        components = torch.rand(1, NUM_COMPONENTS) + 1.0
        following = {COMPONENTS_KEY: components, "terminated": torch.tensor([[False]])}
        row = measures.step(TensorDict({STYLE: theta[None], "next": following}, [1]))
        assert row["requested"] == row[STYLES[first]], (STYLES[first], STYLES[second])


def test_nothing_is_asked_for_without_a_positive_weight():
    measures = CombatMeasures(("melee", "skykiller"))
    for theta in (torch.zeros(2), torch.tensor([0.0, -0.5])):
        row = measures.step(transition(theta, damage=1.0, melee_damage=1.0))
        assert row["requested"].isnan().all()
        assert not measures.complies(row).any()


@pytest.mark.parametrize(
    "terminated, amounts, outcome",
    [
        (True, {}, "won"),
        (True, {"death": 1.0}, "died"),
        (True, {"out_of_bounds": 1.0}, "out_of_bounds"),
        (False, {}, None),
    ],
)
def test_a_fight_ends_in_one_way(terminated, amounts, outcome):
    row = CombatMeasures(("melee",)).step(transition(torch.ones(1), terminated, **amounts))
    assert {name: row[name].item() for name in ("won", "died", "out_of_bounds")} == {
        name: float(name == outcome) for name in ("won", "died", "out_of_bounds")
    }


def test_the_score_is_the_share_of_the_damage_in_the_steps_that_count():
    measures = CombatMeasures(("melee",))
    record = {"requested": torch.tensor([[2.0, 0.0], [3.0, 0.0], [9.0, 0.0]])}
    record |= {"requested_damage": record["requested"], "damage": torch.tensor([[4.0, 0.0], [6.0, 0.0], [9.0, 0.0]])}
    alive = torch.tensor([[True, True], [True, True], [False, True]])
    sums = measures.summarise(record, alive)
    assert sums["requested"].tolist() == [5.0, 0.0] and sums["damage"].tolist() == [10.0, 0.0]
    assert sums["style_score"][0] == 0.5 and sums["style_score"][1].isnan()


def test_a_request_for_parts_has_no_score_and_does_not_count_where_the_request_changes():
    measures = CombatMeasures(("melee", "part_shield"))
    melee, parts = torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0])
    hits = [
        measures.step(transition(theta, damage=8.0, melee_damage=2.0, removals=1.0)) for theta in (melee, parts, parts)
    ]
    assert measures.complies(hits[1]).all()
    record = {name: torch.stack([hit[name] for hit in hits]) for name in hits[0]}
    alive = torch.ones_like(record["damage"], dtype=torch.bool)
    assert measures.summarise(record, alive)["style_score"].tolist() == [0.25]
    only_parts = measures.summarise({name: values[1:] for name, values in record.items()}, alive[1:])
    assert only_parts["style_score"].isnan().all() and only_parts["part_shield"].tolist() == [2.0]


def test_fights_are_judged_by_damage_under_a_style():
    nan = float("nan")
    record = {
        "damage": torch.tensor([[0.0], [5.0], [5.0], [5.0]]),
        "requested": torch.tensor([[0.0], [nan], [0.0], [2.0]]),
    }
    measures = CombatMeasures()
    assert measures.judged(record)[:, 0].tolist() == [False, False, True, True]
    assert measures.complies(record)[:, 0].tolist() == [False, False, False, True]
