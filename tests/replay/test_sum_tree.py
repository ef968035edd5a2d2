"""The sum tree against NumPy."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coachable.replay import SumTree


def reference_draw(priorities: np.ndarray, offset: int, capacity: int, uniform: float) -> int:
    own = priorities[offset : offset + capacity]
    return offset + int(np.searchsorted(np.cumsum(own), uniform * own.sum(), side="right"))


@settings(max_examples=60, deadline=None)
@given(
    capacities=st.lists(st.integers(1, 40), min_size=1, max_size=5),
    fanout=st.integers(2, 7),
    seed=st.integers(0, 2**31),
    updates=st.integers(1, 6),
)
def test_totals_and_draws(capacities, fanout, seed, updates):
    rng = np.random.default_rng(seed)
    ends = np.cumsum(capacities[::-1])[::-1]  # laid out in reverse, as the buffer does
    offsets = ends - np.array(capacities)
    tree = SumTree(capacities, offsets, fanout)
    priorities = np.zeros(sum(capacities))
    for _ in range(updates):
        slot = rng.integers(0, len(priorities), rng.integers(1, 30))
        # Powers of two keep sums exact, so that the boundaries between records are the same for both.
        value = 2.0 ** rng.integers(-3, 4, len(slot)) * (rng.random(len(slot)) < 0.7)
        tree.update(torch.from_numpy(slot), torch.from_numpy(value))
        priorities[slot] = 0.0
        np.maximum.at(priorities, slot, value)
    everything = torch.arange(len(priorities))
    assert tree.get(everything).tolist() == priorities.tolist()
    sums = [priorities[o : o + c].sum() for o, c in zip(offsets, capacities, strict=True)]
    assert tree.totals.tolist() == sums
    regions = [r for r, total in enumerate(sums) if total > 0]
    if not regions:
        return
    region = rng.choice(regions, 64)
    uniform = rng.integers(0, 2**12, 64) / 2**12
    drawn = tree.draw(torch.from_numpy(region), torch.from_numpy(uniform)).numpy()
    assert (priorities[drawn] > 0).all()
    expected = [reference_draw(priorities, offsets[r], capacities[r], u) for r, u in zip(region, uniform, strict=True)]
    # Stretching a number on its way down rounds: where it falls on a boundary, the neighbour may be drawn.
    different = drawn != np.array(expected)
    assert different.mean() <= 0.1
    assert (
        np.searchsorted(np.sort(offsets), drawn, "right") == np.searchsorted(np.sort(offsets), expected, "right")
    ).all()


def test_frequencies_are_proportional():
    tree = SumTree([100, 7], [7, 0], fanout=8)
    weights = torch.rand(107, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    weights[20] = 0.0
    tree.update(torch.arange(107), weights)
    n = 200_000
    uniform = torch.rand(n, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    for region, (start, stop) in enumerate([(7, 107), (0, 7)]):
        drawn = tree.draw(torch.full((n,), region), uniform)
        share = weights[start:stop] / weights[start:stop].sum()
        counts = torch.bincount(drawn - start, minlength=stop - start)
        sigma = (n * share * (1 - share)).sqrt()
        assert ((counts - n * share).abs() <= 5 * sigma + 1e-9).all()
        assert counts.sum() == n


def test_a_duplicate_index_takes_the_largest_and_counts_once():
    tree = SumTree([10], [0], fanout=3)
    tree.update(torch.tensor([4, 4, 4, 5]), torch.tensor([1.0, 3.0, 2.0, 1.0]))
    assert tree.get(torch.tensor([4])).item() == 3.0 and tree.totals.item() == 4.0
    tree.update(torch.tensor([[4, 4], [4, 4]]), torch.tensor([[0.5, 0.25], [0.125, 0.5]]))
    assert tree.totals.item() == 1.5


def test_sums_do_not_drift():
    tree = SumTree([5000], [0])
    g = torch.Generator().manual_seed(0)
    for _ in range(300):
        tree.update(torch.randint(5000, (256,), generator=g), 10 ** (12 * torch.rand(256, generator=g) - 6))
    assert tree.totals.item() == pytest.approx(tree.leaves().sum().item(), rel=1e-14)


def test_the_ends_of_the_unit_interval():
    tree = SumTree([1000], [0], fanout=4)
    tree.update(torch.tensor([3, 998]), torch.tensor([1e-8, 1e8]))
    ends = torch.tensor([0.0, 1.0 - 2.0**-53], dtype=torch.float64)
    assert tree.draw(torch.tensor([0, 0]), ends).tolist() == [3, 998]


def test_every_record_of_a_large_table_can_be_drawn():
    """Float32 numbers would reach at most 2^24 of them."""
    n = 2**18 + 5
    tree = SumTree([n], [0])
    tree.update(torch.arange(n), torch.ones(n))
    drawn = tree.draw(torch.zeros(n, dtype=torch.long), (torch.arange(n, dtype=torch.float64) + 0.5) / n)
    assert torch.equal(drawn, torch.arange(n))


def test_leaves_restore_the_tree():
    tree = SumTree([9, 30], [30, 0], fanout=3)
    tree.update(torch.arange(39), torch.rand(39))
    other = SumTree([9, 30], [30, 0], fanout=5)
    other.load_leaves(tree.leaves())
    assert torch.equal(other.leaves(), tree.leaves())
    torch.testing.assert_close(other.totals, tree.totals)


def test_bad_fanout():
    with pytest.raises(ValueError, match="fanout"):
        SumTree([3], [0], fanout=1)


@pytest.mark.gpu
def test_on_a_gpu():
    tree, twin = SumTree([100, 50], [50, 0], device="cuda"), SumTree([100, 50], [50, 0])
    g = torch.Generator().manual_seed(0)
    for _ in range(10):
        slot, value = torch.randint(150, (64,), generator=g), torch.rand(64, generator=g)
        tree.update(slot.cuda(), value.cuda())
        twin.update(slot, value)
    region, uniform = torch.randint(2, (256,), generator=g), torch.rand(256, dtype=torch.float64, generator=g)
    torch.testing.assert_close(tree.totals.cpu(), twin.totals)
    assert (tree.draw(region.cuda(), uniform.cuda()).cpu() == twin.draw(region, uniform)).float().mean() > 0.99
