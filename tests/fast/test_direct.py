"""The gradients of sac.c against those of the loss modules on the same passes."""

import math

import pytest
import torch
from torchrl.modules import ValueOperator
from torchrl.objectives import SACLoss

from coachable.fast import accelerate
from coachable.fast.direct import has_direct_gradients
from coachable.fast.native import load_sac
from coachable.losses import QRSACLoss
from coachable.networks import ResidualMLP, make_critic, make_gaussian_actor
from coachable.training import Learner
from coachable.training.learner import NonFiniteLossError
from tests.sac_problem import ACT, OBS, WIDTHS, ScaledStyle, cat_rac, make_batch, make_learner, make_loss, qr_sac

PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16}


def learnt_temperature():
    return make_loss(fixed_alpha=False, target_entropy=-3.0)


def narrow_huber():
    critics = [make_critic(OBS, ACT, ScaledStyle(), WIDTHS, num_outputs=3) for _ in range(3)]
    actor = make_gaussian_actor(OBS, ACT, ScaledStyle(), (20,), log_scale_range=(-2.0, 1.0))
    return QRSACLoss(actor, critics, num_quantiles=3, num_qvalue_nets=3, kappa=0.1)


LOSSES = [make_loss, learnt_temperature, qr_sac, narrow_huber]


@pytest.fixture(params=PRECISIONS)
def accelerated(request):
    """Makes accelerated learners of one precision."""
    if load_sac(PRECISIONS[request.param]) is None:
        pytest.skip(f"no C compiler, or no vector instructions for {request.param}")

    def make(build, **options):
        torch.manual_seed(0)
        learner = Learner(build(), precision=request.param, **options)
        assert accelerate(learner)
        return learner

    return make


def plain(learner):
    """The same learner with the loss module on hand-written passes."""
    assert learner.backend._direct is not None
    learner.backend._direct = None
    return learner


@pytest.fixture(params=[1, 2])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    "key, shape, message",
    [
        ("observation", (64, 9), "11 columns: the network has 9 inputs"),
        (("next", "observation"), (64, 2), "4 columns: the network has 9 inputs"),
        ("action", (64, 1), r"action has the shape \(64, 1\): expected 64 rows of 3"),
        (("next", "reward"), (64, 2), r"reward has the shape \(64, 2\)"),
        (("next", "terminated"), (64, 3), r"terminated has the shape \(64, 3\)"),
    ],
)
def test_entries_of_another_width_are_refused(key, shape, message, accelerated):
    """sac.c would read beyond their ends."""
    batch = make_batch(64)
    batch.set(key, batch[key].new_zeros(shape))
    with pytest.raises(ValueError, match=message):
        accelerated(make_loss).update(batch)


def test_settings_that_the_loss_gets_later_are_followed():
    if load_sac(torch.float32) is None:
        pytest.skip("no C compiler, or no vector instructions")
    results = []
    for fast in (True, False):
        learner = make_learner(make_loss(), fast, precision="fp32")
        learner.loss_module.loss_function = "smooth_l1"
        torch.manual_seed(0)
        results.append(learner.update(make_batch(64))["loss_qvalue"])
    torch.testing.assert_close(*results)


@pytest.mark.parametrize("shape", [(96,), (35,), (16, 3), (1,)])
@pytest.mark.parametrize("order", ["simultaneous", "policy_first"])
@pytest.mark.parametrize("build", LOSSES)
def test_updates_equal_those_of_the_loss_module(build, order, shape, threads, accelerated):
    """Metrics, TD errors, parameters and targets after two updates, from the same random numbers."""
    ours, theirs = accelerated(build, update_order=order), plain(accelerated(build, update_order=order))
    for seed in range(2):
        results, errors = [], []
        for learner in (ours, theirs):
            torch.manual_seed(seed)
            batch = make_batch(*shape, seed=seed)
            results.append(learner.update(batch))
            errors.append(batch["td_error"])
        assert results[0].keys() == results[1].keys()
        for name, expected in results[1].items():
            torch.testing.assert_close(results[0][name], expected, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(*errors, rtol=1e-4, atol=1e-5)
    for name, expected in theirs.loss_module.state_dict().items():
        # Adam's first steps are signs of the gradients, so that one of rounding errors may go either way.
        differs = (ours.loss_module.state_dict()[name] - expected).abs() > 2e-5
        assert differs.float().mean() < 0.01, name


def test_sums_over_several_steps_are_discounted_by_their_number(accelerated):
    results = []
    for learner in (accelerated(make_loss), plain(accelerated(make_loss))):
        batch = make_batch(64)
        batch["steps_to_next_obs"] = torch.arange(64).view(64, 1) % 5 + 1
        torch.manual_seed(1)
        results.append(learner.update(batch)["loss_qvalue"])
    torch.testing.assert_close(*results, rtol=1e-5, atol=1e-6)
    torch.manual_seed(1)
    assert not torch.isclose(accelerated(make_loss).update(make_batch(64))["loss_qvalue"], results[0])


def test_networks_without_style(accelerated):
    def build():
        critics = [make_critic(OBS, ACT, None, WIDTHS) for _ in range(2)]
        loss = make_loss()
        return type(loss)(make_gaussian_actor(OBS, ACT, None, WIDTHS), critics, loss_function="l2", fixed_alpha=True)

    results = []
    for learner in (accelerated(build), plain(accelerated(build))):
        torch.manual_seed(1)
        results.append(learner.update(make_batch(64)))
    torch.testing.assert_close(*results, rtol=1e-4, atol=1e-5)


def test_the_value_of_a_terminal_state_does_not_count(accelerated):
    learner = accelerated(make_loss)
    batch = make_batch(32)
    batch["next", "terminated"][:] = True
    for parameter in learner.loss_module.target_qvalue_network_params.values(True, True):
        parameter.data.fill_(math.inf)
    learner.backend.follow()
    assert learner.update(batch)["loss_qvalue"].isfinite()


@pytest.mark.parametrize("network", ["actor_network_params", "qvalue_network_params"])
def test_numbers_that_are_not_finite_are_noticed(network, accelerated):
    learner = accelerated(make_loss)
    with torch.no_grad():
        next(iter(getattr(learner.loss_module, network).values(True, True))).fill_(math.nan)
    with pytest.raises(NonFiniteLossError, match=r"nan at update 1: no weight was changed"):
        learner.update(make_batch(32))


def test_what_sac_c_does_not_compute_is_left_to_the_loss_module(accelerated):
    assert accelerated(cat_rac).backend._direct is None
    assert accelerated(lambda: make_loss(loss_function="smooth_l1")).backend._direct is None
    assert accelerated(lambda: make_loss(width=33)).backend._direct is None
    assert accelerated(lambda: make_loss(reduction="sum")).backend._direct is None

    class Mine(QRSACLoss):
        pass

    assert not has_direct_gradients(
        Mine(
            make_gaussian_actor(OBS, ACT, ScaledStyle(), WIDTHS),
            [make_critic(OBS, ACT, ScaledStyle(), WIDTHS, num_outputs=32) for _ in range(2)],
        )
    )


def test_weighted_batches_are_left_to_the_loss_module(accelerated):
    results = []
    for learner in (accelerated(make_loss), plain(accelerated(make_loss))):
        batch = make_batch(32)
        batch["priority_weight"] = torch.linspace(0, 1, 32)
        torch.manual_seed(1)
        results.append(learner.update(batch))
    torch.testing.assert_close(*results, rtol=0, atol=0)


def test_masked_batches_are_left_to_the_loss_module(accelerated):
    results = []
    for learner in (accelerated(make_loss), plain(accelerated(make_loss))):
        batch = make_batch(32)
        batch["collector", "mask"] = torch.arange(32) < 16
        torch.manual_seed(1)
        results.append(learner.update(batch))
    torch.testing.assert_close(*results, rtol=0, atol=0)


def test_residual_critics_that_read_no_style_are_served_by_the_general_passes():
    def build():
        torch.manual_seed(0)
        critics = [ValueOperator(ResidualMLP(OBS + ACT, 1, (16,)), in_keys=["observation", "action"]) for _ in range(2)]
        actor = make_gaussian_actor(OBS, ACT, ScaledStyle(), WIDTHS)
        loss = SACLoss(actor, critics, num_qvalue_nets=2, loss_function="l2", action_spec=actor.spec)
        loss.make_value_estimator(gamma=0.9)
        return loss

    ours, theirs = Learner(build(), precision="fp32"), Learner(build(), precision="fp32")
    assert accelerate(ours) and ours.backend._direct is None
    for learner in (ours, theirs):
        torch.manual_seed(1)
        learner.update(make_batch(32))
    for name, expected in theirs.loss_module.state_dict().items():
        torch.testing.assert_close(ours.loss_module.state_dict()[name], expected, rtol=1e-3, atol=1e-4, msg=name)


def test_a_loss_whose_parameters_moved_is_followed(accelerated):
    ours, theirs = accelerated(make_loss), plain(accelerated(make_loss))
    for learner in (ours, theirs):
        learner.loss_module.share_memory()
        torch.manual_seed(1)
        learner.update(make_batch(32))
    for name, expected in theirs.loss_module.state_dict().items():
        assert ((ours.loss_module.state_dict()[name] - expected).abs() > 2e-5).float().mean() < 0.01, name
