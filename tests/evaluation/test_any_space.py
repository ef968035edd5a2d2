"""Evaluation and report of a domain that declares nothing but its styles, whatever kinds they are of."""

import pytest
import torch
from tensordict.nn import TensorDictModule

from coachable.domain import Domain
from coachable.evaluation import evaluate as evaluation
from coachable.evaluation.report import write_report
from coachable.styles import Choice, Setpoint, StyleReward, StyleSpace, Term, Weight
from coachable.training.weights import LoadedPolicy
from tests.echo import StyleEchoEnv

SPACES = {
    "a choice": [Choice("hat", ("on", "off"))],
    "many weights": [Weight(f"w{i}", -1.0, 1.0) for i in range(4)],
    "two set-points": [Setpoint("pace", 0.0, 1.0, unit="m/s"), Setpoint("height", 0.0, 2.0)],
    "everything": [Choice("hat", ("on", "off")), Setpoint("pace", 0.0, 1.0), Weight("fire", 0.0, 3.0)],
}


@pytest.mark.parametrize("kind", SPACES)
def test_evaluation_and_report(kind, tmp_path, monkeypatch):
    space = StyleSpace(SPACES[kind])
    terms = {name: Term(lambda features, style: features[..., 0], parameters=(name,)) for name in space.names}
    domain = Domain("any", StyleEchoEnv, lambda: space, lambda space: StyleReward(space, terms))
    policy = TensorDictModule(lambda style: style[..., :1].clamp(-1, 1), in_keys=["style"], out_keys=["action"])
    agent = LoadedPolicy(policy, space, {}, {"domain": "any", "source": "nowhere", "frames": None, "updates": None})
    monkeypatch.setattr(evaluation, "load_policy", lambda source: agent)
    monkeypatch.setattr(evaluation, "domain_of", lambda agent: domain)
    torch.manual_seed(0)
    options = {"episodes": 1, "switch_episodes": 1, "steps": 3, "progress": False}
    text = evaluation.evaluate("nowhere", tmp_path / "evaluation", **options)
    assert all(name in text for name in space.names) and "survived" in text
    assert (tmp_path / "evaluation" / "grid.png").stat().st_size > 1000
    assert "survived" in write_report(domain, {"any": agent}, tmp_path / "report", seeds=1, sweep_points=2, **options)
