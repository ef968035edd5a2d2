"""Learners train the parameters that the loss and its policy have now, wherever they are."""

import copy
import functools

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.sac_problem import cat_rac, make_batch, make_learner, make_loss, qr_sac


def clones(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def exchange_data(module, change=torch.clone):
    for tensor in (*module.parameters(), *module.buffers()):
        tensor.data = change(tensor.data)


def share_policy(loss):
    """What TorchRL's process collectors do."""
    TensorDict.from_module(loss.actor_network).data.share_memory_()


def columns_first(tensor):
    return tensor.mT.contiguous().mT if tensor.ndim > 1 else tensor


OPERATIONS = {
    "to": lambda loss: loss.to(torch.float64).to(torch.float32),
    "to of the actor": lambda loss: loss.actor_network.to(torch.float64).to(torch.float32),
    "float": lambda loss: loss.double().float(),
    "share_memory": lambda loss: loss.share_memory(),
    "share_memory_ of the actor": share_policy,
    "load_state_dict": lambda loss: loss.load_state_dict(clones(loss), assign=True),
    "load_state_dict of the actor": lambda loss: loss.actor_network.load_state_dict(
        clones(loss.actor_network), assign=True
    ),
    "load_state_dict of the critic": lambda loss: loss.qvalue_network.load_state_dict(
        clones(loss.qvalue_network), assign=True
    ),
    "data": exchange_data,
    "data of the actor": lambda loss: exchange_data(loss.actor_network),
    "data with other strides": lambda loss: exchange_data(loss, columns_first),
    "deepcopy": lambda loss: exchange_data(copy.deepcopy(loss), torch.zeros_like),
    "deepcopy of the actor": lambda loss: exchange_data(copy.deepcopy(loss.actor_network), torch.zeros_like),
}
OPTIONS = {"actor_lr": 1e-2, "critic_lr": 1e-2, "alpha_lr": 1e-2, "tau": 0.1}


def updates(learner, count, seed):
    torch.manual_seed(seed)
    for i in range(count):
        learner.update(make_batch(16, seed=seed + i))


def learned_temperature():
    return make_loss(fixed_alpha=False, target_entropy=-3.0)


def train(operation=None, build=learned_temperature, fast=True, **options):
    """Two updates, the operation, two updates; the parameters then, the policy that the user holds, and the learner."""
    torch.manual_seed(0)
    loss = build()
    actor = loss.actor_network
    learner = make_learner(loss, fast, **OPTIONS, **options)
    updates(learner, 2, seed=1)
    if operation is not None:
        operation(loss)
    updates(learner, 2, seed=5)
    return clones(loss), actor, learner


@functools.cache
def undisturbed(build=learned_temperature, **options):
    return train(None, build, **options)[0]


def require_equal(result, expected):
    trained, actor, _ = result
    torch.testing.assert_close(trained, expected, rtol=0, atol=0)
    for name, value in actor.state_dict().items():  # the policy that the user holds is the trained one
        assert torch.equal(value, expected["actor_network_params." + name]), name


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("operation", OPERATIONS)
def test_updates_go_on_as_if_nothing_had_happened(operation, precision):
    require_equal(train(OPERATIONS[operation], precision=precision), undisturbed(precision=precision))


@pytest.mark.parametrize(
    "operation", sorted(OPERATIONS.keys() - {"data with other strides"})
)  # rounds otherwise in torch
def test_the_plain_path_goes_on_too(operation):
    options = {"precision": "fp32", "fast": False}
    require_equal(train(OPERATIONS[operation], **options), undisturbed(**options))


@pytest.mark.parametrize("operation", ["to of the actor", "share_memory", "data", "load_state_dict of the actor"])
@pytest.mark.parametrize("build", [qr_sac, cat_rac])
def test_other_losses_go_on_too(build, operation):
    options = {"precision": "fp32", "update_order": "policy_first"}
    require_equal(train(OPERATIONS[operation], build, **options), undisturbed(build, **options))


def test_both_paths_train_what_they_were_given():
    """Values change with the operation: other weights of the policy, in other memory."""
    torch.manual_seed(9)
    weights = {name: 0.1 * torch.randn_like(value) for name, value in clones(make_loss().actor_network).items()}
    results = []
    for fast in (True, False):
        given = {name: value.clone() for name, value in weights.items()}
        load = lambda loss, given=given: loss.actor_network.load_state_dict(given, assign=True)  # noqa: E731
        results.append(train(load, precision="fp32", fast=fast)[0])
        assert not torch.equal(given["module.0.module.trunk.head.weight"], weights["module.0.module.trunk.head.weight"])
    ours, theirs = results
    for name, value in ours.items():  # Adam may go either way where a gradient is a rounding error
        assert ((value - theirs[name]).abs() > 1e-4).float().mean() < 0.01, name


def test_double_precision_is_that_of_the_plain_path():
    results = []
    for fast in (True, False):
        loss = make_loss()
        learner = make_learner(loss, fast, precision="fp32", **OPTIONS)
        updates(learner, 2, seed=1)
        loss.to(torch.float64)
        torch.manual_seed(5)
        for seed in range(3):
            learner.update(make_batch(16, seed=seed).apply(lambda t: t.double() if t.is_floating_point() else t))
        results.append(clones(loss))
        moments = [s["exp_avg"].dtype for o in learner.optimizers.values() for s in o.state.values()]
        assert set(moments) == {torch.float64}
    for name, value in results[0].items():
        assert value.dtype == torch.float64 or "network" not in name
        assert ((value - results[1][name]).abs() > 1e-4).float().mean() < 0.01, name


@pytest.mark.parametrize("fast", [True, False])
def test_a_copy_of_a_learner_goes_its_own_way(fast):
    expected, _, learner = train(precision="fp32", fast=fast)
    twin = copy.deepcopy(learner)
    updates(learner, 2, seed=20)
    further = clones(learner.loss_module)
    updates(twin, 2, seed=20)
    torch.testing.assert_close(clones(twin.loss_module), further, rtol=0, atol=0)
    torch.testing.assert_close(clones(learner.loss_module), further, rtol=0, atol=0)
    updates(twin, 1, seed=30)
    torch.testing.assert_close(clones(learner.loss_module), further, rtol=0, atol=0)
    assert not torch.equal(further["log_alpha"], expected["log_alpha"])


def test_a_learner_of_a_copied_loss_trains_the_policy_of_the_copy():
    twin = copy.deepcopy(make_loss())
    state = {name: value + 0.01 for name, value in clones(twin).items()}
    twin.load_state_dict(state)
    learner = make_learner(twin, True, precision="fp32", **OPTIONS)
    updates(learner, 1, seed=1)
    for name, value in twin.actor_network.state_dict().items():
        assert torch.equal(value, twin.state_dict()["actor_network_params." + name]), name
        assert not torch.equal(value, state["actor_network_params." + name]), name


@pytest.mark.parametrize("fast", [True, False])
def test_a_state_that_is_loaded_last_wins(fast):
    """After `assign=True` on the policy the checkpoint, not the policy, is what the training goes on from."""
    expected, actor, learner = train(precision="fp32", fast=fast)
    state = copy.deepcopy(learner.state_dict())
    actor.load_state_dict({name: torch.zeros_like(value) for name, value in actor.state_dict().items()}, assign=True)
    learner.load_state_dict(state)
    torch.testing.assert_close(clones(learner.loss_module), expected, rtol=0, atol=0)
    actor.load_state_dict({name: torch.zeros_like(value) for name, value in actor.state_dict().items()}, assign=True)
    learner.loss_module.load_state_dict(state["loss_module"])
    for name, value in actor.state_dict().items():
        assert torch.equal(value, expected["actor_network_params." + name]), name
    updates(learner, 1, seed=1)


def test_gradients_stay_private():
    """Nobody outside an update can move the memory that the kernels write gradients to."""
    loss = make_loss()
    learner = make_learner(loss, True, precision="fp32")
    learner.update(make_batch(8))
    assert all(parameter.grad is None for parameter in loss.parameters())


def test_what_cannot_be_followed_is_refused(monkeypatch):
    loss = make_loss()
    learner = make_learner(loss, True, precision="fp32")
    loss.actor_network[0].module.extra = nn.Linear(2, 2)
    exchange_data(loss)
    with pytest.raises(
        RuntimeError, match=r"SACLoss changed since its learner was accelerated: the policy has parameters outside"
    ):
        learner.update(make_batch(8))
    monkeypatch.setattr(learner, "_device_type", "cuda")
    with pytest.raises(RuntimeError, match="moved to cpu after its learner was made for cuda: make a learner of the"):
        learner.update(make_batch(8))
