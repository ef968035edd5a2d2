"""Samplers: moments and distributions of the paper's mixtures, seeding, description."""

from dataclasses import dataclass

import pytest
import torch

from coachable.styles import Choice, Sampler, Setpoint, Shared, StyleSpace, Weight
from coachable.styles.mixtures import single_weight, style_mixture, with_extremes, with_requests
from coachable.styles.samplers import ContinuousOneHot, Mixture, OneHot, PointMass, Product, Uniform, UniformChoice

N = 200_000

# Upper bounds of the 18 combat weights (paper): melee, traps, four bows, Sunscourge, Icestorm, three removals, five
# elements, fire, adhesive; Skykiller has its own symmetric range. Written here, not imported: domains come later.
COMBAT_HIGH = [7.5, 0.375, 1.5, 1.8, 2.25, 7.5, 30, 1.5, 1.5, 1.5, 3, 3, 3, 3, 3, 4.5, 4.5, 0.3]
COMBAT_LOW = [-0.05 * b for b in COMBAT_HIGH[:-1]] + [-0.3]

# The paper's training distributions, each a short declaration.
COMBAT = Mixture(
    [PointMass([0.0] * 18), Uniform(COMBAT_LOW, COMBAT_HIGH), ContinuousOneHot(COMBAT_LOW, COMBAT_HIGH)],
    [0.03, 0.10, 0.87],
)
DRIFT = Product([Mixture([PointMass(0.0), Uniform(-0.4, 0.0), Uniform(0.0, 5.0)], [0.50, 0.25, 0.25])] * 4)
TIRE = Mixture([PointMass(0.0), Uniform(-60.0, 0.0), Uniform(0.0, 12_000.0)], [0.10, 0.45, 0.45])
FUEL = Mixture([PointMass(0.0), Uniform(-3.0, 0.0), Uniform(0.0, 105.0)], [0.10, 0.45, 0.45])
RACING = Product([Uniform([0.0, 0.0], [2.0, 2.0]), TIRE, FUEL])
HUMANOID = Product([UniformChoice(3), Uniform(0.30, 0.65)])

ALL = {
    "combat": COMBAT,
    "drift": DRIFT,
    "racing": RACING,
    "humanoid": HUMANOID,
    "one_hot": OneHot(COMBAT_HIGH),
}


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(20_260_101)


def within_standard_errors(samples, expected, errors=5.0):
    """Whether the mean of `(N, ...)` lies within some standard errors of the expectation."""
    samples = samples.double()
    standard_error = samples.std(0) / samples.shape[0] ** 0.5
    return bool(((samples.mean(0) - torch.as_tensor(expected)).abs() <= errors * standard_error).all())


def test_combat_moments(generator):
    """P(w_i != 0) = 0.10 + 0.87/18; 0, 1 or 18 weights are non-zero."""
    w = COMBAT.sample((N,), generator)
    nonzero = w != 0
    assert within_standard_errors(nonzero, 0.10 + 0.87 / 18)
    count = nonzero.sum(-1)
    for value, probability in ((0, 0.03), (1, 0.87), (18, 0.10)):
        assert within_standard_errors(count == value, probability)
    assert set(count.unique().tolist()) == {0, 1, 18}
    middle = (torch.tensor(COMBAT_LOW) + torch.tensor(COMBAT_HIGH)) / 2
    mean = (0.10 + 0.87 / 18) * middle.double()
    assert mean[0] == pytest.approx(0.528438, abs=1e-6)
    assert within_standard_errors(w, mean)
    # cov(w_0, w_5) = (0.10 - p^2) m_0 m_5, p = 0.148333
    products = (w[:, 0] - mean[0]) * (w[:, 5] - mean[5])
    assert within_standard_errors(products, (0.10 - (0.10 + 0.87 / 18) ** 2) * middle[0] * middle[5])


def test_racing_moments(generator):
    drift = DRIFT.sample((N,), generator)
    assert within_standard_errors(drift, 0.575)
    assert within_standard_errors(drift.double() ** 2, 2.096667)
    assert within_standard_errors(drift[:, 0] * drift[:, 3], 0.575**2)  # independent
    racing = RACING.sample((N,), generator)
    assert within_standard_errors(racing, torch.tensor([1.0, 1.0, 2686.5, 22.95]))
    second = torch.tensor([4 / 3, 4 / 3, 21_600_540.0, 1655.1])
    assert within_standard_errors(racing.double() ** 2, second)


def test_humanoid_moments(generator):
    theta = HUMANOID.sample((N,), generator)
    assert theta[:, :3].sum(-1).eq(1).all()
    assert within_standard_errors(theta, torch.tensor([1 / 3, 1 / 3, 1 / 3, 0.475]))
    for option in range(3):  # the length is independent of the pose
        assert within_standard_errors(theta[theta[:, option] == 1, 3], 0.475)


def uniform_cdf(x, low, high):
    return ((x - low) / (high - low)).clamp(0, 1)


def kolmogorov_smirnov(samples, cdf, cdf_left):
    """Largest gap between the empirical and the true distribution function, atoms included (left limits too)."""
    x, counts = samples.double().unique(return_counts=True)
    right = counts.cumsum(0) / samples.numel()
    left = right - counts / samples.numel()
    return max((right - cdf(x)).abs().max().item(), (left - cdf_left(x)).abs().max().item())


@pytest.mark.parametrize(
    ("sampler", "negative", "positive", "atom"), [(TIRE, -60, 12_000, 0.10), (FUEL, -3, 105, 0.10)]
)
def test_mixtures_follow_their_distribution(generator, sampler, negative, positive, atom):
    samples = sampler.sample((N,), generator).squeeze(-1)
    share = (1 - atom) / 2

    def smooth(x):
        return share * uniform_cdf(x, negative, 0) + share * uniform_cdf(x, 0, positive)

    statistic = kolmogorov_smirnov(
        samples, lambda x: smooth(x) + atom * (x >= 0).double(), lambda x: smooth(x) + atom * (x > 0).double()
    )
    assert statistic < 1.95 / N**0.5


def test_continuous_one_hot_follows_the_chosen_range(generator):
    w = ContinuousOneHot([-1.0, 2.0], [1.0, 3.0]).sample((N,), generator)
    chosen = w[:, 1] != 0
    assert within_standard_errors(chosen, 0.5)
    assert w[chosen, 1].min() >= 2 and w[chosen, 1].max() <= 3 and w[chosen, 0].eq(0).all()
    statistic = kolmogorov_smirnov(w[~chosen, 0], lambda x: uniform_cdf(x, -1, 1), lambda x: uniform_cdf(x, -1, 1))
    assert statistic < 1.95 / int((~chosen).sum()) ** 0.5


def test_one_hot_takes_the_upper_bound(generator):
    w = OneHot([3.0, 7.0]).sample((1000,), generator)
    assert {tuple(row) for row in w.tolist()} == {(3.0, 0.0), (0.0, 7.0)}


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_shape_type_and_support(name, shape, generator):
    sampler = ALL[name]
    theta = sampler.sample(shape, generator)
    assert theta.shape == (*shape, sampler.dim) and theta.dtype == torch.float32
    low, high = (torch.tensor(bound) for bound in sampler.support())
    assert bool((theta >= low).all() and (theta <= high).all())


@pytest.mark.parametrize("name", ALL)
def test_seeded_and_independent_of_the_global_generator(name):
    before = torch.get_rng_state()
    first, second = (ALL[name].sample((7,), torch.Generator().manual_seed(3)) for _ in range(2))
    assert first.equal(second)
    assert torch.get_rng_state().equal(before)
    assert not first.equal(ALL[name].sample((7,), torch.Generator().manual_seed(4)))


@pytest.mark.parametrize("name", ALL)
def test_global_generator_by_default(name):
    torch.manual_seed(5)
    first = ALL[name].sample((7,))
    torch.manual_seed(5)
    assert first.equal(ALL[name].sample((7,)))


def test_draws_do_not_share_memory():
    theta = PointMass([1.0, 2.0]).sample((3,))
    theta[0] = 9
    assert theta[1].tolist() == [1.0, 2.0]
    assert PointMass([1.0, 2.0]).sample().tolist() == [1.0, 2.0]


def test_consumption_depends_on_the_shape_only():
    """Whatever a mixture draws, the stream advances alike, so runs that share a seed stay aligned."""
    states = []
    for seed_of_weights in ([0.2, 0.8], [0.8, 0.2]):
        generator = torch.Generator().manual_seed(0)
        Mixture([Uniform(0, 1), PointMass(0.0)], seed_of_weights).sample((6,), generator)
        states.append(generator.get_state())
    assert states[0].equal(states[1])


def test_uniform_never_rounds_out_of_its_range():
    """A bounded spec rejects even one unit in the last place; bounds of very different magnitude are the hard case."""
    generator = torch.Generator().manual_seed(1)
    magnitude = 10.0 ** torch.randint(-3, 4, (20_000, 2), generator=generator)
    low, high = (torch.randn(20_000, 2, generator=generator) * magnitude).sort(-1).values.unbind(-1)
    drawn = Uniform(low, high).sample((20,), generator)
    assert bool((drawn >= low).all() and (drawn <= high).all())
    for u in (0.0, 1 - 2.0**-24):  # the extremes of torch.rand
        drawn = torch.lerp(low, high, torch.full_like(low, u))
        assert bool((drawn >= low).all() and (drawn <= high).all())


@pytest.mark.parametrize("name", ALL)
def test_description_round_trip(name):
    revived = Sampler.from_dict(ALL[name].to_dict())
    assert revived == ALL[name]


@dataclass(frozen=True)
class Tent(Sampler):
    """A sampler as a user would write it."""

    high: float

    @property
    def dim(self) -> int:
        return 1

    def _draw(self, shape, generator, device):
        return torch.rand((2, *shape, 1), generator=generator, device=device).sum(0) * (self.high / 2)


def test_own_samplers_compose_and_describe_themselves(generator):
    sampler = Product([Tent(4.0), Uniform(0, 1)])
    assert Sampler.from_dict(sampler.to_dict()) == sampler
    assert sampler.support() is None
    assert within_standard_errors(sampler.sample((N,), generator), torch.tensor([2.0, 0.5]))


def test_names_of_samplers_are_unique():
    with pytest.raises(TypeError, match=r"named Uniform exists already, in coachable\.styles\.samplers"):
        type("Uniform", (Sampler,), {"__module__": "elsewhere"})
    assert Sampler.from_dict(Uniform(0, 1).to_dict()) == Uniform(0, 1)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Uniform(1, 0), "low <= high"),
        (lambda: Uniform([0, 0], [1]), "equal lengths"),
        (lambda: ContinuousOneHot([], []), "equal lengths"),
        (lambda: Mixture([PointMass(0), Uniform([0, 0], [1, 1])], [0.5, 0.5]), r"dimensions \[1, 2\]"),
        (lambda: Mixture([PointMass(0), Uniform(0, 1)], [0.5, 0.4]), "summing to 0.9"),
        (lambda: Mixture([PointMass(0), Uniform(0, 1)], [1.5, -0.5]), "probabilities that sum to 1"),
        (lambda: Mixture([PointMass(0)], [0.5, 0.5]), "expected 1 probabilities"),
        (lambda: Mixture([], []), "at least one"),
        (lambda: Product([]), "at least one"),
        (lambda: UniformChoice(0), "n of UniformChoice is 0: expected a whole number of at least 1"),
        (lambda: with_requests(StyleSpace([Weight("drift", 0.0, 5.0)]), full=0.9), "probabilities that sum to 1"),
        (lambda: with_requests(StyleSpace([Setpoint("pace", 0.0, 1.0)])), "with_requests asks for weights of 0.*pace"),
        (lambda: with_requests(StyleSpace([Weight("drift", 0.0, 5.0)]), full=-0.1), r"full is -0.1: .* in \[0, 1\]"),
        (lambda: style_mixture(StyleSpace([Weight("a", 0, 5)]), neutral=float("nan")), "neutral is nan: expected"),
        (lambda: style_mixture(StyleSpace([Weight("a", 0, 5)]), neutral=0.6, independent=0.6), "exceed 1 together"),
        (lambda: with_extremes(StyleSpace([Setpoint("pace", 0.0, 1.0)]), share=2.0), r"share is 2.0: .* in \[0, 1\]"),
        (lambda: single_weight(StyleSpace([Setpoint("pace", 0, 1), Weight("a", 0, 5)]), "a"), "leaves pace at 0"),
        (lambda: single_weight(StyleSpace([Weight("a", 0, 5)]), "b"), "no weight 'b': expected one of a"),
        (lambda: Mixture([PointMass(0)], [float("nan")]), "probabilities that sum to 1"),
        (lambda: Uniform(0, float("inf")), "a value of Uniform is inf: expected a number that is finite"),
        (lambda: PointMass(float("nan")), "a value of PointMass is nan"),
        (lambda: OneHot([1.0, float("inf")]), "a value of OneHot is inf"),
        (lambda: Shared(PointMass(0), 0), "copies is 0: expected a whole number of at least 1"),
        (lambda: with_extremes(StyleSpace([Choice("gait", ("run", "hop"))])), "with_extremes asks for bounds.*gait"),
        (lambda: with_extremes(StyleSpace([Setpoint("pace", 0, 1)]), only=["gait"]), "extremes of gait.*some of pace"),
        (lambda: Sampler.from_dict({"type": "Levy"}), "unknown sampler type 'Levy'"),
    ],
)
def test_construction_is_checked(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_requests_are_drawn_beside_the_spaces_own_styles():
    space = StyleSpace([Weight(name, -0.4, 5.0) for name in "abcd"], DRIFT)
    theta = with_requests(space, positive=0.25, full=0.15, neutral=0.1).sample((N,), torch.Generator().manual_seed(0))
    assert (theta == 5.0).all(-1).float().mean() == pytest.approx(0.15, abs=0.005)
    assert (theta == 0.0).all(-1).float().mean() == pytest.approx(0.1 + 0.5 * 0.5**4, abs=0.005)
    every = ((theta > 0.0) & (theta < 5.0)).all(-1).float().mean()
    assert every == pytest.approx(0.25 + 0.5 * 0.25**4, abs=0.005)


@pytest.mark.parametrize(("copies", "shared"), [(1, True), (3, True), (3, False)])
def test_extremes_are_drawn_beside_the_spaces_own_styles(copies, shared):
    own = Uniform([0.0, 0.0], [2.0, 1.0])
    space = StyleSpace([Setpoint("a", 0.0, 2.0), Setpoint("b", 0.0, 1.0)], Shared(own, copies) if copies > 1 else own)
    theta = with_extremes(space, share=0.4, shared=shared).sample((3 * N,), torch.Generator().manual_seed(0))
    first, second = theta.unbind(-1)
    for a in (0.0, 2.0):
        for b in (0.0, 1.0):
            assert ((first == a) & (second == b)).float().mean() == pytest.approx(0.1, abs=0.005)
    inside = (first > 0.0) & (first < 2.0) & (second > 0.0) & (second < 1.0)
    assert inside.float().mean() == pytest.approx(0.6, abs=0.005)
    same = (theta[:N] == theta[N : 2 * N]).all(-1).float().mean()
    assert same == 1.0 if copies == 3 and shared else same == pytest.approx(4 * 0.1**2, abs=0.005)


@pytest.mark.parametrize("only", ["a", ["a"]])
def test_extremes_of_some_parameters_leave_the_others_at_their_default(only):
    space = StyleSpace([Setpoint("a", 0.0, 2.0), Setpoint("b", 0.0, 1.0, default=0.2), Weight("c", -1.0, 1.0)])
    theta = with_extremes(space, share=0.4, only=only).sample((N,), torch.Generator().manual_seed(0))
    first, second, third = theta.unbind(-1)
    rest = (second == space.default[1]) & (third == 0.0)
    for bound in (0.0, 2.0):
        assert ((first == bound) & rest).float().mean() == pytest.approx(0.2, abs=0.005)
    assert rest.float().mean() == pytest.approx(0.4, abs=0.005)
