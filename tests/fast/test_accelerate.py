import copy

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import SACLoss

from coachable.fast.accelerate import Acceleration
from coachable.networks import make_gaussian_actor
from coachable.training import Learner
from tests.sac_problem import ACT, OBS, WIDTHS, ScaledStyle, cat_rac, make_batch, make_loss, qr_sac


@pytest.mark.parametrize("shape", [(32,), (8, 4)])
@pytest.mark.parametrize("order", ["simultaneous", "policy_first"])
@pytest.mark.parametrize("build", [make_loss, qr_sac, cat_rac])
def test_every_loss_gives_the_same_numbers(build, order, shape):
    results = []
    for fused in (True, False):
        torch.manual_seed(0)
        learner = Learner(build(), precision="fp32", fused=fused, update_order=order)
        assert (learner._acceleration is not None) is fused
        torch.manual_seed(3)
        metrics = learner.update(make_batch(*shape))
        results.append((metrics, dict(learner.loss_module.named_parameters())))
    (ours, moved), (theirs, expected) = results
    for key in theirs:
        torch.testing.assert_close(ours[key], theirs[key], rtol=1e-4, atol=1e-5, msg=lambda m, key=key: f"{key}: {m}")
    for name in expected:
        # Adam's first step is the sign of the gradient, so that a gradient of rounding errors may go either way.
        differs = (moved[name] - expected[name]).abs() > 1e-5
        assert differs.float().mean() < 0.01, name


def test_networks_of_other_kinds_are_left_to_torch():
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
    loss = SACLoss(actor, critics, loss_function="l2", fixed_alpha=True, alpha_init=0.01)
    assert not Acceleration.supports(loss)
    learner = Learner(loss, precision="bf16")
    metrics = learner.update(make_batch(16))
    assert all(torch.isfinite(value) for value in metrics.values())


def test_networks_that_are_trained_in_part_are_left_to_torch():
    loss = make_loss()
    assert Acceleration.supports(loss)
    next(iter(loss.actor_network_params.values(True, True))).requires_grad_(False)
    assert not Acceleration.supports(loss)


def test_a_residual_network_beside_other_parameters_is_left_to_torch():
    """Half a network by hand and half by autograd is not worth the trouble."""
    loss = make_loss()
    policy = loss.actor_network[0].module
    policy.extra = nn.Linear(2, 2)
    assert not Acceleration.supports(loss)
    del policy.extra
    assert Acceleration.supports(loss)


def test_the_policy_is_an_ordinary_module_between_updates():
    """Collectors and exports use it, and must see the parameters as they are."""
    loss = make_loss()
    learner = Learner(loss, precision="bf16", actor_lr=1e-2)
    policy = loss.actor_network[0].module
    observation, style = torch.randn(5, OBS), torch.randn(5, 2)
    before = policy(observation, style)[0]
    learner.update(make_batch(16))
    after = policy(observation, style)[0]
    assert (after != before).any()
    after.sum().backward()
    assert policy.trunk.head.weight.grad is not None
    assert policy.trunk._plan is None


def test_a_copy_of_a_loss_goes_its_own_way():
    """Past opponents and evaluations copy losses that a learner holds."""
    loss = make_loss()
    learner = Learner(loss, precision="bf16", actor_lr=1e-2)
    learner.update(make_batch(16))
    state = {name: value.clone() for name, value in loss.state_dict().items()}
    twin = copy.deepcopy(loss)
    other = Learner(twin, precision="bf16", actor_lr=1e-2)
    other.update(make_batch(16))
    torch.testing.assert_close(loss.state_dict(), state, rtol=0, atol=0)
    twin.load_state_dict(state)
    with other._networks():
        for flat in other._acceleration._buffers:
            torch.testing.assert_close(flat.low, [t.bfloat16() for t in flat.tensors], rtol=0, atol=0)


def test_an_error_inside_the_update_restores_the_loss(monkeypatch):
    loss = make_loss()
    learner = Learner(loss, precision="fp32")
    ordinary = loss._vmap_qnetworkN0

    def fail(batch):
        raise RuntimeError("as planned")

    monkeypatch.setattr(learner._lean, "forward", fail)
    with pytest.raises(RuntimeError, match="as planned"):
        learner.update(make_batch(16))
    assert loss._vmap_qnetworkN0 is ordinary
    assert loss.actor_network[0].module.trunk._plan is None
