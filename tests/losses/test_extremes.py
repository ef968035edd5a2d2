"""No NaN, whatever networks and environments emit."""

from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict.nn import TensorDictModule

from coachable.distributions.categorical import regret_matching_probabilities
from tests.losses.cases import HEADS, OURS, Case, ConstantCritic, constant_actor, gradients, make_batch

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

PREFERENCES = {
    "all negative": [-5.0, -1e30, -1e-30, -2.0, -3.0],
    "one atom": [1e30, -1.0, -1.0, 0.0, 1e20],
    "zeros": [0.0] * 5,
    "tiny": [1e-30, -1e-30, 1e-38, 1e-20, 0.0],
}
# Location and scale before the tanh; sigma is within e^-2 .. e^2 for our actors, users may go further.
AXES = {"saturated": (60.0, 0.1353), "wide": (-3.0, 7.389), "huge": (1e4, 1e3), "needle": (0.1, 1e-5)}


@pytest.mark.parametrize(
    ("case", "heads"), [pytest.param(c, HEADS[h], id=f"{c.name}-{h}") for c in OURS for h in c.heads]
)
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    preferences=st.sampled_from(list(PREFERENCES)),
    axes=st.sampled_from(list(AXES)),
    reward=st.sampled_from([0.0, -1e6, 1e6, 5000.0, -600.0, 1e12]),
    output=st.sampled_from([0.0, 1e4, -1e4, 1e6]),
    seed=st.integers(0, 2**31),
)
def test_extreme_inputs(
    case: Case, heads: Any, preferences: str, axes: str, reward: float, output: float, seed: int
) -> None:
    parameters: dict[str, torch.Tensor] = {}
    if heads.categorical:
        parameters["probs"] = regret_matching_probabilities(torch.tensor(PREFERENCES[preferences]), heads.layout)
    if heads.axes:
        parameters["loc"], parameters["scale"] = (torch.full((heads.axes,), x) for x in AXES[axes])
    critics = []
    for sign in (1.0, -1.0):
        raw = torch.zeros(case.critic_width)
        raw[case.critic_width // 2] = sign * output  # all mass on one atom, or on all others
        module = ConstantCritic(raw)
        critics.append(TensorDictModule(module, in_keys=["observation", "action"], out_keys=["state_action_value"]))
    loss = case.wrap(constant_actor(heads, **parameters), critics)
    batch = make_batch(heads, (4, 2), seed=seed)
    batch["next", "reward"] = torch.full((4, 2, 1), reward)
    out = loss(batch)
    assert out["loss_actor"].isfinite() and out["loss_qvalue"].isfinite() and batch["td_error"].isfinite().all()
    (out["loss_actor"] + out["loss_qvalue"]).backward()
    assert all(g.isfinite().all() for g in gradients(loss, ""))
