"""Relabelling at sampling time: labels, rewards, what stays, and the random numbers it takes."""

import contextlib
from functools import partial
from typing import get_args

import pytest
import torch
from tensordict import NonTensorStack, TensorDict
from torchrl.data import LazyTensorStorage, MultiStep, TensorDictReplayBuffer
from torchrl.envs import MultiStepTransform

from coachable.domains.combat import combat_style_space
from coachable.domains.humanoid import humanoid_style_space
from coachable.domains.racing.families import racing_family
from coachable.replay import EventTableBuffer, KeyEvents
from coachable.styles import (
    Choice,
    PointMass,
    Setpoint,
    Shared,
    StyleReward,
    StyleSpace,
    Term,
    Uniform,
    Weight,
    WeightedFeature,
)
from coachable.styles.mixtures import Single, own, single_weight, style_mixture, with_extremes, with_requests
from coachable.transforms import StyleRewardTransform, TaskImpersonation
from tests.echo import echo_space

SPACE = StyleSpace([Choice("pose", ("front", "up")), Setpoint("length", 0.3, 0.6), Weight("melee", -1.0, 2.0)])
TERMS = {
    "pose": Term(lambda f, s: s["pose"][..., 0] * f[..., 0] - s["pose"][..., 1] * f[..., 0], ("pose",)),
    "length": Term(lambda f, s: torch.exp(-10 * (f[..., 1] - s["length"]).abs()), ("length",)),
    "melee": WeightedFeature("melee", 2),
}
REWARD = StyleReward(SPACE, TERMS, {"length": 0.7})


def transitions(n: int, seed: int = 0) -> TensorDict:
    """Random transitions whose rewards the environment's transform has written."""
    g = torch.Generator().manual_seed(seed)
    style = SPACE.sample((n,), g)
    flag = torch.rand(n, 1, generator=g) < 0.1
    td = TensorDict(
        {
            "observation": torch.randn(n, 5, generator=g),
            "action": torch.randn(n, 2, generator=g),
            "style": style,
            "id": torch.arange(n),
            "next": {
                "observation": torch.randn(n, 5, generator=g),
                "task_reward": torch.randn(n, 1, generator=g),
                "style_features": torch.randn(n, 3, generator=g),
                "style": style.clone(),
                "done": flag,
                "terminated": flag.clone(),
            },
        },
        [n],
    )
    nxt = td["next"]
    StyleRewardTransform(REWARD)._step(td, nxt)
    td["next"] = nxt
    return td


def test_shapes_and_what_stays():
    td = transitions(64)
    before = td.clone()
    out = TaskImpersonation(REWARD, n=3)(td)
    assert out.shape == (64, 4)
    assert (td == before).all() and set(td.keys(True)) == set(before.keys(True))
    assert set(out.keys(True)) == set(td.keys(True))
    untouched = ["observation", "action", "id"] + [
        ("next", k) for k in ("observation", "task_reward", "style_features", "done", "terminated")
    ]
    for key in untouched:
        for column in range(4):
            assert torch.equal(out[key][:, column], td[key]), key


def test_column_zero_is_the_stored_label_bit_for_bit():
    td = transitions(64)
    first = TaskImpersonation(REWARD, n=3)(td)[:, 0]
    for key in td.keys(True, True):
        assert torch.equal(first[key], td[key]), key


def test_new_columns_are_rewarded_as_the_environment_would():
    """The environment's transform, run on the relabelled transitions, changes no bit."""
    td = transitions(500)
    out = TaskImpersonation(REWARD, n=4)(td)
    for column in range(5):
        relabelled = out[:, column].clone()
        nxt = relabelled["next"].exclude("reward", "style_reward")
        StyleRewardTransform(REWARD)._step(relabelled, nxt)
        assert torch.equal(nxt["reward"], out["next", "reward"][:, column])
        assert torch.equal(nxt["style_reward"], out["next", "style_reward"][:, column])


def test_styles_agree_in_both_states_and_are_drawn_per_transition():
    out = TaskImpersonation(REWARD, n=3)(transitions(200))
    assert torch.equal(out["style"], out["next", "style"])
    drawn = out["style"][:, 1:].reshape(-1, SPACE.dim)
    assert len(drawn.unique(dim=0)) == 600
    SPACE.validate(drawn)


def test_styles_come_from_the_training_distribution():
    space = StyleSpace([Weight("a", 0.0, 1.0)], sampler=Uniform([0.2], [0.4]))
    reward = StyleReward(space, {"a": WeightedFeature("a", 0)})
    one = torch.ones(4000, 1)
    td = TensorDict({"style": one, "next": {"reward": 2 * one, "task_reward": one, "style_features": one}}, [4000])
    style = TaskImpersonation(reward, n=2)(td)["style"][:, 1:]
    assert style.min() >= 0.2 and style.max() <= 0.4
    assert abs(style.mean().item() - 0.3) < 5 * (0.2 / 12**0.5) / 8000**0.5
    reward.space = space.with_sampler(PointMass([0.25]))
    fixed = TaskImpersonation(reward, n=2)(td)
    assert (fixed["style"][:, 1:] == 0.25).all() and (fixed["next", "style"][:, 1:] == 0.25).all()


def spaces_and_samplers():
    """Every style space that the recipes train on, with every sampler that serves it."""
    spaces = [humanoid_style_space(), combat_style_space(["melee", "skykiller"]), combat_style_space(), echo_space()]
    spaces += [racing_family(family).make_space() for family in ("drift", "resources", "aggressiveness")]
    makers = {
        "default": own,
        **{single: partial(style_mixture, single=single) for single in get_args(Single)},
        "with_requests": with_requests,
        "with_extremes": with_extremes,
        "own_extremes": partial(with_extremes, shared=False),
    }
    for space in spaces:
        for name, make in makers.items():
            with contextlib.suppress(ValueError):  # not every sampler serves every kind of parameter
                yield pytest.param(space, make(space), id=f"{space.name}-{space.dim}-{name}")


@pytest.mark.parametrize("space, sampler", list(spaces_and_samplers()))
def test_labels_are_independent_over_transitions_and_copies(space, sampler):
    """As often two labels of a transition are one and the same as two draws of the sampler's distribution are."""
    reward = StyleReward(space.with_sampler(sampler), {"any": Term(lambda f, s: f[..., 0], space.names)})
    size = 300
    one = torch.ones(size, 1)
    td = TensorDict(
        {"style": space.sample((size,)), "next": {"reward": 2 * one, "task_reward": one, "style_features": one}}, [size]
    )
    draws = sampler.sample((20_000, 1), torch.Generator().manual_seed(1)).squeeze(-2)
    alike = (draws[::2] == draws[1::2]).all(-1).double().mean().item()
    for n in range(1, 7):
        labels = TaskImpersonation(reward, n=n, seed=n)(td)["style"][:, 1:]
        for shift in (1, 2, 3):  # copies of one transition, then one copy of several transitions
            _assert_alike(labels, labels.roll(shift, 1), alike) if n > shift else None
            _assert_alike(labels, labels.roll(shift, 0), alike)
        if alike == 0.0:
            assert len(labels.reshape(-1, space.dim).unique(dim=0)) == size * n
    _assert_same_distribution(labels.reshape(-1, space.dim), draws)


def _assert_alike(a, b, probability):
    same = (a == b).all(-1).double()
    error = (probability * (1 - probability) / same.numel()) ** 0.5
    assert abs(same.mean().item() - probability) <= 6 * error + 0.01


def _assert_same_distribution(labels, draws):
    """Each entry, by the largest gap between the two distribution functions (Kolmogorov and Smirnov)."""
    for entry in range(draws.shape[1]):
        at = labels[:, entry].unique()
        gap = (labels[:, entry].sort().values.contiguous(), draws[:, entry].sort().values.contiguous())
        cdfs = [torch.searchsorted(values, at, right=True) / len(values) for values in gap]
        assert (cdfs[0] - cdfs[1]).abs().max() < 2.4 * (1 / len(labels) + 1 / len(draws)) ** 0.5


def test_the_cars_of_a_race_share_a_style_and_their_labels_do_not():
    space = racing_family("aggressiveness").make_space()
    assert isinstance(space.sampler, Shared)
    copies = space.sampler.copies
    drawn = space.sample((copies * 7,), torch.Generator().manual_seed(0)).reshape(copies, 7, space.dim)
    assert (drawn == drawn[0]).all() and len(drawn[0].unique(dim=0)) == 7
    assert len(space.sampler.sample((copies, 7, 1)).reshape(-1, space.dim).unique(dim=0)) == 7 * copies


def test_samplers_that_share_nothing_draw_as_before():
    """The same numbers in the same order, so that a seed goes on to mean what it meant."""
    sampler = style_mixture(StyleSpace([Weight("a", -1.0, 1.0), Weight("b", 0.0, 2.0)]))
    independent = sampler.sample((5, 3, 1), torch.Generator().manual_seed(0)).squeeze(-2)
    assert torch.equal(independent, sampler.sample((5, 3), torch.Generator().manual_seed(0)))


def steps(n: int) -> TensorDict:
    td = transitions(n).exclude(("next", "style"))
    td["next", "done"][:] = td["next", "terminated"][:] = False
    return td


@pytest.mark.parametrize("summed", [True, False])
def test_sums_are_refused_where_the_style_reward_is_not_linear(summed):
    keys = [("next", "style_features")] if summed else []
    relabel = TaskImpersonation(REWARD, n=2)
    buffer = EventTableBuffer(
        {"default": 100}, n_steps=3, gamma=0.9, num_envs=1, discounted_keys=keys, batch_size=8, transform=relabel
    )
    buffer.extend(steps(60))
    with pytest.raises(ValueError, match=r"sums over up to 3 steps: the style reward is not linear .*n_steps=1"):
        buffer.sample()


def test_sums_of_torchrls_own_n_step_returns_are_refused_too():
    relabel = TaskImpersonation(REWARD, n=2)
    data = MultiStep(gamma=0.9, n_steps=3)(steps(40).reshape(1, 40)).reshape(-1)
    with pytest.raises(ValueError, match="sums over up to 3 steps"):
        relabel(data)


@pytest.mark.parametrize("n_step", [MultiStep(gamma=0.9, n_steps=3), MultiStepTransform(gamma=0.9, n_steps=3)])
def test_sums_of_torchrl_lack_the_features_that_a_linear_style_reward_needs(n_step):
    space = StyleSpace([Weight("a", 0.0, 1.0)])
    relabel = TaskImpersonation(StyleReward(space, {"a": WeightedFeature("a", 0)}), n=2)
    td = steps(40).reshape(1, 40)
    td["style"] = td["style"][..., :1].abs()
    summed = n_step(td) if isinstance(n_step, MultiStep) else n_step.inv(td)
    with pytest.raises(ValueError, match=r"up to 3 steps from TorchRL's MultiStep, .*let EventTableBuffer sum"):
        relabel(summed.reshape(-1))


def test_sums_are_relabelled_where_the_style_reward_is_linear():
    space = StyleSpace([Weight("a", 0.0, 1.0)])
    reward = StyleReward(space, {"a": WeightedFeature("a", 0)})
    td = steps(60)
    td["style"] = torch.full((60, 1), 0.7)
    td["next", "reward"] = td["next", "task_reward"] + 0.7 * td["next", "style_features"][:, :1]
    relabel = TaskImpersonation(reward, n=2)
    features = [("next", "style_features")]
    buffer = EventTableBuffer({"default": 100}, n_steps=3, gamma=0.9, num_envs=1, discounted_keys=features)
    buffer.append_transform(relabel)
    buffer.extend(td)
    sample = buffer.sample(8)
    expected = sample["next", "task_reward"] + sample["style"] * sample["next", "style_features"][..., :1]
    torch.testing.assert_close(sample["next", "reward"], expected)


def test_single_steps_of_a_buffer_that_counts_them_are_relabelled():
    td = transitions(16).set("steps_to_next_obs", torch.ones(16, 1, dtype=torch.long))
    assert TaskImpersonation(REWARD, n=2)(td).shape == (16, 3)


def test_rewards_that_something_has_changed_are_refused():
    changed = transitions(16)
    changed["next", "reward"] = 0.1 * changed["next", "reward"]
    for data in (changed, transitions(16).set("style", SPACE.sample((16,)))):
        with pytest.raises(ValueError, match=r"but task_reward \+ style_reward is .* no transform after StyleReward"):
            TaskImpersonation(REWARD, n=2)(data)


def test_entries_that_are_no_tensors_are_kept():
    names = [f"row {i}" for i in range(16)]
    data = transitions(16).set("name", NonTensorStack(*names))
    found = TaskImpersonation(REWARD, n=2)(data)
    assert [row["name"] for row in found[:, 2].unbind(0)] == names


def test_n_zero_changes_nothing():
    plain = TensorDictReplayBuffer(storage=LazyTensorStorage(64), batch_size=16)
    none = TensorDictReplayBuffer(
        storage=LazyTensorStorage(64), batch_size=16, transform=TaskImpersonation(REWARD, n=0)
    )
    for buffer in (plain, none):
        buffer.extend(transitions(64))
    torch.manual_seed(3)
    a = plain.sample()
    torch.manual_seed(3)
    b = none.sample()
    assert a.shape == b.shape == (16,) and (a == b).all() and set(a.keys(True)) == set(b.keys(True))


def test_works_through_a_plain_replay_buffer_and_never_writes_back():
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(500), batch_size=128)
    buffer.extend(transitions(500))
    stored = buffer[:].clone()
    buffer.append_transform(TaskImpersonation(REWARD, n=1))
    sample = buffer.sample()
    assert sample.shape == (128, 2) and sample["index"].shape == (128, 2)
    assert torch.equal(sample["index"][:, 0].long(), sample["id"][:, 0])
    assert (buffer.storage.get(slice(0, 500)) == stored).all()
    assert buffer[7].shape == (2,) and buffer[7]["id"].tolist() == [7, 7]


def test_works_with_event_tables_and_priorities():
    td = transitions(300)
    td["next", "events"] = torch.rand(300, 1) < 0.2
    buffer = EventTableBuffer(
        {"default": 300, "hit": 100},
        events=KeyEvents(["hit"]),
        event_horizon=3,
        num_envs=1,
        prioritized=True,
        batch_size=32,
        transform=TaskImpersonation(REWARD, n=3),
    )
    buffer.extend(td)
    sample = buffer.sample()
    assert sample.shape == (32, 4)
    assert sample["table"][:, 0].bincount().tolist() == [16, 16]
    assert sample["priority_weight"].shape == (32, 4)
    sample["td_error"] = torch.rand(32, 4)
    buffer.update_tensordict_priority(sample)
    index = sample["index"][:, 0]
    for slot in index.unique():
        # Drawn twice, a record keeps the largest error of all its labels.
        largest = sample["td_error"][index == slot].max()
        expected = (largest.double() + 1e-8) ** 0.6
        assert torch.isclose(buffer.sampler._tree.get(slot), expected)


def test_what_led_to_an_event_is_relabelled_with_the_style_of_its_table():
    space = StyleSpace([Weight("fuel", 0.0, 2.0), Weight("hit", -1.0, 3.0)])
    reward = StyleReward(space, {"fuel": WeightedFeature("fuel", 0), "hit": WeightedFeature("hit", 1)})
    steps = {"style": torch.zeros(300, 2), "next": {}}
    steps["next"] = {
        "style_features": torch.rand(300, 2),
        "task_reward": torch.rand(300, 1),
        "style": torch.zeros(300, 2),
    }
    td = TensorDict(steps, [300])
    td["next", "reward"] = td["next", "task_reward"].clone()
    td["next", "done"] = torch.zeros(300, 1, dtype=torch.bool)
    td["next", "events"] = torch.rand(300, 1) < 0.2
    buffer = EventTableBuffer(
        {"default": 300, "hit": 100}, events=KeyEvents(["hit"]), event_horizon=3, num_envs=1, batch_size=64
    )
    tables = {buffer.names.index("hit"): single_weight(space, "hit")}
    buffer.append_transform(TaskImpersonation(reward, n=2, tables=tables))
    buffer.extend(td)
    sample = buffer.sample()
    led = sample["table"][:, 0] == 1
    assert led.sum() == 32
    own, others = sample["style"][led, 1], torch.cat([sample["style"][~led, 1], sample["style"][:, 2]])
    assert (own[:, 0] == 0).all() and (own[:, 1] > 0).all() and own[:, 1].std() > 0.5
    assert (others != 0).any(0).all() and (others[:, 1] < 0).any()  # of the training's distribution
    assert not sample["style"][:, 0].any()  # the stored label stays
    expected = sample["next", "task_reward"] + (sample["style"] * sample["next", "style_features"]).sum(
        -1, keepdim=True
    )
    torch.testing.assert_close(sample["next", "reward"], expected)
    with pytest.raises(KeyError, match="found no 'table' in the sample"):
        TaskImpersonation(reward, tables=tables)(td)
    with pytest.raises(ValueError, match="draws styles of 1 numbers: expected 2"):
        TaskImpersonation(reward, tables={1: Uniform(0.0, 1.0)})


def test_the_loss_is_the_same_for_any_order_of_labels():
    out = TaskImpersonation(REWARD, n=4)(transitions(64))
    loss = (out["next", "reward"] - out["style"].sum(-1, keepdim=True)).square()
    shuffled = out[:, torch.tensor([3, 0, 4, 2, 1])]
    again = (shuffled["next", "reward"] - shuffled["style"].sum(-1, keepdim=True)).square()
    torch.testing.assert_close(loss.mean(), again.mean())


def test_style_of_the_next_state_is_added_where_it_is_not_stored():
    td = transitions(8).exclude(("next", "style"), ("next", "style_reward"))
    out = TaskImpersonation(REWARD, n=2)(td)
    assert torch.equal(out["next", "style"], out["style"])
    assert ("next", "style_reward") not in out.keys(True)


def test_own_generator_and_its_state():
    td = transitions(16)
    torch.manual_seed(0)
    a = TaskImpersonation(REWARD, n=2, seed=1)(td)
    torch.manual_seed(1)
    transform = TaskImpersonation(REWARD, n=2, seed=1)
    assert torch.equal(transform(td)["style"], a["style"])
    assert not torch.equal(transform(td)["style"], a["style"])
    assert not torch.equal(TaskImpersonation(REWARD, n=2, seed=2)(td)["style"], a["style"])
    resumed = TaskImpersonation(REWARD, n=2)
    resumed.load_state_dict(transform.state_dict())
    assert torch.equal(resumed(td)["style"], transform(td)["style"])


def test_state_is_part_of_the_buffer_state():
    def make():
        rb = TensorDictReplayBuffer(
            storage=LazyTensorStorage(64), batch_size=16, transform=TaskImpersonation(REWARD, n=2)
        )
        rb.extend(transitions(64))
        return rb

    one, other = make(), make()
    one.sample()
    other.load_state_dict(one.state_dict())
    torch.manual_seed(0)
    a = one.sample()
    torch.manual_seed(0)
    assert (other.sample() == a).all()


@pytest.mark.parametrize("n", [-1, 1.5, True])
def test_bad_n(n):
    with pytest.raises(ValueError, match="n of TaskImpersonation is"):
        TaskImpersonation(REWARD, n=n)


def test_bad_data():
    relabel = TaskImpersonation(REWARD)
    td = transitions(4)
    with pytest.raises(KeyError, match="style_features"):
        relabel(td.exclude(("next", "style_features")))
    td["style"] = torch.zeros(4, 2)
    with pytest.raises(ValueError, match="expected 4 numbers"):
        relabel(td)


def test_is_refused_by_environments():
    td = TensorDict({}, [])
    with pytest.raises(RuntimeError, match="replay"):
        TaskImpersonation(REWARD)._reset(td, td)
