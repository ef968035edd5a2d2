"""Evaluation and report of a domain that declares nothing but its styles, whatever kinds they are of."""

import pytest
import torch
from tensordict.nn import TensorDictModule

from coachable.domain import Domain
from coachable.evaluation import evaluate as evaluation
from coachable.evaluation.report import report, write_report
from coachable.networks import make_gaussian_actor
from coachable.styles import Choice, Setpoint, StyleReward, StyleSpace, Term, Weight, WeightedFeature
from coachable.training import weights
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


def test_report_of_a_gymnasium_environment_from_an_exported_model(tmp_path, monkeypatch):
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    gymnasium = pytest.importorskip("gymnasium")
    from coachable.export.onnx import write_onnx
    from coachable.export.verify import verify
    from coachable.gym import GymnasiumEnv

    space = StyleSpace([Weight("effort", -1.0, 1.0)])
    domain = Domain(
        "swing",
        lambda num_envs=1: GymnasiumEnv(
            lambda: gymnasium.make("Pendulum-v1"), lambda obs, action, info: -(action**2), num_envs
        ),
        lambda: space,
        lambda space: StyleReward(space, {"effort": WeightedFeature("effort", 0)}),
    )
    actor = make_gaussian_actor(3, 1, space, widths=(8,)).eval()
    agent = LoadedPolicy(actor, space, {}, {"domain": "swing", "source": "here", "frames": 12, "updates": 3})
    file = tmp_path / "swing.onnx"
    write_onnx(agent, domain, file)
    assert verify(file, domain).problems == ()
    monkeypatch.setattr(weights, "load_domain", lambda *_: domain)
    options = {"seeds": 1, "episodes": 1, "switch_episodes": 1, "sweep_points": 2, "steps": 3, "progress": False}
    assert "survived: 100%" in report([file], tmp_path / "report", **options)
    page = (tmp_path / "report" / "report.html").read_text()
    assert f"Deterministic policy of {file}, trained for 12 frames" in page
    assert "What a style costs" in page


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"make_env": None}, "make_env of the domain 'any' is None: expected a function"),
        ({"control_step": -1.0}, "control_step of the domain 'any' is -1.0: expected seconds, above 0"),
        ({"episode_steps": 0}, "episode_steps of the domain 'any' is 0: expected a whole number from 1"),
    ],
)
def test_a_declaration_that_cannot_work_is_refused(fields, message):
    declared = {"make_env": StyleEchoEnv, "make_space": StyleSpace, "make_reward": StyleReward}
    with pytest.raises((TypeError, ValueError), match=message):
        Domain("any", **(declared | fields))
