"""Targets and policy losses of whole losses against numpy, the noise of the samples given."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from coachable.distributions.action_heads import ActionHeads
from coachable.distributions.categorical import regret_matching_probabilities
from coachable.distributions.mixed_action import MixedAction
from coachable.losses import CategoricalSACLoss, CatRACLoss, QRSACLoss
from tests.losses.cases import AXES, HEADS, OURS, Case, constant_loss, make_batch

F64 = torch.float64
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
GAMMA, ALPHA, SAMPLES = 0.9, 0.1, 20
CENTRES = np.arange(0.0, 21.0, 2.0)


def normalised_heads(weights: np.ndarray, heads: ActionHeads) -> np.ndarray:
    parts = np.split(weights, np.cumsum(heads.categorical)[:-1], -1) if heads.categorical else []
    return np.concatenate([p / p.sum(-1, keepdims=True) for p in parts], -1) if parts else weights


def hard(weights: np.ndarray, heads: ActionHeads) -> np.ndarray:
    parts = np.split(weights, np.cumsum(heads.categorical)[:-1], -1)
    return np.concatenate([(p == p.max(-1, keepdims=True)).astype(float) for p in parts], -1)


class Expected:
    """The textbook quantities of one batch, from the networks' raw outputs and the noise that the loss will draw."""

    def __init__(
        self, case: Case, loss: Any, heads: ActionHeads, states: TensorDict, *, seed: int, relaxed: bool
    ) -> None:
        self.case, self.loss, self.states, self.heads = case, loss, states, heads
        with torch.no_grad():
            emitted = loss.actor_network[:1](states.select("observation", "style"))
        torch.manual_seed(seed)
        parts, self.log_prob, entropy = [], 0.0, 0.0
        if heads.categorical:
            pi = emitted["probs"].numpy()
            race = torch.empty_like(emitted["probs"]).exponential_().clamp_min(2.0**-25).numpy()
            one_hots = normalised_heads(pi / race, heads) if relaxed else hard(pi / race, heads)
            parts.append(one_hots)
            self.log_prob = self.log_prob + (one_hots * np.log(pi)).sum(-1)
            entropy = entropy - (pi * np.log(pi)).sum(-1)
        if heads.axes:
            mu, sigma = emitted["loc"].numpy(), emitted["scale"].numpy()
            z = torch.randn_like(emitted["loc"]).numpy()
            parts.append(np.tanh(mu + sigma * z))
            self.log_prob = self.log_prob + self.density(mu, sigma, z).sum(-1)
            if "entropy_samples" in case.options:
                zs = torch.randn(heads.axes, 1, SAMPLES, dtype=F64).numpy()  # axes, states, draws
                for axis in range(heads.axes):
                    draws = [self.density(mu[..., axis], sigma[..., axis], n) for n in zs[axis, 0]]
                    entropy = entropy - np.mean(draws, 0)
        self.action = np.concatenate(parts, -1)
        self.regulariser = -entropy if "entropy_samples" in case.options else self.log_prob

    @staticmethod
    def density(mu: np.ndarray, sigma: np.ndarray, z: np.ndarray) -> np.ndarray:
        u = mu + sigma * z
        return -0.5 * z**2 - np.log(sigma) - 0.5 * np.log(2 * np.pi) + 2 * np.log(np.cosh(u))

    def outputs(self, params: Any) -> np.ndarray:
        """Raw outputs of the critics at these actions, one critic after the other."""
        inputs = self.states.select("observation", "style").set("action", torch.from_numpy(self.action))
        outputs = []
        for k in range(2):
            with torch.no_grad(), params[k].to_module(self.loss.qvalue_network):
                outputs.append(self.loss.qvalue_network(inputs.clone())["state_action_value"].numpy())
        return np.stack(outputs)

    def values(self, output: np.ndarray) -> np.ndarray:
        if self.case.critic_width == 1:
            return output[..., 0]
        if self.case.critic_width == 4:
            return output.mean(-1)
        p = np.exp(output - output.max(-1, keepdims=True))
        return (p / p.sum(-1, keepdims=True) * CENTRES).sum(-1)


@pytest.fixture(autouse=True)
def _few_samples() -> Iterator[None]:
    assert all(c.options.get("entropy_samples", SAMPLES) == SAMPLES for c in OURS)
    yield


OWN_HEADS = pytest.mark.parametrize(
    ("case", "heads"), [pytest.param(c, HEADS[h], id=f"{c.name}-{h}") for c in OURS for h in c.heads]
)


def n_step_batch(heads: ActionHeads) -> TensorDict:
    batch = make_batch(heads, (7, 3), F64)
    batch["steps_to_next_obs"] = torch.randint(1, 4, (7, 3, 1))
    return batch


@OWN_HEADS
def test_target_against_numpy(case: Case, heads: ActionHeads) -> None:
    """y = R + gamma^k (1 - d) (V' - alpha R(s')), pessimistic V', hard actions, at float64 to 1e-10."""
    loss: Any = case.loss(heads, gamma=GAMMA, alpha=ALPHA).to(F64)
    batch = n_step_batch(heads)
    after = batch["next"]
    e = Expected(case, loss, heads, after, seed=11, relaxed=False)
    output = e.outputs(loss.target_qvalue_network_params)
    values = e.values(output)
    value, regulariser = values.min(0), e.regulariser
    reward, ended = after["reward"].numpy()[..., 0], after["terminated"].numpy()[..., 0]
    discount = GAMMA ** batch["steps_to_next_obs"].numpy()[..., 0]
    if case.critic_width == 4:
        which = values.argmin(0)
        value = np.take_along_axis(output, which[None, ..., None], 0)[0]
        reward, ended, discount, regulariser = (x[..., None] for x in (reward, ended, discount, regulariser))
    y = reward + discount * (1 - ended) * (value - ALPHA * regulariser)
    torch.manual_seed(11)
    np.testing.assert_allclose(loss.compute_target(batch).numpy(), y, atol=1e-10)


@OWN_HEADS
def test_policy_loss_against_numpy(case: Case, heads: ActionHeads) -> None:
    """mean(alpha R - min_k Q_k), relaxed actions."""
    loss: Any = case.loss(heads, gamma=GAMMA, alpha=ALPHA).to(F64)
    batch = make_batch(heads, (7, 3), F64)
    e = Expected(case, loss, heads, batch, seed=12, relaxed=True)
    value = e.values(e.outputs(loss.qvalue_network_params)).min(0)
    torch.manual_seed(12)
    actual, metadata = loss.actor_loss(batch)
    assert actual.item() == pytest.approx((ALPHA * e.regulariser - value).mean(), abs=1e-10)
    np.testing.assert_allclose(metadata["log_prob"].numpy(), e.regulariser, atol=1e-10)


def test_cat_rac_by_hand() -> None:
    """r 1, gamma 0.9, values (10, 8), alpha 0.1, total entropy 2: 1 + 0.9 (8 + 0.2) = 8.38; terminated: 1."""
    case = next(c for c in OURS if c.name == "Cat-RAC")
    loss: Any = constant_loss(case, (10.0, 8.0), alpha=0.1)
    loss._sample = lambda policy, relaxed: (policy.hard_action(), torch.full(policy.batch_shape, -2.0, dtype=F64))
    batch = make_batch(AXES, (2,), F64)
    batch["next", "reward"] = torch.ones(2, 1, dtype=F64)
    batch["next", "terminated"] = torch.tensor([[False], [True]])
    np.testing.assert_allclose(loss.compute_target(batch).numpy(), [8.38, 1.0], rtol=1e-8)


def test_qr_sac_by_hand() -> None:
    """Critics (0, 4) and (1, 2): the vector of lower mean counts; the entropy is inside the discount."""
    case = Case("QR-SAC", QRSACLoss, ("axes",), 2, {"num_quantiles": 2})
    batch = make_batch(AXES, (2,), F64)
    batch["next", "reward"] = torch.ones(2, 1, dtype=F64)
    batch["next", "terminated"] = torch.tensor([[False], [True]])
    batch["steps_to_next_obs"] = torch.tensor([[2], [2]])
    loss: Any = constant_loss(case, (0.0, 0.0), gamma=0.5, alpha=0.1)
    with torch.no_grad():
        output = loss.target_qvalue_network_params["module", "output"]
        output.copy_(torch.tensor([[0.0, 4.0], [1.0, 2.0]], dtype=F64))
    loss._sample = lambda policy, relaxed: (policy.hard_action(), torch.full(policy.batch_shape, -3.0, dtype=F64))
    # y = 1 + 0.25 (z + 0.1 * 3)
    np.testing.assert_allclose(loss.compute_target(batch).numpy(), [[1.325, 1.575], [1.0, 1.0]], rtol=1e-8)


def test_kappa_reaches_the_loss() -> None:
    """At kappa 0 it is the pinball loss, whose mean over symmetric levels is half the distance."""
    case = next(c for c in OURS if c.name == "QR-SAC")
    batch = make_batch(AXES, (5,), F64)
    batch["next", "terminated"] = torch.ones(5, 1, dtype=torch.bool)
    pinball = constant_loss(case, kappa=0.0).qvalue_loss(batch)[0].item()
    reward = batch["next", "reward"]
    assert pinball == pytest.approx(sum(0.5 * (reward - v).abs().mean().item() for v in (10.0, 8.0)))


def test_clipped_fraction_is_reported() -> None:
    """Two -500 penalties can leave the support."""
    for kind in (CatRACLoss, CategoricalSACLoss):
        case = next(c for c in OURS if c.build is kind)
        loss: Any = constant_loss(case)
        batch = make_batch(AXES, (4,), F64)
        batch["next", "terminated"] = torch.ones(4, 1, dtype=torch.bool)
        batch["next", "reward"] = torch.tensor([[-1000.0], [5.0], [22.0], [-1.0]], dtype=F64)
        _, metadata = loss.qvalue_loss(batch)
        assert metadata["clipped_fraction"].item() == 0.5
        assert loss(batch)["clipped_fraction"].item() == 0.5


def test_policy_gradient_of_categorical_heads() -> None:
    """Constant critics leave the entropy: x moves by the regret alpha (-H - log pi), exactly for RAC."""
    heads = ActionHeads((3,))
    x = torch.tensor([2.0, 1.0, 0.5], dtype=F64, requires_grad=True)
    case = next(c for c in OURS if c.name == "RAC")
    pi = regret_matching_probabilities(x, heads.layout)
    loss: Any = constant_loss(case, alpha=0.1)
    loss._policy_at = lambda td: constant_distribution(heads, pi.expand(*td.batch_size, 3))
    loss.actor_loss(make_batch(AXES, (5,), F64))[0].backward()
    p = pi.detach()
    entropy = -(p * p.log()).sum()
    torch.testing.assert_close(x.grad, -0.1 * (-entropy - p.log()), rtol=1e-8, atol=1e-10)


def constant_distribution(heads: ActionHeads, probs: torch.Tensor) -> MixedAction:
    return MixedAction(probs, heads=heads)


def test_one_sample_entropy_of_categorical_sac_is_unbiased_in_the_target() -> None:
    """Its log-density of hard samples averages to RAC's exact entropy."""
    torch.manual_seed(0)
    heads = ActionHeads((3, 2))
    probs = torch.tensor([0.5, 0.3, 0.2, 0.9, 0.1], dtype=F64)
    policy = constant_distribution(heads, probs.expand(50_000, 5))
    _, log_prob = policy.hard_sample()
    exact = policy.entropy_estimate()
    assert -log_prob.mean().item() == pytest.approx(exact[0].item(), abs=5 * log_prob.std().item() / 50_000**0.5)
