import pytest
import torch
from torchrl.modules import TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from coachable.fast.accelerate import Acceleration
from coachable.training import Learner
from coachable.training.lean_sac import LeanSAC
from tests.sac_problem import make_batch, make_loss


def lean(loss):
    SoftUpdate(loss, tau=0.005)  # keeps TorchRL from warning that nothing moves the targets
    acceleration = Acceleration(loss, None)
    return LeanSAC(loss, acceleration), acceleration


def torchrl(*args, **kwargs):
    """A loss that is left to TorchRL."""
    loss = make_loss(*args, **kwargs)
    SoftUpdate(loss, tau=0.005)
    return loss


@pytest.mark.parametrize("fixed_alpha", [True, False])
@pytest.mark.parametrize("loss_function", ["l2", "smooth_l1"])
@pytest.mark.parametrize("shape", [(16,), (6, 4)])
def test_losses_equal_those_of_torchrl(shape, loss_function, fixed_alpha):
    options = {"target_entropy": -3.0, "loss_function": loss_function}
    ours, theirs = make_loss(fixed_alpha=fixed_alpha, **options), torchrl(fixed_alpha=fixed_alpha, **options)
    tensors, acceleration = lean(ours)
    batch, reference = make_batch(*shape), make_batch(*shape)
    torch.manual_seed(3)
    with acceleration.active():
        got = tensors.forward(batch)
    torch.manual_seed(3)
    expected = theirs(reference)
    for key in got:
        torch.testing.assert_close(got[key], expected[key], msg=lambda m, key=key: f"{key}: {m}")
    torch.testing.assert_close(batch["td_error"], reference["td_error"])


def test_gradients_equal_those_of_torchrl():
    ours, theirs = make_loss(), torchrl()
    tensors, acceleration = lean(ours)
    torch.manual_seed(3)
    with acceleration.active():
        got = tensors.forward(make_batch(64))
        (got["loss_actor"] + got["loss_qvalue"]).backward()
        gradients = {name: parameter.grad.clone() for name, parameter in ours.named_parameters()}
    torch.manual_seed(3)
    expected = theirs(make_batch(64))
    (expected["loss_actor"] + expected["loss_qvalue"]).backward()
    for name, parameter in theirs.named_parameters():
        torch.testing.assert_close(
            gradients[name], parameter.grad, rtol=1e-4, atol=1e-5, msg=lambda m, name=name: f"{name}: {m}"
        )


def test_n_step_discount():
    loss = make_loss()
    theirs = torchrl()
    tensors, acceleration = lean(loss)
    batch = make_batch(16)
    batch["steps_to_next_obs"] = torch.randint(1, 4, (16, 1))
    torch.manual_seed(3)
    with acceleration.active():
        got = tensors.forward(batch)
    torch.manual_seed(3)
    torch.testing.assert_close(got["loss_qvalue"], theirs(batch)["loss_qvalue"])


def test_successors_of_terminal_states_may_hold_anything():
    tensors, acceleration = lean(make_loss())
    batch = make_batch(64)
    terminal = batch["next", "terminated"].squeeze(-1)
    assert terminal.any()
    with acceleration.active():
        torch.manual_seed(3)
        expected, _ = tensors.critic_loss(batch)
        batch["next", "observation"][terminal] = float("nan")
        torch.manual_seed(3)
        got, _ = tensors.critic_loss(batch)
    torch.testing.assert_close(got, expected)


def test_truncation_bootstraps():
    tensors, acceleration = lean(make_loss())
    batch = make_batch(16)
    batch["next", "terminated"] = torch.zeros(16, 1, dtype=torch.bool)
    batch["next", "done"] = torch.ones(16, 1, dtype=torch.bool)
    with acceleration.active():
        torch.manual_seed(3)
        target = tensors._target(batch)
    assert (target != batch["next", "reward"].squeeze(-1)).all()


def test_what_it_does_not_cover_is_left_to_the_loss():
    class Other(SACLoss):
        pass

    loss = make_loss()
    assert LeanSAC.supports(loss)
    loss.__class__ = Other
    assert not LeanSAC.supports(loss)
    assert not LeanSAC.supports(make_loss(reduction="sum"))
    assert not LeanSAC.supports(make_loss(skip_done_states=True))
    for part, name, other in (
        (1, "distribution_class", TanhNormal),
        (1, "distribution_kwargs", {"low": -2.0}),
        (0, "out_keys", ["scale", "loc"]),
    ):
        loss = make_loss()
        setattr(loss.actor_network.module[part], name, other)
        assert not LeanSAC.supports(loss), name
    tensors, _ = lean(make_loss())
    batch = make_batch(8)
    assert tensors.serves(batch)
    batch["priority_weight"] = torch.ones(8)
    assert not tensors.serves(batch)
    masked = make_batch(8)
    masked["collector", "mask"] = torch.ones(8, 1, dtype=torch.bool)
    assert not tensors.serves(masked)


def test_priority_weights_count():
    """A batch with weights goes through the loss's own code: with one weight, only that record teaches."""
    batch = make_batch(16)
    batch["priority_weight"] = torch.zeros(16)
    batch["priority_weight"][5] = 1.0
    learner, theirs = Learner(make_loss(), precision="fp32"), torchrl()
    torch.manual_seed(3)
    got = learner.update(batch.clone())
    torch.manual_seed(3)
    torch.testing.assert_close(got["loss_qvalue"], theirs(batch)["loss_qvalue"].detach())
