import copy
import logging

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import SACLoss

from coachable.fast import accelerate, native
from coachable.fast.accelerate import Acceleration, obstacle
from coachable.networks import make_critic, make_gaussian_actor
from coachable.training import Learner
from coachable.training.backend import Backend
from tests.sac_problem import ACT, OBS, WIDTHS, ScaledStyle, cat_rac, make_batch, make_learner, make_loss, qr_sac

LOSSES = [make_loss, qr_sac, cat_rac]


@pytest.fixture(params=["compiled", "without a compiler"])
def kernels(request, monkeypatch):
    compiled = request.param == "compiled"
    if not compiled:
        monkeypatch.setenv("COACHABLE_NATIVE", "0")
    native.load_kernels.cache_clear()
    if compiled and not native.load_kernels():
        pytest.skip("no C compiler")
    assert bool(native.load_kernels()) is compiled
    yield
    native.load_kernels.cache_clear()


def plain_critic_loss():
    """A SACLoss whose critics are not residual networks."""

    class Plain(nn.Module):
        def __init__(self):
            super().__init__()
            self.net = nn.Linear(OBS + ACT, 1)

        def forward(self, observation, action):
            return self.net(torch.cat((observation, action), -1))

    critics = [
        TensorDictModule(Plain(), in_keys=["observation", "action"], out_keys=["state_action_value"]) for _ in range(2)
    ]
    actor = make_gaussian_actor(OBS, ACT, ScaledStyle(), WIDTHS)
    return SACLoss(actor, critics, loss_function="l2", fixed_alpha=True, alpha_init=0.01)


def parameters_after(learner, updates=5):
    for seed in range(updates):
        torch.manual_seed(seed)
        learner.update(make_batch(32, seed=seed))
    state = learner.loss_module.state_dict()
    return {name: value.clone() for name, value in state.items() if "network" in name}


def fast_and_plain(build, **options):
    """A learner with hand-written passes and one in plain torch, of equal losses."""
    for fast in (True, False):
        torch.manual_seed(0)
        yield make_learner(build(), fast, **options)


@pytest.mark.parametrize("order", ["simultaneous", "policy_first"])
@pytest.mark.parametrize("build", LOSSES)
def test_a_few_updates_end_where_those_in_plain_torch_end(build, order, kernels):
    """Parameters and targets of all losses, with the compiled kernels and without a C compiler."""
    learners = fast_and_plain(build, precision="fp32", update_order=order, actor_lr=1e-3)
    ours, theirs = map(parameters_after, learners)
    for name, expected in theirs.items():
        # Adam's first step is the sign of the gradient, so that a gradient of rounding errors may go either way.
        differs = (ours[name] - expected).abs() > 2e-4
        assert differs.float().mean() < 0.01, name


@pytest.mark.parametrize("build", LOSSES)
def test_bf16_stays_close_to_plain_torch(build):
    """The passes round where autocast does not, so that directions agree rather than digits."""
    ends = []
    for learner in fast_and_plain(build, precision="bf16"):
        start = {name: value.clone() for name, value in learner.loss_module.state_dict().items()}
        end = parameters_after(learner)
        ends.append(torch.cat([(end[name] - start[name]).flatten() for name in end if not name.startswith("target")]))
    assert torch.cosine_similarity(*ends, dim=0) > 0.95


@pytest.mark.parametrize("shape", [(32,), (8, 4)])
@pytest.mark.parametrize("order", ["simultaneous", "policy_first"])
@pytest.mark.parametrize("build", LOSSES)
def test_every_loss_gives_the_same_metrics(build, order, shape):
    results = []
    for learner in fast_and_plain(build, precision="fp32", update_order=order):
        torch.manual_seed(3)
        results.append(learner.update(make_batch(*shape)))
    ours, theirs = results
    for key in theirs:
        torch.testing.assert_close(ours[key], theirs[key], rtol=1e-4, atol=1e-5, msg=lambda m, key=key: f"{key}: {m}")


def test_a_learner_with_state_may_be_accelerated():
    """Moments and the update counter stay, and the state moves back to a learner in plain torch."""
    one, two = (Learner(make_loss(), precision="fp32") for _ in range(2))
    for learner in (one, two):
        torch.manual_seed(3)
        learner.update(make_batch(16))
    assert accelerate(one)
    torch.testing.assert_close(one.state_dict(), two.state_dict(), rtol=0, atol=0)
    three = Learner(make_loss(seed=3), precision="fp32")
    three.load_state_dict(copy.deepcopy(one.state_dict()))
    ends = [parameters_after(learner) for learner in (one, two, three)]
    for name, expected in ends[1].items():
        torch.testing.assert_close(ends[0][name], expected, rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(ends[2][name], expected, rtol=0, atol=0)


def test_a_resumed_learner_goes_on_with_the_same_bits():
    one = make_learner(make_loss(), True)
    parameters_after(one)
    two = make_learner(make_loss(seed=3), True)
    two.load_state_dict(copy.deepcopy(one.state_dict()))
    torch.testing.assert_close(parameters_after(two), parameters_after(one), rtol=0, atol=0)


def test_a_copy_of_an_accelerated_learner_is_accelerated():
    twin = copy.deepcopy(make_learner(make_loss(), True))
    assert isinstance(twin.backend, Acceleration)
    assert type(copy.deepcopy(make_learner(make_loss(), False)).backend) is Backend


def test_the_switch(caplog):
    caplog.set_level(logging.INFO, logger="coachable.fast.accelerate")
    learner = Learner(make_loss())
    assert not accelerate(learner, "off")
    assert not accelerate(learner, False)
    assert type(learner.backend) is Backend
    assert accelerate(learner)
    assert isinstance(learner.backend, Acceleration)
    plain = Learner(plain_critic_loss(), precision="bf16")
    assert not accelerate(plain)
    assert "plain torch: the critic has parameters outside of residual networks" in caplog.text
    assert all(torch.isfinite(value) for value in plain.update(make_batch(16)).values())
    with pytest.raises(ValueError, match=r"fast=on is impossible: the critic has parameters outside of residual netw"):
        accelerate(plain, True)
    with pytest.raises(ValueError, match=r"fast=yes: expected one of auto, on, off"):
        accelerate(learner, "yes")


def test_networks_on_another_device_are_left_to_torch():
    assert "on the device meta, not on a CPU" in str(obstacle(nn.Linear(1, 1, device="meta")))


def test_networks_that_are_trained_in_part_are_left_to_torch():
    loss = make_loss()
    assert obstacle(loss) is None
    next(iter(loss.actor_network_params.values(True, True))).requires_grad_(False)
    assert obstacle(loss) == "some parameters of actor_network_params are frozen"


def test_further_target_networks_are_left_to_torch():
    """The optimiser of the critics moves no others."""
    loss = make_loss(delay_actor=True)
    assert obstacle(loss) == "the loss has target_actor_network_params besides the critics' target network"


def test_networks_with_dropout_are_left_to_torch():
    actor = make_gaussian_actor(OBS, ACT, ScaledStyle(), WIDTHS, dropout=0.1)
    critics = [make_critic(OBS, ACT, ScaledStyle(), WIDTHS) for _ in range(2)]
    loss = SACLoss(actor, critics, loss_function="l2", fixed_alpha=True, alpha_init=0.01)
    assert obstacle(loss) == "the policy has dropout"


def test_a_residual_network_beside_other_parameters_is_left_to_torch():
    """Half a network by hand and half by autograd is not worth the trouble."""
    loss = make_loss()
    policy = loss.actor_network[0].module
    policy.extra = nn.Linear(2, 2)
    assert obstacle(loss) == "the policy has parameters outside of residual networks"
    del policy.extra
    assert obstacle(loss) is None


def test_the_policy_is_an_ordinary_module_between_updates():
    """Collectors and exports use it, and must see the parameters as they are."""
    loss = make_loss()
    learner = make_learner(loss, True, precision="bf16", actor_lr=1e-2)
    policy = loss.actor_network[0].module
    observation, style = torch.randn(5, OBS), torch.randn(5, 2)
    before = policy(observation, style)[0]
    learner.update(make_batch(16))
    after = policy(observation, style)[0]
    assert (after != before).any()
    after.sum().backward()
    assert policy.trunk.head.weight.grad is not None
    assert "forward" not in vars(policy.trunk)


def test_a_copy_of_a_loss_goes_its_own_way():
    """Past opponents and evaluations copy losses that a learner holds."""
    loss = make_loss()
    learner = make_learner(loss, True, precision="bf16", actor_lr=1e-2)
    learner.update(make_batch(16))
    state = {name: value.clone() for name, value in loss.state_dict().items()}
    twin = copy.deepcopy(loss)
    other = make_learner(twin, True, precision="bf16", actor_lr=1e-2)
    other.update(make_batch(16))
    torch.testing.assert_close(loss.state_dict(), state, rtol=0, atol=0)
    twin.load_state_dict(state)
    with other.backend.updating():
        for flat in other.backend._buffers:
            torch.testing.assert_close(flat.low, [t.bfloat16() for t in flat.tensors], rtol=0, atol=0)


def test_an_error_inside_the_update_restores_the_loss(monkeypatch):
    loss = cat_rac()
    learner = make_learner(loss, True, precision="fp32")
    ordinary = loss._vmap_qnetworkN0
    monkeypatch.setattr(loss, "actor_loss", None)
    with pytest.raises(TypeError):
        learner.update(make_batch(16))
    assert loss._vmap_qnetworkN0 is ordinary
    assert "forward" not in vars(loss.actor_network[0].module.trunk)


def test_hand_written_passes_are_not_compiled():
    """They are the faster of the two."""
    with pytest.warns(UserWarning, match="compile=True has no effect"):
        learner = make_learner(make_loss(), True, compile=True)
    learner.update(make_batch(16))
    assert learner._losses.both == learner.loss_module.forward
