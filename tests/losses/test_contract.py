"""What every loss has to do, TorchRL's SAC included."""

from typing import Any

import pytest
import torch
from scipy.stats import norm
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import TensorDictPrioritizedReplayBuffer
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import SoftUpdate

from coachable.distributions.mixed_action import MixedAction
from coachable.networks.mixed import make_mixed_actor
from tests.losses.cases import (
    AXES,
    CASES,
    HEADS,
    NO_ENTROPY,
    OBS,
    OWN,
    Case,
    PlainSpace,
    constant_loss,
    critic_loss,
    end_all,
    gradients,
    make_batch,
)

F64 = torch.float64
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

ALL = pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
WITH_HEADS = pytest.mark.parametrize(
    ("case", "heads"),
    [pytest.param(c, HEADS[h], id=f"{c.name}-{h}") for c in CASES for h in c.heads],
)


def one_step(terminated: bool, truncated: bool = False, dtype: torch.dtype = F64) -> TensorDict:
    """A transition of reward 1."""
    batch = make_batch(AXES, (1,), dtype)
    batch["next", "reward"] = torch.ones(1, 1, dtype=dtype)
    for key, flag in (("terminated", terminated), ("truncated", truncated), ("done", terminated or truncated)):
        batch["next", key] = torch.tensor([[flag]])
    return batch


def expected_losses(case: Case, y: float, values: tuple[float, float]) -> tuple[float, list[torch.Tensor]]:
    """Critic loss and gradient with respect to each critic's constant output, by hand."""
    if case.critic_width == 1:
        factor = 1.0 if case.name == "SAC" else 0.5  # TorchRL's squared error has no half
        return sum(factor * (v - y) ** 2 for v in values), [
            torch.tensor([2 * factor * (v - y)], dtype=F64) for v in values
        ]
    if case.critic_width == 4:
        # u = y - v for every pair. The mean over i of |tau_i - 1{u<0}| is 1/2; here |u| > 1, so L = |u| - 1/2.
        assert all(abs(y - v) > 1 for v in values)
        loss = sum(0.5 * (abs(y - v) - 0.5) for v in values)
        tau = torch.tensor([1, 3, 5, 7], dtype=F64) / 8
        return loss, [(-tau if y > v else 1 - tau) / 4 for v in values]
    # Cross-entropy of logits that are 100 at the value's atom, 0 elsewhere: 100 (1 - p_atom).
    edges = torch.arange(12) * 2.0 - 1
    mass = torch.from_numpy(norm.cdf(edges, loc=min(max(y, -1), 21), scale=1.5)).diff()
    p = mass / mass.sum()
    loss, grads = 0.0, []
    for v in values:
        softmax = torch.zeros(11, dtype=F64)
        softmax[round(v / 2)] = 1.0
        loss += 100 * (1 - p[round(v / 2)].item())
        grads.append(softmax - p)
    return loss, grads


@ALL
@pytest.mark.parametrize(
    ("terminated", "truncated", "y"), [(False, False, 8.2), (True, False, 1.0), (False, True, 8.2)]
)
def test_target_loss_and_gradient_of_constant_critics(case: Case, terminated: bool, truncated: bool, y: float) -> None:
    """Critics 10 and 8, r 1, gamma 0.9, no entropy: y = 1 + 0.9 min(10, 8), or 1 at a terminal."""
    values = (10.0, -20.0) if case.critic_width == 4 else (10.0, 8.0)
    y = 1 - 0.9 * 20 if case.critic_width == 4 and not terminated else y
    loss = constant_loss(case, values, alpha=NO_ENTROPY)
    value, metadata = critic_loss(loss, one_step(terminated, truncated))
    expected, expected_gradients = expected_losses(case, y, values)
    tolerance = 1e-10 if case.ours else 1e-6  # TorchRL rounds gamma to float32
    assert value.item() == pytest.approx(expected, rel=tolerance)
    assert metadata["td_error"].item() == pytest.approx(max(abs(v - y) for v in values), rel=tolerance)
    value.backward()
    (gradient,) = gradients(loss, "qvalue_network_params")
    for k in range(2):
        expected_gradient = expected_gradients[k].to(F64).expand(case.critic_width)
        torch.testing.assert_close(gradient[k], expected_gradient, rtol=tolerance, atol=1e-10)


@ALL
def test_policy_loss_of_constant_critics(case: Case) -> None:
    """L = alpha R - min(10, 8); the critics give no gradient, the entropy of N(0, 1) after tanh pulls at the scale."""
    loss = constant_loss(case, alpha=NO_ENTROPY)
    value, _ = loss.actor_loss(make_batch(AXES, (50,), F64))
    assert value.item() == pytest.approx(-8.0, rel=1e-12)
    torch.manual_seed(0)
    options = {"entropy_samples": 1000} if "entropy_samples" in case.options else {}
    loss = constant_loss(case, alpha=0.5, **options)
    value, metadata = loss.actor_loss(make_batch(AXES, (4000,), F64))
    assert value.item() == pytest.approx(0.5 * metadata["log_prob"].mean().item() - 8, rel=1e-7)
    # Two axes of entropy 0.669804, sd 0.218 per sample; at least 1000 samples.
    assert -metadata["log_prob"].mean().item() == pytest.approx(2 * 0.669804, abs=5 * 2 * 0.218 / 1000**0.5)
    value.backward()
    by_loc, by_scale = gradients(loss, "actor_network_params")
    # dR/dloc = E 2 tanh = 0, dR/dscale = -1 + E 2 Z tanh(Z) = 0.211; standard deviations below 1.3 per sample.
    assert by_loc.abs().max() < 0.5 * 5 * 1.3 / 1000**0.5
    torch.testing.assert_close(
        by_scale, torch.full((2,), 0.5 * 0.2115, dtype=F64), atol=0.5 * 5 * 1.3 / 1000**0.5, rtol=0
    )


@WITH_HEADS
def test_gradients_stay_in_their_part(case: Case, heads: Any) -> None:
    loss = case.loss(heads)
    loss.actor_loss(make_batch(heads))[0].backward()
    assert all(g.abs().sum() == 0 for g in gradients(loss, "qvalue_network_params"))
    assert sum(g.abs().sum().item() for g in gradients(loss, "actor_network_params")) > 0
    loss.zero_grad(set_to_none=True)
    critic_loss(loss, make_batch(heads))[0].backward()
    assert all(g.abs().sum() == 0 for g in gradients(loss, "actor_network_params"))
    assert all(g.abs().sum() > 0 for g in gradients(loss, "qvalue_network_params"))
    loss.zero_grad(set_to_none=True)
    out = loss(make_batch(heads))
    (out["loss_actor"] + out["loss_qvalue"]).backward()
    together = [g.clone() for g in gradients(loss, "")]
    assert all(g.isfinite().all() for g in together) and all(g.abs().sum() > 0 for g in together)
    assert not any(t.requires_grad for t in loss.target_qvalue_network_params.values(True, True))


@WITH_HEADS
def test_input_is_left_alone(case: Case, heads: Any) -> None:
    loss, batch = case.loss(heads), make_batch(heads, (4, 3))
    before = batch.clone()
    loss(batch)
    written = set(batch.keys(True, True)) - set(before.keys(True, True))
    assert written == ({"td_error"} if case.ours else {"td_error", "loc", "scale"})  # TorchRL adds parameters
    assert batch["td_error"].shape == (4, 3) and not batch["td_error"].requires_grad
    assert (batch.exclude(*written) == before).all()
    before = batch.clone()
    loss.actor_loss(batch)
    critic_loss(loss, batch)
    assert (batch == before).all() and set(batch.keys(True, True)) == set(before.keys(True, True))


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c.name, marks=() if c.ours else pytest.mark.xfail(reason="TorchRL multiplies by 1 - d"))
        for c in CASES
    ],
)
def test_nan_after_the_end_does_not_leak(case: Case) -> None:
    loss, batch = case.loss(HEADS[case.heads[-1]]), make_batch(HEADS[case.heads[-1]], (20,))
    ended = batch["next", "terminated"].squeeze(-1)
    assert ended.any() and not ended.all()
    batch["next", "observation"][ended] = float("nan")
    out = loss(batch)
    assert out["loss_qvalue"].isfinite() and batch["td_error"].isfinite().all()
    (out["loss_actor"] + out["loss_qvalue"]).backward()
    assert all(g.isfinite().all() for g in gradients(loss, ""))


@WITH_HEADS
def test_labels_are_more_batch(case: Case, heads: Any) -> None:
    """[B, n + 1] gives what the flattened batch gives, and a batch of one works."""
    loss, batch = case.loss(heads), end_all(make_batch(heads, (4, 3)))
    folded, meta = critic_loss(loss, batch)
    flat, flat_meta = critic_loss(loss, batch.reshape(-1))
    torch.testing.assert_close(folded, flat)
    torch.testing.assert_close(meta["td_error"].flatten(), flat_meta["td_error"])
    single = loss(make_batch(heads, (1,)))
    assert single["loss_qvalue"].isfinite() and single["loss_actor"].isfinite()
    value, meta = loss.actor_loss(batch)
    assert value.shape == () and meta["log_prob"].shape == (4, 3)


@ALL
def test_priority_weights(case: Case) -> None:
    heads = HEADS[case.heads[-1]]
    loss, batch = case.loss(heads), end_all(make_batch(heads, (5, 2)))
    losses = torch.stack([critic_loss(loss, one)[0] for one in batch.reshape(10, 1).unbind(0)]).view(5, 2)
    torch.testing.assert_close(critic_loss(loss, batch)[0], losses.mean())
    weights = torch.rand(5, 2)
    batch["priority_weight"] = weights
    expected = (losses * weights).sum() / weights.sum()  # TorchRL's weighted mean
    torch.testing.assert_close(critic_loss(loss, batch)[0], expected)
    assert loss.actor_loss(batch)[0].isfinite()


@OWN
def test_one_priority_weight_per_record(case: Case) -> None:
    heads = HEADS[case.heads[-1]]
    loss, batch = case.loss(heads), end_all(make_batch(heads, (5, 2)))
    weights = torch.rand(5, 1)
    batch["priority_weight"] = weights.expand(5, 2)
    expected = critic_loss(loss, batch)[0]
    batch["priority_weight"] = weights.expand(5, 2).unsqueeze(-1)
    torch.testing.assert_close(critic_loss(loss, batch)[0], expected)
    losses, record = torch.rand(5, 2), TensorDict({"priority_weight": weights}, [5])
    torch.testing.assert_close(loss._reduced(losses, record), (losses * weights).sum() / (2 * weights.sum()))


@ALL
def test_renamed_and_nested_keys(case: Case) -> None:
    heads = HEADS[case.heads[-1]]
    names: dict[Any, Any] = {
        "observation": ("agent", "obs"),
        "action": ("agent", "act"),
        "reward": ("agent", "gain"),
        "done": ("flags", "over"),
        "terminated": ("flags", "dead"),
    }
    body, head = make_mixed_actor(OBS, heads, PlainSpace(), (16, 16)).module
    actor = ProbabilisticActor(
        TensorDictModule(body.module, in_keys=[names["observation"], "style"], out_keys=body.out_keys),
        in_keys=head.in_keys,
        out_keys=[names["action"]],
        distribution_class=MixedAction,
        distribution_kwargs={"heads": heads},
    )
    critics = []
    for _ in range(2):
        module = case.critic(heads)
        keys = [names["observation"], names["action"], "style"]
        critics.append(ValueOperator(module.module, in_keys=keys, out_keys=[("agent", "q")]))
    loss = case.wrap(actor, critics)
    loss.set_keys(
        **{key: names[key] for key in ("action", "reward", "done", "terminated")},
        state_action_value=("agent", "q"),
        priority="surprise",
        priority_weight="importance",
    )
    plain = case.loss(heads)
    plain.load_state_dict(loss.state_dict())
    batch = make_batch(heads, (8,))
    renamed = batch.clone()
    for old, new in names.items():
        for prefix in ((), ("next",)):
            if (*prefix, old) in renamed.keys(True, True) or (not prefix and old in renamed):
                target = new if isinstance(new, tuple) else (new,)
                renamed.rename_key_((*prefix, old) if prefix else old, (*prefix, *target))
    renamed["importance"] = torch.ones(8)
    torch.manual_seed(1)
    expected = plain(batch)
    torch.manual_seed(1)
    out = loss(renamed)
    for key in ("loss_actor", "loss_qvalue"):
        torch.testing.assert_close(out[key], expected[key])
    torch.testing.assert_close(renamed["surprise"], batch["td_error"])


@ALL
def test_state_dict_round_trip(case: Case) -> None:
    heads = HEADS[case.heads[-1]]
    first, second = case.loss(heads), case.loss(heads)
    with torch.no_grad():
        for p in first.target_qvalue_network_params.values(True, True):
            p.add_(0.01)
    second.load_state_dict(first.state_dict())
    outputs = []
    for loss in (first, second):
        torch.manual_seed(0)
        outputs.append(loss(make_batch(heads)))
    for key in ("loss_actor", "loss_qvalue", "entropy", "alpha"):
        assert torch.equal(outputs[0][key], outputs[1][key])


@ALL
def test_target_networks_follow(case: Case) -> None:
    heads = HEADS[case.heads[-1]]
    loss = case.loss(heads)
    updater = SoftUpdate(loss, tau=0.25)
    before = loss.target_qvalue_network_params.clone()
    with torch.no_grad():
        for p in loss.qvalue_network_params.values(True, True):
            p.add_(1.0)
    updater.step()
    moved = loss.target_qvalue_network_params.clone()
    for a, b in zip(before.values(True, True), moved.values(True, True), strict=True):
        torch.testing.assert_close(b, a + 0.25, rtol=1e-4, atol=1e-5)


@ALL
def test_priorities_reach_a_buffer_key(case: Case) -> None:
    """`td_error` has one entry per sample, where TorchRL's prioritised buffers look for it."""
    assert TensorDictPrioritizedReplayBuffer  # the buffer itself needs an extension that may not load
    heads = HEADS[case.heads[-1]]
    batch = make_batch(heads, (7,))
    case.loss(heads)(batch)
    assert batch["td_error"].shape == (7,) and (batch["td_error"] >= 0).all()


@WITH_HEADS
def test_bfloat16_autocast(case: Case, heads: Any) -> None:
    loss, batch = case.loss(heads), make_batch(heads, (32,))
    torch.manual_seed(0)
    exact = loss(batch)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.manual_seed(0)
        out = loss(batch)
    assert out["loss_actor"].dtype == out["loss_qvalue"].dtype == torch.float32
    torch.testing.assert_close(out["loss_qvalue"], exact["loss_qvalue"], rtol=0.1, atol=0.1)
    (out["loss_actor"] + out["loss_qvalue"]).backward()
    assert all(g.isfinite().all() for g in gradients(loss, ""))


@OWN
def test_outputs_are_selected(case):
    loss, batch = constant_loss(case), make_batch(AXES, (6,), F64)
    loss.select_out_keys("loss_actor", "loss_qvalue")
    assert set(loss(batch).keys()) == {"loss_actor", "loss_qvalue"}
    loss.reset_out_keys()
    assert {"alpha", "entropy"} < set(loss(batch).keys())
