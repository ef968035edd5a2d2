"""Rankings of inputs, on functions whose sensitivities are known."""

import csv
import dataclasses
import sys

import numpy as np
import pytest
import torch

from coachable.cli import main
from coachable.contract.exported_model import OnnxPolicy
from coachable.distributions.action_heads import ActionHeads
from coachable.domain import load_domain
from coachable.evaluation.attribution import Group, input_groups, rank_groups
from coachable.evaluation.explain import explain, record_states
from coachable.networks import make_gaussian_actor
from coachable.networks.mixed import make_mixed_actor
from coachable.networks.plain import ActionOutputs
from coachable.styles import Choice, Setpoint, StyleSpace
from coachable.training.weights import load_policy

pytest.importorskip("captum")

SPACE = StyleSpace([Choice("hat", ("red", "blue")), Setpoint("speed", 0.0, 2.0)])
GROUPS = [
    Group("pair", slice(0, 2), False),
    Group("constant", slice(2, 3), False),
    Group("style: s", slice(3, 4), True),
]
WEIGHTS = torch.tensor([[1.0, 0.0], [-3.0, 0.0], [8.0, 8.0], [0.0, 5.0]])  # four inputs, two outputs


def linear(x):
    return x @ WEIGHTS


def trajectories(count=10, length=30):
    """Entries of the pair are equal, ±1; the third input never changes; the style is ±1 per trajectory."""
    generator = torch.Generator().manual_seed(0)
    rows = []
    for i in range(count):
        pair = torch.randint(2, (length, 1), generator=generator).mul(2.0).sub(1.0).expand(-1, 2)
        rows.append(torch.cat([pair, torch.ones(length, 1), torch.full((length, 1), 1.0 if i % 2 else -1.0)], -1))
    return rows


@pytest.fixture(scope="module")
def rankings():
    return {ranking.method: ranking for ranking in rank_groups(linear, trajectories(), GROUPS, progress=False)}


def test_saliency_is_the_mean_absolute_derivative(rankings):
    saliency = rankings["saliency"]
    assert [group.name for group in saliency.groups] == ["constant", "style: s", "pair"]
    # Over two outputs and the group's entries: (8 + 8) / 2, (0 + 5) / 2, ((1 + 3) / 2 + 0) / 2
    np.testing.assert_allclose(saliency.means, [8.0, 2.5, 1.0])
    np.testing.assert_allclose(saliency.deviations, 0.0, atol=1e-12)


def test_shap_is_what_a_group_contributes(rankings):
    """An input that never changes contributes nothing, however steep; entries of a group may cancel."""
    shap = rankings["SHAP"]
    assert [group.name for group in shap.groups] == ["style: s", "pair", "constant"]
    # |w (x - mean of the baselines)|, baselines ±1: 5 for the style's output, |1 - 3| for the pair's, over two outputs.
    np.testing.assert_allclose(shap.means, [2.5, 1.0, 0.0], rtol=0.15, atol=1e-6)


def test_the_same_seed_gives_the_same_ranking(rankings):
    torch.manual_seed(123)
    before = torch.get_rng_state()
    again = {ranking.method: ranking for ranking in rank_groups(linear, trajectories(), GROUPS, progress=False)}
    for method, ranking in rankings.items():
        np.testing.assert_array_equal(again[method].means, ranking.means)
    assert torch.equal(torch.get_rng_state(), before)
    other = rank_groups(linear, trajectories(), GROUPS, seed=1, progress=False)[0]
    assert not np.array_equal(other.means, rankings["SHAP"].means)


def test_outputs_of_a_gaussian_policy_are_its_action():
    actor = make_gaussian_actor(3, 2, SPACE, widths=(8,))
    observation, theta = torch.randn(5, 3), SPACE.sample((5,))
    expected = torch.tanh(actor.module[0].module(observation, theta)[0])
    torch.testing.assert_close(ActionOutputs(actor)(torch.cat([observation, SPACE.encode(theta)], -1)), expected)


def test_outputs_of_a_mixed_policy_have_their_true_derivative():
    outputs = ActionOutputs(make_mixed_actor(3, ActionHeads((3,), axes=1), SPACE, widths=(8,))).double()
    inputs = torch.randn(4, 6, dtype=torch.float64, requires_grad=True)
    assert outputs(inputs).shape == (4, 4)
    torch.testing.assert_close(outputs(inputs)[:, :3].sum(-1), torch.ones(4, dtype=torch.float64))
    assert torch.autograd.gradcheck(outputs, (inputs,))


def test_groups_are_the_domains_and_one_per_style_parameter():
    domain = load_domain("humanoid")
    groups = input_groups(domain, domain.make_space(), 82)
    assert groups[0] == Group("joint_angles", slice(0, 21), False)
    assert groups[-2:] == [Group("style: pose", slice(82, 85), True), Group("style: step_length", slice(85, 86), True)]
    bare = dataclasses.replace(domain, observation_groups=())
    assert [g.name for g in input_groups(bare, domain.make_space(), 2)[:2]] == ["observation 0", "observation 1"]
    with pytest.raises(ValueError, match="cover 82 entries, the policy observes 80"):
        input_groups(domain, domain.make_space(), 80)


def test_recorded_states_come_from_living_agents():
    agent = load_policy("humanoid")
    options = {"steps": 20, "num_threads": 1, "progress": False}
    recorded = record_states(load_domain("humanoid"), agent, episodes=3, states=4, **options)
    assert [trajectory.shape for trajectory in recorded] == [(4, 86)] * 3
    for trajectory in recorded:
        assert (trajectory[:, 82:] == trajectory[0, 82:]).all()  # one style per trajectory
        assert len(torch.unique(trajectory[:, 0])) == 4
    theta = agent.space.sample((3,), torch.Generator().manual_seed(0))
    torch.testing.assert_close(torch.stack([t[0, 82:] for t in recorded]), agent.space.encode(theta))


def test_the_command_writes_table_and_figure(tmp_path, capsys):
    arguments = ["explain", "humanoid", "--episodes", "2", "--states", "2", "--steps", "4", "--threads", "1"]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    assert "| rank | SHAP |" in capsys.readouterr().out
    with (tmp_path / "explain.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 14
    assert {row["kind"] for row in rows} == {"style", "observation"}
    for method in ("SHAP", "saliency"):
        means = [float(row["mean"]) for row in rows if row["method"] == method]
        assert means == sorted(means, reverse=True)
    assert {path.name for path in tmp_path.iterdir()} == {"explain.csv", "explain.md", "explain.png"}


def test_a_missing_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "captum.attr", None)
    with pytest.raises(ImportError, match=r"pip install 'coachable\[explain\]'"):
        explain("humanoid", tmp_path)


def test_too_few_episodes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="at least 2 episodes"):
        explain("humanoid", tmp_path, episodes=1)


def test_exported_models_have_no_gradients(tmp_path, monkeypatch):
    agent = load_policy("humanoid")._replace(actor=OnnxPolicy.__new__(OnnxPolicy))
    monkeypatch.setattr("coachable.evaluation.explain.load_policy", lambda source: agent)
    with pytest.raises(ValueError, match="is an exported model, which has no gradients: expected a run's"):
        explain("walker.onnx", tmp_path)
