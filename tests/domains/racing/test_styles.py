"""The three families of style: laws of the paper, rewards by hand."""

import pytest
import torch

from coachable.domains.racing import styles
from coachable.domains.racing.metrics import nearest_gaps
from coachable.envs.racing.race.features import GAPS, cornering, inward_angle
from coachable.styles import Shared, StyleSpace

N = 40000


def draws(space):
    return space.sample((N,), generator=torch.Generator().manual_seed(0)).double()


def within(values, expected):
    """Mean within five standard errors."""
    assert abs(values.mean() - expected) < 5 * values.std() / N**0.5


def test_drift_weights_follow_the_paper():
    """0.5 δ(0) + 0.25 U(-0.4, 0) + 0.25 U(0, 5): mean 0.575, second moment 2.096667."""
    weights = draws(styles.drift_style_space())
    for column in weights.T:
        within(column, 0.575)
        within(column**2, 2.096667)
        within((column == 0).double(), 0.5)
        within((column < 0).double(), 0.25)
        assert column.min() >= -0.4 and column.max() <= 5.0
    correlation = torch.corrcoef(weights.T) - torch.eye(4)
    assert correlation.abs().max() < 5 / N**0.5


def test_resource_weights_follow_the_paper():
    overtake, defend, tire, fuel = draws(styles.resource_style_space()).T
    for column in (overtake, defend):
        within(column, 1.0)
        assert column.min() >= 0 and column.max() <= 2
    for column, mean, second, low, high in (
        (tire, 2686.5, 21600540, -60, 12000),
        (fuel, 22.95, 1655.1, -3, 105),
    ):
        within(column, mean)
        within(column**2, second)
        within((column == 0).double(), 0.10)
        within((column < 0).double(), 0.45)
        assert low <= column.min() and column.max() <= high


def test_margins_follow_the_paper_and_are_shared():
    space = styles.aggressiveness_style_space(cars=5)
    long, lat = draws(space).T
    assert long.min() >= 0 and long.max() <= 2 and lat.min() >= 0 and lat.max() <= 1
    by_car = space.sample((10,), generator=torch.Generator().manual_seed(0)).reshape(5, 2, 2)
    assert (by_car == by_car[0]).all()
    assert not torch.equal(by_car[0, 0], by_car[0, 1])


def test_the_shared_sampler_survives_serialisation():
    space = styles.aggressiveness_style_space(cars=5)
    again = StyleSpace.from_dict(space.to_dict())
    assert again == space
    assert isinstance(again.sampler, Shared)


def test_drift_reward_by_hand():
    space = styles.drift_style_space()
    features = torch.tensor([[0.1, 0.5, 0.2, 0.3, 9.0, 9.0, 9.0, 9.0, 0.7]])
    reward = styles.drift_style_reward(space)(features, torch.tensor([[1.0, 2.0, -0.4, 5.0]]))
    assert reward.item() == pytest.approx(0.1 + 1.0 - 0.08 + 1.5)


def test_positive_weights_of_drift_pay_in_corners():
    space = styles.drift_style_space()
    features = torch.tensor([[0.1, 0.5, 0.2, 0.3, 9.0, 9.0, 9.0, 9.0, 0.7, 0.6]] * 2)
    theta = torch.tensor([[1.0, 2.0, -0.4, 5.0], [-0.1, -0.2, 4.0, 5.0]])
    reward = styles.drift_style_reward(space, in_corners=True)(features, theta)
    expected = [0.06 + 2 * 0.7 - 0.08 + 5 * 0.18, -0.01 - 0.2 * 0.5 + 4 * 0.12 + 5 * 0.18]
    assert reward[:, 0].tolist() == pytest.approx(expected)
    scaled = styles.drift_style_reward(space, in_corners=1.0, angle_scale=3.0)(features, theta)  # as in older files
    expected = [0.06 + 3 * 2 * 0.7 - 0.08 + 5 * 0.18, -0.01 - 0.2 * 0.5 + 4 * 0.12 + 5 * 0.18]
    assert scaled[:, 0].tolist() == pytest.approx(expected)
    everywhere = styles.drift_style_reward(space, in_corners=0, angle_scale=3.0)(features, theta)
    expected = [0.1 + 3 * 2 * 0.5 - 0.08 + 5 * 0.3, -0.01 - 0.2 * 0.5 + 4 * 0.2 + 5 * 0.3]
    assert everywhere[:, 0].tolist() == pytest.approx(expected)
    for unclear in (0.5, 2, "yes"):
        with pytest.raises(ValueError, match=f"in_corners is {unclear}: expected true or false"):
            styles.drift_style_reward(space, in_corners=unclear)


@pytest.mark.parametrize(
    ("degrees", "radius", "pace", "expected"),
    [
        (-30.0, 50.0, 20.0, 30.0),  # the nose points to the left, into a left corner
        (30.0, -50.0, 20.0, 30.0),  # a right corner
        (30.0, 50.0, 20.0, 0.0),  # the nose points out of the corner
        (-60.0, 50.0, 20.0, 30.0),  # beyond 45 degrees it counts less
        (-120.0, 50.0, 20.0, 0.0),  # spun
        (180.0, 50.0, 20.0, 0.0),  # backwards
        (-30.0, 200.0, 20.0, 15.0),  # a fast corner
        (-30.0, 300.0, 20.0, 0.0),  # as good as straight
        (-30.0, 50.0, 2.5, 7.5),  # it hardly makes way
        (-30.0, 50.0, -5.0, 0.0),  # it goes back
    ],
)
def test_what_counts_as_a_drift_in_a_corner(degrees, radius, pace, expected):
    curvature = torch.tensor(1.0 / radius)
    found = inward_angle(torch.tensor(degrees).deg2rad(), curvature) * cornering(curvature, torch.tensor(pace))
    assert found.rad2deg().item() == pytest.approx(expected, abs=1e-4)


def test_resource_reward_by_hand():
    features = torch.tensor([[9.0, 9.0, 9.0, 9.0, 3.0, -1.0, -8e-5, -0.01, 9.0]])
    space, theta = styles.resource_style_space(), torch.tensor([[2.0, 0.5, 12000.0, 105.0]])
    assert styles.resource_style_reward(space)(features, theta).item() == pytest.approx(6.0 - 0.5 - 0.96 - 1.05)
    more = styles.resource_style_reward(space, gained=4.0)
    assert more(features, theta).item() == pytest.approx(4 * 5.5 - 0.96 - 1.05)
    apart = styles.resource_style_reward(space, gained=2.0, defended=8.0)
    assert apart(features, theta).item() == pytest.approx(2 * 6.0 - 8 * 0.5 - 0.96 - 1.05)
    assert more.is_linear, "n-step transitions can be relabelled"


def test_margin_reward_by_hand():
    """Gaps (3, 2) and (0.5, 0.25) m, margins (2, 1): -1.5 - 0.75 = -2.25. A far car costs nothing."""
    space = styles.aggressiveness_style_space()
    features = torch.tensor([[0.0] * GAPS + [3.0, 2.0, 1.0, 0.5, 0.25, 1.0, 0.0, 0.0, 0.0]])
    theta = torch.tensor([[2.0, 1.0]])
    assert styles.aggressiveness_style_reward(space)(features, theta).item() == pytest.approx(-2.25)
    assert styles.aggressiveness_style_reward(space, weight=4.0)(features, theta).item() == pytest.approx(-9.0)
    ahead = torch.tensor([[0.0] * GAPS + [1.0, 0.0, 1.0]])
    assert styles.aggressiveness_style_reward(space)(ahead, theta).item() == pytest.approx(-2.0)
    assert styles.aggressiveness_style_reward(space, apart=0.0)(ahead, theta).item() == pytest.approx(-1.0)
    assert styles.aggressiveness_style_reward(space, apart=0.1)(ahead, theta).item() == pytest.approx(-1.1)
    with pytest.raises(ValueError, match="apart is 2: expected a share"):
        styles.aggressiveness_style_reward(space, apart=2)


def test_gaps_to_the_nearest_cars_in_line_and_beside():
    """Two opponents each: one 0.6 m beside; one 0.5 m ahead; one beside but not near; two beside."""
    far, beside = (3.0, 2.0, 0.0), (0.0, 0.6, 1.0)
    pairs = (far, beside), (far, (0.5, 0.0, 1.0)), (far, (0.0, 0.6, 0.0)), ((0.0, 0.8, 1.0), beside)
    ahead, aside = nearest_gaps(torch.tensor([[0.0] * GAPS + [*one, *other] for one, other in pairs]))
    nan = float("nan")
    assert ahead.tolist() == pytest.approx([nan, 0.5, nan, nan], nan_ok=True)
    assert aside.tolist() == pytest.approx([0.6, nan, nan, 0.6], nan_ok=True)
