"""Relabelling at sampling time: labels, rewards, what stays, and the random numbers it takes."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from coachable.replay import EventTableBuffer, KeyEvents
from coachable.styles import (
    Choice,
    PointMass,
    Setpoint,
    StyleReward,
    StyleSpace,
    Term,
    Uniform,
    Weight,
    WeightedFeature,
)
from coachable.transforms import StyleRewardTransform, TaskImpersonation

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
    td = TensorDict({"style": one, "next": {"reward": one, "task_reward": one, "style_features": one}}, [4000])
    style = TaskImpersonation(reward, n=2)(td)["style"][:, 1:]
    assert style.min() >= 0.2 and style.max() <= 0.4
    assert abs(style.mean().item() - 0.3) < 5 * (0.2 / 12**0.5) / 8000**0.5
    fixed = TaskImpersonation(reward, n=2, sampler=PointMass([0.25]))(td)
    assert (fixed["style"][:, 1:] == 0.25).all() and (fixed["next", "style"][:, 1:] == 0.25).all()


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
    buffer.append_transform(TaskImpersonation(REWARD, SPACE, n=1))
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


def test_the_loss_is_the_same_for_any_order_of_labels():
    out = TaskImpersonation(REWARD, n=4)(transitions(64))
    loss = (out["next", "reward"] - out["style"].sum(-1, keepdim=True)).square()
    shuffled = out[:, torch.tensor([3, 0, 4, 2, 1])]
    again = (shuffled["next", "reward"] - shuffled["style"].sum(-1, keepdim=True)).square()
    torch.testing.assert_close(loss.mean(), again.mean())


def test_nested_features():
    space = StyleSpace([Weight("a", 0.0, 1.0)])
    reward = StyleReward(space, {"a": Term(lambda f, s: s["a"] * f["x"].squeeze(-1) + f["y", "z"][..., 1], ("a",))})
    features = TensorDict({"x": torch.randn(6, 1), "y": {"z": torch.randn(6, 2)}}, [6])
    one = torch.ones(6, 1)
    td = TensorDict({"style": one, "next": {"reward": one, "task_reward": one, "style_features": features}}, [6])
    for batch in (td, td.clone().auto_batch_size_(1)):
        out = TaskImpersonation(reward, n=2)(batch)
        expected = 1 + out["style"][:, 1:] * features["x"].unsqueeze(1) + features["y", "z"][:, None, 1:]
        torch.testing.assert_close(out["next", "reward"][:, 1:], expected)


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
    transform.set_seed(1)
    assert torch.equal(transform(td)["style"], a["style"])


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
    with pytest.raises(ValueError, match="further styles"):
        TaskImpersonation(REWARD, n=n)


def test_bad_sampler_and_data():
    with pytest.raises(ValueError, match="draws styles of 1 numbers: expected 4"):
        TaskImpersonation(REWARD, sampler=PointMass([1.0]))
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
