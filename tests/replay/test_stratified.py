"""Exact shares in every batch, uniform and prioritised draws within a table."""

from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from coachable.replay import EventTableBuffer, KeyEvents, KeyRoute
from coachable.replay.stratified import allot


def exact_allotment(batch: int, shares: list[int], available: list[bool]) -> list[int]:
    """Largest remainder in exact fractions, tables with a quota below 1 set to 1 first."""
    counts = [0] * len(shares)
    open_tables = [i for i, (s, a) in enumerate(zip(shares, available, strict=True)) if a and s]
    left = batch
    while open_tables:
        total = sum(shares[i] for i in open_tables)
        quota = {i: Fraction(left * shares[i], total) for i in open_tables}
        small = [i for i in open_tables if quota[i] < 1]
        if not small:
            break
        for i in small:
            counts[i] = 1
        left -= len(small)
        open_tables = [i for i in open_tables if i not in small]
    if open_tables:
        for i in open_tables:
            counts[i] = int(quota[i])
        missing = left - sum(counts[i] for i in open_tables)
        for i in sorted(open_tables, key=lambda i: -(quota[i] - int(quota[i])))[:missing]:
            counts[i] += 1
    return counts


@settings(max_examples=150, deadline=None)
@example(batch=284, tables=[(17, True), (44, True), (7, True), (32, True), (48, True)])  # a tie that floats break
@given(
    batch=st.integers(1, 512),
    tables=st.lists(st.tuples(st.integers(0, 50), st.booleans()), min_size=1, max_size=25),
)
def test_allotment_is_the_largest_remainder(batch, tables):
    shares, available = [list(column) for column in zip(*tables, strict=True)]
    sharing = sum(1 for s, a in tables if s and a)
    if not sum(shares):
        shares[0] = 1
        sharing = int(available[0])
    proportions = np.array(shares) / sum(shares)
    if sharing == 0 or sharing > batch:
        with pytest.raises(ValueError, match="table"):
            allot(batch, proportions, np.array(available))
        return
    counts = allot(batch, proportions, np.array(available)).tolist()
    assert counts == exact_allotment(batch, shares, available)
    assert sum(counts) == batch
    assert all((c >= 1) == bool(s and a) for c, s, a in zip(counts, shares, available, strict=True))


def test_default_shares():
    """The default table has half of the batch, the event tables share the rest equally."""
    names = [f"e{i}" for i in range(19)]
    rb = EventTableBuffer(
        {"default": 100, **dict.fromkeys(names, 10)},
        events=KeyEvents(names),
        event_horizon=1,
        num_envs=1,
        batch_size=256,
    )
    n = 50
    nxt = {"done": torch.zeros(n, 1, dtype=torch.bool), "events": torch.ones(n, 19, dtype=torch.bool)}
    rb.extend(TensorDict({"id": torch.arange(n), "next": nxt}, [n]))
    counts = rb.sample()["table"].bincount().tolist()
    assert counts[0] == 128 and sum(counts) == 256 and set(counts[1:]) == {6, 7}


def filled(sizes: dict[str, int], proportions: dict[str, float] | None = None, **kwargs) -> EventTableBuffer:
    """A multi-table buffer, every record of which knows its table and its rank there."""
    names = list(sizes)
    rb = EventTableBuffer(dict.fromkeys(names, 64), route=KeyRoute(names), table_proportions=proportions, **kwargs)
    for i, n in enumerate(sizes.values()):
        if n:
            td = TensorDict({"scenario": torch.full((n,), i), "id": 1000 * i + torch.arange(n)}, [n])
            rb.extend(td)
    return rb


def test_every_batch_holds_exact_shares():
    rb = filled({"a": 64, "b": 30, "c": 5}, {"a": 0.5, "b": 0.3, "c": 0.2})
    for _ in range(20):
        batch = rb.sample(33)
        assert batch["table"].bincount().tolist() == [16, 10, 7]  # quotas 16.5, 9.9, 6.6
        assert torch.equal(batch["id"] // 1000, batch["table"])
        assert torch.equal(batch["scenario"], batch["table"])


def test_empty_tables_are_left_out_and_the_rest_renormalised():
    rb = filled({"a": 20, "b": 0, "c": 20}, {"a": 0.5, "b": 0.25, "c": 0.25})
    assert rb.sample(30)["table"].bincount(minlength=3).tolist() == [20, 0, 10]
    rb.extend(TensorDict({"scenario": torch.tensor([1]), "id": torch.tensor([1004])}, [1]))
    assert rb.sample(30)["table"].bincount(minlength=3).tolist() == [15, 8, 7]


def test_a_table_without_a_share_is_never_drawn():
    rb = filled({"a": 20, "b": 20}, {"a": 1.0, "b": 0.0})
    assert (rb.sample(64)["table"] == 0).all()


def test_empty_buffers_cannot_be_sampled():
    rb = filled({"a": 0, "b": 0})
    assert not rb.can_sample(4)
    with pytest.raises(ValueError, match="extend the buffer first"):
        rb.sample(4)
    rb = filled({"a": 2, "b": 2})
    assert rb.can_sample(2) and not rb.can_sample(1)
    with pytest.raises(ValueError, match="batch of 1"):
        rb.sample(1)


def test_draws_are_uniform_within_the_table():
    rb = filled({"a": 50, "b": 7}, {"a": 0.5, "b": 0.5}, generator=torch.Generator().manual_seed(0))
    ids = torch.cat([rb.sample(1000)["id"] for _ in range(100)])
    for start, n in [(0, 50), (1000, 7)]:
        counts = torch.bincount(ids[(ids >= start) & (ids < start + n)] - start, minlength=n)
        assert counts.sum() == 50_000
        sigma = (50_000 / n * (1 - 1 / n)) ** 0.5
        assert ((counts - 50_000 / n).abs() < 5 * sigma).all()


def test_only_live_records_are_drawn_after_eviction():
    rb = filled({"a": 64})
    rb.extend(TensorDict({"scenario": torch.zeros(40).long(), "id": torch.arange(100, 140)}, [40]))
    ids = torch.cat([rb.sample(64)["id"] for _ in range(60)]).unique().tolist()
    assert ids == [*range(40, 64), *range(100, 140)]


def test_prioritised_draws_and_weights_are_relative_to_the_table():
    rb = filled(
        {"a": 50, "b": 7},
        {"a": 0.5, "b": 0.5},
        prioritized=True,
        priority_alpha=0.7,
        priority_beta=0.5,
        generator=torch.Generator().manual_seed(0),
    )
    slots = torch.cat([torch.from_numpy(rb.regions.slots(i)) for i in range(2)])
    errors = torch.rand(57, generator=torch.Generator().manual_seed(1)) * 4 - 2
    errors[50:] *= 1000  # the scale of another table must not matter
    rb.update_priority(slots, errors)
    p = (errors.abs().double() + 1e-8) ** 0.7
    batches = [rb.sample(1000) for _ in range(100)]
    ids = torch.cat([b["id"] for b in batches])
    for start, stop, base in [(0, 50, 0), (50, 57, 1000)]:
        share = p[start:stop] / p[start:stop].sum()
        own = ids[ids // 1000 == base // 1000] - base
        counts = torch.bincount(own, minlength=stop - start)
        assert counts.sum() == 50_000
        sigma = (50_000 * share * (1 - share)).sqrt()
        assert ((counts - 50_000 * share).abs() < 5 * sigma + 1).all()
    batch = batches[0]
    row = torch.where(batch["table"] == 0, batch["id"], batch["id"] - 1000 + 50)
    size = torch.where(batch["table"] == 0, 50.0, 7.0)
    total = torch.stack([p[:50].sum(), p[50:].sum()])[batch["table"]]
    weight = (size * p[row] / total) ** -0.5
    torch.testing.assert_close(batch["priority_weight"], (weight / weight.max()).float())


@pytest.mark.parametrize("prioritized", [True, False])
def test_priorities_of_another_kind_of_buffer_are_refused(prioritized):
    saved, other = filled({"a": 4}, prioritized=prioritized), filled({"a": 4}, prioritized=not prioritized)
    kinds = ("prioritised", "not prioritised")
    expected = "{}, this one is {}".format(*(kinds if prioritized else reversed(kinds)))
    with pytest.raises(ValueError, match=f"saved buffer was {expected}: give the same value of prioritized"):
        other.sampler.load_state_dict(saved.sampler.state_dict())


def test_new_records_get_the_largest_priority():
    rb = filled({"a": 4}, prioritized=True, priority_alpha=1.0)
    slots = torch.from_numpy(rb.regions.slots(0))
    assert rb.sampler._tree.get(slots).tolist() == [1.0] * 4
    rb.update_priority(slots, torch.tensor([0.5, -8.0, 0.0, 2.0]))
    rb.extend(TensorDict({"scenario": torch.tensor([0]), "id": torch.tensor([4])}, [1]))
    fresh = torch.from_numpy(rb.regions.slots(0))[-1:]
    assert rb.sampler._tree.get(fresh).item() == pytest.approx(8.0, rel=1e-6)


def test_evicted_priorities_do_not_linger():
    rb = filled({"a": 64}, prioritized=True)
    rb.update_priority(torch.from_numpy(rb.regions.slots(0)), torch.full((64,), 1e9))
    rb.empty()
    rb.extend(TensorDict({"scenario": torch.zeros(3).long(), "id": torch.arange(3)}, [3]))
    assert set(torch.cat([rb.sample(8)["id"] for _ in range(20)]).tolist()) == {0, 1, 2}


def test_priorities_of_several_labels_and_dimensions():
    rb = filled({"a": 8}, prioritized=True, priority_alpha=1.0)
    slots = torch.from_numpy(rb.regions.slots(0))[:2]
    sample = TensorDict(
        {"index": slots.unsqueeze(1).expand(2, 3), "td_error": torch.tensor([[1.0, 5, 2], [3, 1, 2]])}, [2, 3]
    )
    rb.update_tensordict_priority(sample)
    torch.testing.assert_close(rb.sampler._tree.get(slots), torch.tensor([5.0, 3.0]).double())
    rb.update_priority(slots, torch.tensor([[7.0], [9.0]]))
    torch.testing.assert_close(rb.sampler._tree.get(slots), torch.tensor([7.0, 9.0]).double())
    rb.update_priority(slots, 2.0)
    torch.testing.assert_close(rb.sampler._tree.get(slots), torch.tensor([2.0, 2.0]).double())


def test_priorities_without_prioritisation():
    rb = filled({"a": 8})
    rb.update_tensordict_priority(rb.sample(4))  # as training loops call it unconditionally
    with pytest.raises(RuntimeError, match="prioritized=True"):
        rb.update_priority(torch.tensor([0]), torch.tensor([1.0]))


@pytest.mark.gpu
def test_on_a_gpu():
    from functools import partial

    from torchrl.data import LazyTensorStorage

    rb = EventTableBuffer(
        {"default": 500, "hit": 100},
        events=KeyEvents(["hit"]),
        event_horizon=4,
        num_envs=2,
        n_steps=3,
        gamma=0.9,
        prioritized=True,
        storage=partial(LazyTensorStorage, device="cuda"),
    )
    for i in range(20):
        nxt = {
            "reward": torch.rand(40, 1),
            "done": torch.rand(40, 1) < 0.1,
            "terminated": torch.zeros(40, 1, dtype=torch.bool),
            "events": torch.rand(40, 1) < 0.2,
        }
        rb.extend(TensorDict({"id": torch.arange(40 * i, 40 * i + 40), "next": nxt}, [40], device="cuda"))
    batch = rb.sample(64)
    assert batch.device.type == "cuda" and batch["table"].bincount().tolist() == [32, 32]
    batch["td_error"] = torch.rand(64, device="cuda")
    rb.update_tensordict_priority(batch)
    assert rb.sample(64)["priority_weight"].isfinite().all()


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_priorities_that_are_not_finite_are_refused(bad):
    rb = filled({"a": 8}, prioritized=True)
    slots = rb.sample(4)["index"]
    with pytest.raises(ValueError, match="1 of 4 priorities are not finite"):
        rb.update_priority(slots, torch.tensor([1.0, bad, 1.0, 1.0]))
    with pytest.raises(ValueError, match=r"priorities of shape \(3,\) for slots of shape \(4,\)"):
        rb.update_priority(slots, torch.ones(3))
    with pytest.raises(KeyError, match="the sample has no 'td_error'"):
        rb.update_tensordict_priority(rb.sample(4))
    rb.sample(4)
