import copy
import functools
import math

import pytest
import torch
from torchrl.objectives import SACLoss, SoftUpdate

from coachable.training.learner import Learner, NonFiniteLossError
from coachable.training.precision import resolve_precision
from tests import sac_problem
from tests.sac_problem import ACT, make_batch, make_loss


@pytest.fixture(params=["plain", "fast"])
def make_learner(request):
    """Every property of an update holds in plain torch and with the hand-written passes."""
    return functools.partial(sac_problem.make_learner, fast=request.param == "fast")


def params_of(loss):
    return {k: v.detach().clone() for k, v in loss.named_parameters()}


@pytest.mark.parametrize("shape", [(16,), (8, 3)])
@pytest.mark.parametrize("order", ["simultaneous", "policy_first"])
def test_update_returns_detached_scalars_and_moves_everything(make_learner, order, shape):
    learner = make_learner(make_loss(), update_order=order, precision="fp32", actor_lr=1e-3, critic_lr=1e-3)
    before = params_of(learner.loss_module)
    targets = learner.loss_module.target_qvalue_network_params.clone()
    batch = make_batch(*shape)
    metrics = learner.update(batch)
    for key in ("loss_actor", "loss_qvalue", "grad_norm_actor", "grad_norm_critic", "entropy", "alpha", "q_policy"):
        assert metrics[key].shape == ()
        assert not metrics[key].requires_grad
        assert torch.isfinite(metrics[key])
    after = params_of(learner.loss_module)
    assert all((after[k] != before[k]).any() for k in before)
    assert not (learner.loss_module.target_qvalue_network_params == targets).all()
    assert batch["td_error"].shape == shape
    assert learner.updates == 1


def test_target_networks_follow_by_polyak_averaging(make_learner):
    learner = make_learner(make_loss(), precision="fp32", critic_lr=1e-2, tau=0.25)
    old = learner.loss_module.target_qvalue_network_params.clone().flatten_keys()
    learner.update(make_batch(16))
    new = learner.loss_module.target_qvalue_network_params.flatten_keys()
    live = learner.loss_module.qvalue_network_params.flatten_keys()
    for key in old.keys():  # noqa: SIM118  # iterating a tensordict goes along its batch
        torch.testing.assert_close(new[key], 0.75 * old[key] + 0.25 * live[key].detach())


def reference_update(loss, batch, lr, eps, order):
    """The update written out with plain TorchRL calls."""
    actor = torch.optim.Adam(loss.actor_network_params.values(True, True), lr=lr, eps=eps)
    critic = torch.optim.Adam(loss.qvalue_network_params.values(True, True), lr=lr, eps=eps)
    targets = SoftUpdate(loss, tau=0.005)

    def step_critic():
        loss_qvalue, _ = loss.qvalue_v2_loss(batch)
        critic.zero_grad()
        loss_qvalue.backward()
        critic.step()

    def step_actor():
        loss_actor, _ = loss.actor_loss(batch)
        actor.zero_grad()
        loss_actor.backward()
        actor.step()

    if order == "simultaneous":
        losses = loss(batch)
        (losses["loss_actor"] + losses["loss_qvalue"]).backward()
        actor.step()
        critic.step()
    elif order == "policy_first":
        step_actor()
        step_critic()
    else:
        step_critic()
        step_actor()
    targets.step()


@pytest.mark.parametrize("order", ["simultaneous", "policy_first"])
def test_update_equals_the_written_out_update(make_learner, order):
    ours, theirs = make_loss(), make_loss()
    learner = make_learner(ours, update_order=order, precision="fp32", actor_lr=1e-3, critic_lr=1e-3)
    torch.manual_seed(5)
    learner.update(make_batch(32))
    torch.manual_seed(5)
    reference_update(theirs, make_batch(32), 1e-3, 1e-7, order)
    for (name, a), (_, b) in zip(ours.named_parameters(), theirs.named_parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5, msg=lambda m, name=name: f"{name}: {m}")


@pytest.mark.parametrize("order", ["simultaneous", "policy_first"])
def test_the_logged_entropy_is_that_of_the_policy(make_learner, order):
    """A squashed normal of location 0 has log(2 pi e s^2) / 2 + E[log(1 - tanh(s z)^2)] per axis."""
    loss = make_loss(width=4)
    with torch.no_grad():
        for parameter in loss.actor_network_params.values(True, True):
            parameter.zero_()  # the same location and scale for every state
    batch = make_batch(4096)
    with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
        scale = loss.actor_network.get_dist(batch[:1].clone()).scale[0, 0].double()
    metrics = make_learner(loss, update_order=order, precision="fp32").update(batch)
    z = torch.linspace(-12.0, 12.0, 20_001, dtype=torch.float64)
    density = torch.exp(-z.square() / 2) / (2 * torch.pi) ** 0.5
    shrunk = 2.0 * (math.log(2.0) - scale * z - torch.nn.functional.softplus(-2.0 * scale * z))
    per_axis = 0.5 * torch.log(2.0 * torch.pi * math.e * scale**2) + torch.trapezoid(density * shrunk, z)
    assert metrics["entropy"].item() == pytest.approx(ACT * per_axis.item(), abs=5 * 1.2 * (ACT / 4096) ** 0.5)


def test_orders_see_different_parameters(make_learner):
    """policy_first draws the target's actions from the updated policy; simultaneous from the one before."""

    class Spy(SACLoss):
        def qvalue_v2_loss(self, td):
            self.seen = [p.detach().clone() for p in self.actor_network_params.values(True, True)]
            return super().qvalue_v2_loss(td)

    for order, updated in (("simultaneous", False), ("policy_first", True)):
        loss = make_loss()
        loss.__class__ = Spy
        before = [p.detach().clone() for p in loss.actor_network_params.values(True, True)]
        make_learner(loss, update_order=order, precision="fp32").update(make_batch(16))
        assert any((a != b).any() for a, b in zip(before, loss.seen, strict=True)) is updated


def test_gradients_are_clipped_separately_and_norms_are_those_before_clipping(make_learner):
    batch = make_batch(16)
    learner = make_learner(make_loss(), precision="fp32")
    torch.manual_seed(3)
    free = learner.update(batch.clone())
    clipped = make_learner(make_loss(), precision="fp32", max_grad_norm=1e-3)
    seen = {}
    for name, optimizer in clipped.optimizers.items():
        optimizer.register_step_pre_hook(
            lambda opt, args, kwargs, name=name: seen.__setitem__(
                name, torch.cat([p.grad.flatten() for g in opt.param_groups for p in g["params"]]).norm()
            )
        )
    torch.manual_seed(3)
    metrics = clipped.update(batch.clone())
    torch.testing.assert_close(metrics["grad_norm_actor"], free["grad_norm_actor"])
    torch.testing.assert_close(metrics["grad_norm_critic"], free["grad_norm_critic"])
    torch.testing.assert_close(seen["actor"], torch.tensor(1e-3), rtol=1e-3, atol=0)
    torch.testing.assert_close(seen["critic"], torch.tensor(1e-3), rtol=1e-3, atol=0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e30])
@pytest.mark.parametrize("order", ["simultaneous", "policy_first"])
def test_a_loss_that_is_not_finite_reaches_no_weight(make_learner, order, bad):
    learner = make_learner(make_loss(), precision="fp32", update_order=order)
    before = copy.deepcopy(learner.state_dict())
    data = make_batch(16)
    data["next", "reward"][3] = bad
    with pytest.raises(NonFiniteLossError, match=r"loss_qvalue is (nan|inf).* at update 1: no weight was changed"):
        learner.update(data)
    after = learner.state_dict()
    assert after["updates"] == 0
    for name, value in before["loss_module"].items():
        assert torch.isfinite(value).all()
        if order != "policy_first" or not name.startswith("actor"):  # the policy's own gradient was finite
            assert torch.equal(value, after["loss_module"][name]), name
    metrics = learner.update(make_batch(16))  # nothing is left over
    assert all(torch.isfinite(value) for value in metrics.values())


def test_weights_that_are_not_finite_are_noticed_at_the_first_update(make_learner):
    """Also behind a rectifier, which turns NaN into nothing in the loss but not in the gradients."""
    loss = make_loss()
    next(iter(loss.actor_network_params.values(True, True))).data.view(-1)[0] = float("nan")
    with pytest.raises(NonFiniteLossError, match="at update 1"):
        make_learner(loss, precision="fp32").update(make_batch(16))


def test_a_temperature_that_is_not_finite_does_not_move(make_learner):
    loss = make_loss(fixed_alpha=False, target_entropy=-3.0)
    learner = make_learner(loss, precision="fp32", update_order="policy_first")
    before = loss.log_alpha.item()
    learner._params["alpha"][0].register_hook(lambda grad: grad * float("nan"))
    with pytest.raises(NonFiniteLossError, match="grad_norm_alpha is nan"):
        learner.update(make_batch(16))
    assert loss.log_alpha.item() == before


def test_a_gpu_skips_the_step_and_the_next_check_raises(monkeypatch):
    """The part of the device, on a CPU, whose fused Adam also skips a step where `found_inf` is set."""
    monkeypatch.setattr("coachable.training.learner.CHECK_EVERY", 2)
    learner = Learner(make_loss(), precision="fp32")
    learner._device_type = "cuda"
    before = copy.deepcopy(learner.state_dict())
    data = make_batch(16)
    data["next", "reward"][3] = float("nan")
    learner.update(data)
    for name, value in learner.state_dict()["loss_module"].items():
        assert torch.isfinite(value).all()
        if name.startswith("qvalue"):
            assert torch.equal(value, before["loss_module"][name]), name
    with pytest.raises(NonFiniteLossError, match="at or before update 2"):
        learner.update(make_batch(16))
    learner.check_finite()
    after = learner.state_dict()["loss_module"]
    assert any((value != before["loss_module"][name]).any() for name, value in after.items())


def test_a_checkpoint_does_not_replace_settings_of_the_optimisers(make_learner):
    before = make_learner(make_loss(), precision="fp32", actor_lr=1e-3, adam_eps=1e-7)
    before.update(make_batch(16))
    after = make_learner(make_loss(), precision="fp32", actor_lr=1e-2, adam_eps=0.25)
    after.load_state_dict(before.state_dict())
    assert [after.optimizers["actor"].param_groups[0][key] for key in ("lr", "eps")] == [1e-2, 0.25]


def test_a_copy_scales_the_same_entropy_weight(make_learner):
    learner = make_learner(make_loss(), precision="fp32")
    alpha = learner.loss_module.log_alpha.exp().item()
    learner.scale_entropy_weight(0.5)
    twin = copy.deepcopy(learner)
    twin.scale_entropy_weight(0.5)
    assert twin.loss_module.log_alpha.exp().item() == pytest.approx(alpha / 2)


@pytest.mark.parametrize("order", ["simultaneous", "policy_first"])
def test_resumed_equals_uninterrupted(make_learner, order):
    def run(learner, seeds):
        for seed in seeds:
            torch.manual_seed(seed)
            learner.update(make_batch(16, seed=seed))

    one = make_learner(make_loss(), update_order=order)
    run(one, range(6))
    two = make_learner(make_loss(), update_order=order)
    run(two, range(3))
    state = copy.deepcopy(two.state_dict())
    three = make_learner(make_loss(seed=9), update_order=order)
    three.load_state_dict(state)
    assert three.updates == 3
    run(three, range(3, 6))
    for (name, a), (_, b) in zip(
        one.loss_module.state_dict().items(), three.loss_module.state_dict().items(), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=0, msg=lambda m, name=name: f"{name}: {m}")


def test_learned_temperature_moves(make_learner):
    loss = make_loss(fixed_alpha=False, target_entropy=-3.0)
    before = loss.log_alpha.item()
    for order in ("simultaneous", "policy_first"):
        make_learner(loss, update_order=order, precision="fp32", alpha_lr=1e-2).update(make_batch(16))
        assert loss.log_alpha.item() != before
        before = loss.log_alpha.item()


def test_bf16_gradients_point_where_fp32_gradients_point(make_learner):
    grads = {}
    for precision in ("fp32", "bf16"):
        loss = make_loss(width=128)
        learner = make_learner(loss, precision=precision)
        for name, optimizer in learner.optimizers.items():
            optimizer.register_step_pre_hook(
                lambda opt, args, kwargs, key=(precision, name): grads.__setitem__(
                    key, torch.cat([p.grad.flatten().float() for g in opt.param_groups for p in g["params"]])
                )
            )
        torch.manual_seed(2)
        learner.update(make_batch(64))
    for name in ("actor", "critic"):
        cosine = torch.cosine_similarity(grads["fp32", name], grads["bf16", name], dim=0)
        assert cosine > 0.99


def test_bad_options_raise():
    loss = make_loss()
    with pytest.raises(ValueError, match="update_order"):
        Learner(loss, update_order="actor_first")
    with pytest.raises(ValueError, match="precision"):
        Learner(loss, precision="fp16")
    with pytest.raises(ValueError, match="tau"):
        Learner(loss, tau=0.0)
    with pytest.raises(ValueError, match="max_grad_norm"):
        Learner(loss, max_grad_norm=-1.0)
    loss.log_alpha.fill_(math.nan)
    with pytest.raises(ValueError, match="alpha of the loss is below 0"):
        Learner(loss)
    loss = make_loss()
    loss.make_value_estimator(gamma=1.5)
    with pytest.raises(ValueError, match=r"gamma of the loss is 1.5: expected a number in \[0, 1\]"):
        Learner(loss)
    assert resolve_precision("bf16") == "bf16"


def test_loss_is_as_it_was_outside_of_updates(make_learner):
    loss = make_loss()
    learner = make_learner(loss, precision="bf16")
    learner.update(make_batch(16))
    torch.manual_seed(3)
    with_learner = loss(make_batch(16))
    fresh = make_loss(seed=4)
    SoftUpdate(fresh, tau=0.005)
    fresh.load_state_dict(loss.state_dict())
    torch.manual_seed(3)
    without = fresh(make_batch(16))
    for key in ("loss_actor", "loss_qvalue", "entropy"):
        torch.testing.assert_close(with_learner[key], without[key], rtol=0, atol=0)


def test_loading_parameters_into_the_loss_takes_effect(make_learner):
    """Rounded copies must not outlive the parameters they were made from."""
    loss, other = make_loss(), make_loss(seed=7)
    learner = make_learner(loss, precision="bf16", actor_lr=0.0, critic_lr=0.0)
    learner.update(make_batch(16))
    loss.load_state_dict(other.state_dict())
    torch.manual_seed(3)
    got = learner.update(make_batch(16))
    torch.manual_seed(3)
    expected = make_learner(other, precision="bf16").update(make_batch(16))
    torch.testing.assert_close(got["loss_qvalue"], expected["loss_qvalue"])
    torch.testing.assert_close(got["loss_actor"], expected["loss_actor"])


def test_two_learners_may_share_a_loss_one_after_the_other(make_learner):
    loss = make_loss()
    for order in ("simultaneous", "policy_first"):
        learner = make_learner(loss, update_order=order, precision="bf16")
        before = params_of(loss)
        learner.update(make_batch(16))
        assert all((params_of(loss)[k] != before[k]).any() for k in before)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_both_precisions_learn_to_follow_the_style(make_learner, precision):
    """A bandit, reward -|a - style / 2|: after 100 updates the policy's action follows the style."""
    loss = make_loss(width=64)
    learner = make_learner(loss, precision=precision, actor_lr=4e-3, critic_lr=8e-3)
    gen = torch.Generator().manual_seed(0)
    for _ in range(100):
        batch = make_batch(128, seed=int(torch.randint(1 << 30, (), generator=gen)))
        batch["style"] = batch["next", "style"] = torch.rand(128, 2, generator=gen) * 2 - 1
        batch["action"] = torch.rand(128, 3, generator=gen) * 2 - 1
        distance = (batch["action"][:, :2] - 0.5 * batch["style"]).abs().sum(-1, keepdim=True)
        batch["next", "reward"] = -distance
        batch["next", "terminated"] = torch.ones(128, 1, dtype=torch.bool)
        learner.update(batch)
    test = make_batch(500, seed=5)
    test["style"] = torch.rand(500, 2, generator=gen) * 2 - 1
    with torch.no_grad():
        loc, _ = loss.actor_network[0].module(test["observation"], test["style"])
    error = (torch.tanh(loc)[:, :2] - 0.5 * test["style"]).abs().mean()
    assert error < 0.15, f"mean distance {error:.3f}; 0.33 without regard to the style"


def test_compile_without_a_compiler_is_logged_and_left(monkeypatch, caplog):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    Learner(make_loss(), precision="fp32", compile=True).update(make_batch(16))
    assert "needs a C++ compiler" in caplog.text


def test_compile_takes_the_losses_where_there_is_a_compiler(monkeypatch, tmp_path):
    compiler, compiled = tmp_path / "compiler", []
    compiler.touch(mode=0o755)
    monkeypatch.setenv("CXX", str(compiler))
    monkeypatch.setattr(torch, "compile", lambda function: compiled.append(function) or function)
    loss = make_loss()
    learner = Learner(loss, precision="fp32", compile=True)
    learner.update(make_batch(16))
    learner.update(make_batch(16))
    assert compiled == [loss.forward, loss.actor_loss, loss.qvalue_v2_loss]
