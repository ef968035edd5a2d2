"""The policy as the losses read it, against the distribution that the actor itself builds."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    NormalParamExtractor,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import nn
from torchrl.data import Bounded, OneHot, Unbounded
from torchrl.modules import ProbabilisticActor, TanhNormal

from coachable.distributions.action_heads import ActionHeads, MixedActionSpec
from coachable.losses.policy import PolicyReader
from coachable.networks.mixed import make_mixed_actor


def tanh_normal_actor(**bounds):
    """One of TorchRL's own policies: three axes."""
    torch.manual_seed(0)
    body = nn.Sequential(nn.Linear(4, 6), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(body, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs=bounds,
    )


@pytest.mark.parametrize("bounds", [{}, {"low": -1.0, "high": torch.ones(3)}], ids=["default", "ones"])
def test_a_tanh_normal_has_the_same_density_and_mode(bounds):
    actor = tanh_normal_actor(**bounds)
    data = TensorDict({"observation": torch.randn(64, 4)}, [64])
    theirs = actor.get_dist(data.clone())
    ours = PolicyReader(actor, "test", continuous_only=True).read(data)
    action = 1.8 * torch.rand(64, 3) - 0.9
    torch.testing.assert_close(ours.log_prob(action), theirs.log_prob(action), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours.deterministic_sample, theirs.deterministic_sample, rtol=1e-4, atol=1e-5)
    assert list(data.keys()) == ["observation"]
    with torch.no_grad():
        assert torch.equal(ours.deterministic_sample, torch.tanh(ours.loc))


@pytest.mark.parametrize(
    "bounds",
    [
        {"low": torch.tensor([-1.0, -1.0, -2.0]), "high": torch.ones(3)},
        {"low": -1.0, "high": torch.tensor([1.0, 3.0, 1.0])},
        {"low": -2.0, "high": 2.0},
    ],
    ids=["low", "high", "equal"],
)
def test_other_bounds_are_refused(bounds):
    with pytest.raises(ValueError, match=r"Loss serves actions in \[-1, 1\], but the actor has (low|high)=.*: rescale"):
        PolicyReader(tanh_normal_actor(**bounds), "Loss", continuous_only=True)


def test_a_policy_of_several_modules_is_read_to_its_end():
    torch.manual_seed(0)
    first = TensorDictModule(nn.Linear(4, 5), in_keys=["observation"], out_keys=["hidden"])
    second = nn.Sequential(nn.Linear(5, 6), NormalParamExtractor())
    actor = ProbabilisticTensorDictSequential(
        first,
        TensorDictModule(second, in_keys=["hidden"], out_keys=["loc", "scale"]),
        ProbabilisticTensorDictModule(in_keys=["loc", "scale"], out_keys=["action"], distribution_class=TanhNormal),
    )
    data = TensorDict({"observation": torch.randn(9, 4)}, [9])
    ours = PolicyReader(actor, "test", continuous_only=True).read(data)
    torch.testing.assert_close(ours.deterministic_sample, actor.get_dist(data.clone()).deterministic_sample)


def test_actors_that_the_losses_cannot_serve_are_refused():
    with pytest.raises(ValueError, match="needs a ProbabilisticActor, got Linear"):
        PolicyReader(nn.Linear(2, 2), "Loss", continuous_only=False)
    with pytest.raises(ValueError, match=r"without tanh_loc\), not TanhNormal"):
        PolicyReader(tanh_normal_actor(tanh_loc=True), "Loss", continuous_only=False)
    PolicyReader(tanh_normal_actor(tanh_loc=False), "Loss", continuous_only=True)
    buttons = make_mixed_actor(4, ActionHeads((3, 2)), None, widths=(8,))
    PolicyReader(buttons, "Loss", continuous_only=False)
    with pytest.raises(ValueError, match=r"Loss serves continuous actions only.*\(3, 2\)"):
        PolicyReader(buttons, "Loss", continuous_only=True)


def test_specs_must_be_those_of_the_actor():
    axes, buttons = tanh_normal_actor(), make_mixed_actor(4, ActionHeads((3, 2)), None, widths=(8,))

    def read(actor, spec):
        PolicyReader(actor, "Loss", continuous_only=False, action_spec=spec)

    for spec in (None, Bounded(-1.0, 1.0, (3,)), Unbounded((3,))):
        read(axes, spec)
    read(buttons, MixedActionSpec(ActionHeads((3, 2))))
    for actor, spec in ((buttons, Bounded(-1.0, 1.0, (5,))), (axes, OneHot(3)), (buttons, OneHot(5))):
        with pytest.raises(ValueError, match="cannot serve the action spec"):
            read(actor, spec)
    for actor in (axes, buttons):
        with pytest.raises(ValueError, match="the environment's action is"):
            read(actor, MixedActionSpec(ActionHeads((2, 3))))
