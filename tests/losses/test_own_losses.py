"""What the losses of this library do beyond the contract: numerics, policies and networks that they serve."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal

from coachable.networks import make_critic, make_gaussian_actor
from coachable.networks.mixed import make_mixed_actor
from tests.losses.cases import AXES, HEADS, OBS, OWN, Case, PlainSpace, constant_loss, critic_loss, make_batch

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


@OWN
def test_autocast_leaves_the_numerics_alone(case: Case) -> None:
    """With constant networks nothing is left for bfloat16 to round."""
    loss = constant_loss(case, (10.0, 6.0)).float()
    outputs = []
    for enabled in (False, True):
        batch = make_batch(AXES, (32,))
        torch.manual_seed(0)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
            out = loss(batch)
        outputs.append((out["loss_actor"], out["loss_qvalue"], batch["td_error"]))
    assert all(torch.equal(a, b) for a, b in zip(*outputs, strict=True))


@OWN
def test_target_uses_the_policy_as_it_is(case: Case) -> None:
    """Stepping the policy between the parts changes the target; forward uses one set of parameters for both."""
    heads = HEADS[case.heads[-1]]
    loss, batch = case.loss(heads), make_batch(heads, (16,))
    seen: list[dict[str, torch.Tensor]] = []
    read = loss._policy.read  # type: ignore[union-attr]

    def spy(td: TensorDict) -> Any:
        policy = read(td)
        seen.append({n: p.detach().clone() for n in ("probs", "loc") if (p := getattr(policy, n)) is not None})
        return policy

    loss._policy.read = spy  # type: ignore[method-assign, union-attr]
    optimizer = torch.optim.SGD(list(loss.actor_network_params.parameters()), lr=0.5)
    loss.compute_target(batch)
    value, _ = loss.actor_loss(batch)
    value.backward()
    optimizer.step()
    loss.qvalue_loss(batch)
    before, _, after = seen
    assert all(not torch.allclose(before[n], after[n]) for n in before)
    torch.manual_seed(5)
    joint = loss(batch.clone())
    torch.manual_seed(5)
    critic, actor = loss.qvalue_loss(batch)[0], loss.actor_loss(batch)[0]
    assert torch.equal(joint["loss_qvalue"], critic) and torch.equal(joint["loss_actor"], actor)


@OWN
def test_gaussian_actors_are_served(case: Case) -> None:
    actor = make_gaussian_actor(OBS, 2, PlainSpace(), (16,))
    loss = case.wrap(actor, [case.critic(AXES), case.critic(AXES)])
    assert loss(make_batch(AXES))["loss_qvalue"].isfinite()
    wide = ProbabilisticActor(
        actor.module[0],
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": torch.tensor([-2.0, 0.0]), "high": torch.tensor([2.0, 10.0])},
    )
    with pytest.raises(ValueError, match=r"serves actions in \[-1, 1\], but the actor has low="):
        case.wrap(wide, [case.critic(AXES), case.critic(AXES)])


@OWN
def test_dropout_rests_in_the_target(case: Case) -> None:
    """Also in a batch of critics. While learning, policy and critics drop units."""
    heads = HEADS[case.heads[-1]]
    actor = make_mixed_actor(OBS, heads, PlainSpace(), (16,), dropout=0.5)
    critics = [
        make_critic(OBS, heads.action_dim, PlainSpace(), (16,), num_outputs=case.critic_width, dropout=0.5)
        for _ in range(2)
    ]
    loss = case.wrap(actor, critics)
    dropped: list[nn.Module] = []
    for network in (actor, critics[0]):  # whose modules the loss evaluates all critics with
        for module in network.modules():
            if isinstance(module, nn.Dropout):
                module.register_forward_hook(lambda m, _, __: dropped.append(m))
    loss.compute_target(make_batch(heads))
    assert not dropped
    loss.actor_loss(make_batch(heads))
    assert len(set(dropped)) == 2
    dropped.clear()
    critic_loss(loss, make_batch(heads))
    assert len(set(dropped)) == 1


@OWN
def test_dispatch_and_key_lists(case: Case) -> None:
    heads = HEADS[case.heads[-1]]
    loss, batch = case.loss(heads), make_batch(heads)
    assert set(loss.in_keys) >= {"observation", "style", "action", ("next", "reward"), ("next", "terminated")}
    assert set(loss.out_keys) == {"loss_actor", "loss_qvalue", "alpha", "entropy"}
    flat = {k if isinstance(k, str) else "_".join(k): batch[k] for k in loss.in_keys}
    assert all(v.isfinite() for v in loss(**flat))
