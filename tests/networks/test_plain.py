"""Policies as plain functions, against the actors that they come from."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coachable.distributions.action_heads import ActionHeads
from coachable.networks import make_gaussian_actor
from coachable.networks.mixed import make_mixed_actor
from coachable.networks.plain import ActionOutputs, DeterministicAction, policy_network
from coachable.styles import StyleSpace, Weight

SPACE = StyleSpace([Weight("calm", 0.0, 4.0), Weight("bold", -1.0, 1.0)])


def acted(actor, observation, style):
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return actor(TensorDict({"observation": observation, "style": style}, observation.shape[:1]))


def test_a_gaussian_policy_gives_its_action():
    torch.manual_seed(0)
    actor = make_gaussian_actor(3, 2, SPACE, widths=(8,))
    plain, outputs = DeterministicAction(actor), ActionOutputs(actor)
    assert (plain.output_names, plain.choice_sizes) == (("action",), ())
    assert (plain.observation_dim, plain.style_dim) == (3, 2)
    observation, style = torch.randn(6, 3), SPACE.sample((6,))
    expected = acted(actor, observation, style)["action"]
    (found,) = plain(observation, style)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(outputs(torch.cat([observation, SPACE.encode(style)], -1)), expected)


@pytest.mark.parametrize("heads", [ActionHeads((4, 2)), ActionHeads((3,), axes=2), ActionHeads(axes=2)])
def test_a_mixed_policy_gives_the_components_that_exist(heads):
    torch.manual_seed(0)
    actor = make_mixed_actor(3, heads, SPACE, widths=(8,))
    plain, outputs = DeterministicAction(actor), ActionOutputs(actor)
    observation, style = torch.randn(6, 3), SPACE.sample((6,))
    data = acted(actor, observation, style)
    found = dict(zip(plain.output_names, plain(observation, style), strict=True))
    assert set(found) == ({"axes"} if heads.axes else set()) | (
        {"choices", "probabilities"} if heads.categorical else set()
    )
    assert plain.choice_sizes == heads.categorical
    parts = []
    if heads.categorical:
        torch.testing.assert_close(found["probabilities"], data["probs"])
        assert torch.equal(found["choices"], heads.choices(data["action"]))
        parts.append(data["probs"])
    if heads.axes:
        torch.testing.assert_close(found["axes"], heads.split(data["action"])[1])
        parts.append(heads.split(data["action"])[1])
    encoded = torch.cat([observation, SPACE.encode(style)], -1)
    torch.testing.assert_close(outputs(encoded), torch.cat(parts, -1))


def test_exactly_one_policy_that_reads_a_style_is_expected():
    actor = make_gaussian_actor(3, 2, SPACE, widths=(8,))
    assert policy_network(actor) is actor.module[0].module
    with pytest.raises(ValueError, match="holds 0 policies that read a style"):
        policy_network(make_gaussian_actor(3, 2, None, widths=(8,)))
    two = TensorDictSequential(actor, make_gaussian_actor(3, 2, SPACE, widths=(8,)))
    with pytest.raises(ValueError, match="holds 2 policies that read a style"):
        policy_network(two)


def test_a_policy_without_style_acts_on_the_observation_alone():
    actor = make_gaussian_actor(3, 2, None, widths=(8,))
    assert list(actor.in_keys) == ["observation"]
    assert actor(TensorDict({"observation": torch.randn(5, 3)}, [5]))["action"].shape == (5, 2)
    assert actor.module[0].module.trunk.in_features == 3
