"""Bad input of losses: one clear error each, at construction."""

import math
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, OneHot
from torchrl.modules import IndependentNormal, ProbabilisticActor

from coachable.losses import CategoricalSACLoss, CatRACLoss, QRSACLoss, RACLoss
from coachable.networks import make_critic
from coachable.networks.mixed import make_mixed_actor
from tests.losses.cases import AXES, BINS, BUTTONS, CASES, MIXED, OBS, PlainSpace, make_batch

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

BAD_OPTIONS = [
    (QRSACLoss, {"num_quantiles": 0}, "num_quantiles is 0: expected a whole number of at least 1"),
    (QRSACLoss, {"kappa": -1.0}, "kappa is -1.0: expected a number of at least 0"),
    (RACLoss, {"entropy_samples": 0}, "entropy_samples is 0: expected a whole number of at least 1"),
    (RACLoss, {"entropy_samples": -3}, "entropy_samples is -3: expected a whole number of at least 1"),
    (RACLoss, {"alpha": 0.0}, "alpha is 0.0: expected a number above 0"),
    (RACLoss, {"alpha": math.nan}, "alpha is nan: expected a number above 0"),
    (RACLoss, {"num_qvalue_nets": 3}, r"got 2 critic\(s\) for num_qvalue_nets=3"),
    (RACLoss, {"num_qvalue_nets": 0}, r"num_qvalue_nets=0"),
    (RACLoss, {"action_spec": OneHot(4)}, "cannot serve the action spec OneHot"),
    (RACLoss, {"action_spec": MIXED.spec()}, "the environment's action is"),
    (CatRACLoss, {"v_min": 1.0, "v_max": 1.0}, "v_min must be less than v_max"),
    (CatRACLoss, {"v_min": 5.0, "v_max": -5.0}, "v_min must be less than v_max"),
    (CatRACLoss, {"num_atoms": 0}, "num_atoms must be an integer of at least 2"),
    (CatRACLoss, {"sigma_ratio": -1.0}, "sigma_ratio must be positive"),
    (CategoricalSACLoss, {"entropy_samples": 5}, "use CatRACLoss"),
]


def test_the_default_support_is_the_papers() -> None:
    critics = [make_critic(OBS, 2, PlainSpace(), (8,), num_outputs=255) for _ in range(2)]
    bins = CatRACLoss(make_mixed_actor(OBS, AXES, PlainSpace(), (8,)), critics).bins
    assert (bins.v_min, bins.v_max, bins.num_atoms) == (-600.0, 1000.0, 255)  # paper, Cat-RAC


@pytest.mark.parametrize(("kind", "options", "message"), BAD_OPTIONS, ids=lambda x: str(x)[:40])
def test_bad_options(kind: Any, options: dict[str, Any], message: str) -> None:
    critics = [make_critic(OBS, 2, PlainSpace(), (8,)) for _ in range(2)]
    with pytest.raises(ValueError, match=message):
        kind(make_mixed_actor(OBS, AXES, PlainSpace(), (8,)), critics, **options)


def test_action_spaces_that_cannot_be_served() -> None:
    critics = [make_critic(OBS, 5, PlainSpace(), (8,)) for _ in range(2)]
    with pytest.raises(ValueError, match=r"QRSACLoss serves continuous actions only.*\(3, 2\)"):
        QRSACLoss(make_mixed_actor(OBS, BUTTONS, PlainSpace(), (8,)), critics)
    with pytest.raises(ValueError, match="cannot serve the action spec"):
        CatRACLoss(make_mixed_actor(OBS, BUTTONS, PlainSpace(), (8,)), critics, action_spec=Bounded(-1, 1, (5,)))
    unbounded = ProbabilisticActor(
        TensorDictModule(nn.Identity(), in_keys=["observation"], out_keys=["loc"]),
        in_keys=["loc"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"scale": 1.0},
    )
    with pytest.raises(ValueError, match="RACLoss serves positive-part categorical heads and tanh-Gaussian axes"):
        RACLoss(unbounded, critics)
    with pytest.raises(ValueError, match="needs a ProbabilisticActor"):
        RACLoss(nn.Linear(2, 2), critics)  # type: ignore[arg-type]


def test_critics_of_another_width() -> None:
    critics = [make_critic(OBS, 2, PlainSpace(), (8,), num_outputs=5) for _ in range(2)]
    loss = QRSACLoss(make_mixed_actor(OBS, AXES, PlainSpace(), (8,)), critics)
    with pytest.raises(RuntimeError, match="expects critics with 32 output"):
        loss(make_batch(AXES))


@pytest.mark.parametrize(
    ("method", "result", "message"),
    [
        ("_next_value", lambda output: output, r"_next_value returned the shape \(2, 8, 32\): expected \(8, 32\)"),
        ("_next_value", lambda output: output.mean(), r"_next_value returned the shape \(\): expected \(8,\)"),
        ("_values", lambda output: output.mean(-1, keepdim=True), r"_values .* \(2, 8, 1\): expected \(2, 8\)"),
        ("_errors", lambda output, target: (output, output[..., 0]), r"_errors .* \(2, 8, 32\): expected \(2, 8\)"),
        ("_errors", lambda output, target: (output[..., 0], output), r"_errors .* \(2, 8, 32\): expected \(2, 8\)"),
        (
            "_sample",
            lambda policy, relaxed: (policy.hard_action(), policy.loc),
            r"_sample .* \(8, 2\): expected \(8,\)",
        ),
    ],
)
def test_methods_of_an_own_loss_that_return_another_shape(method: str, result: Any, message: str) -> None:
    """It would broadcast, and train on sums over other states."""
    kind: Any = type("OwnLoss", (QRSACLoss,), {method: staticmethod(result)})
    critics = [make_critic(OBS, 2, PlainSpace(), (8,), num_outputs=32) for _ in range(2)]
    loss = kind(make_mixed_actor(OBS, AXES, PlainSpace(), (8,)), critics)
    with pytest.raises(RuntimeError, match="OwnLoss." + message):
        loss(make_batch(AXES, (8,)))


def test_a_single_critic() -> None:
    critic = make_critic(OBS, 2, PlainSpace(), (8,))
    actor = make_mixed_actor(OBS, AXES, PlainSpace(), (8,))
    with pytest.raises(ValueError, match="num_qvalue_nets=2"):
        RACLoss(actor, critic)
    weight = critic.module.trunk.head.weight.detach().clone()
    loss = RACLoss(actor, [critic], num_qvalue_nets=1)
    for params in (loss.qvalue_network_params, loss.target_qvalue_network_params):
        assert torch.equal(params["module", "trunk", "head", "weight"][0], weight)  # not drawn again
    loss(make_batch(AXES))["loss_qvalue"].backward()
    with pytest.raises(ValueError, match="the same critic more than once"):
        RACLoss(actor, [critic, critic])
    critics = [p for name, p in loss.named_parameters() if name.startswith("qvalue_network_params")]
    assert len(critics) == len(list(critic.parameters()))
    assert all(p.grad is not None and p.grad.isfinite().all() for p in critics)


@pytest.mark.parametrize("arguments", [{"lmbda": 0.9}, {"average_rewards": True}])
def test_only_td0(arguments: dict[str, Any]) -> None:
    loss = CASES[2].loss(AXES)
    with pytest.raises(ValueError, match="takes gamma alone"):
        loss.make_value_estimator(gamma=0.9, **arguments)
    assert BINS["num_atoms"] == 11
