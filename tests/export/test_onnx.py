"""The ONNX file says what torch says, describes itself, and runs where there is no torch."""

import copy
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import torchrl
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import coachable
from coachable.cli import main
from coachable.contract.contract import SCHEMA_VERSION
from coachable.distributions.action_heads import ActionHeads
from coachable.export.onnx import _trace, export, largest_difference
from coachable.export.verify import TOLERANCE
from coachable.networks import make_gaussian_actor
from coachable.networks.mixed import make_mixed_actor
from coachable.networks.plain import DeterministicAction, policy_network
from coachable.styles import Choice, Setpoint, StyleSpace, Weight
from coachable.training.weights import load_policy
from tests.echo import echo_space

pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
onnxruntime = pytest.importorskip("onnxruntime")

DOCS = Path(__file__).resolve().parents[2] / "docs"
SPACE = StyleSpace(
    [Choice("hat", ("red", "blue")), Setpoint("speed", 0.5, 2.0, unit="m/s", encoding="range"), Weight("calm", -1, 5)]
)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    out = tmp_path_factory.mktemp("export") / "policy.onnx"
    assert export("humanoid", out) <= TOLERANCE
    return out


def run(file, **inputs):
    session = onnxruntime.InferenceSession(str(file))
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(None, {k: v.numpy() for k, v in inputs.items()}), strict=True))


def write(plain, file):
    """The graph alone, without metadata."""
    file.write_bytes(_trace(plain.eval()).model_proto.SerializeToString())
    return file


@pytest.mark.parametrize("batch", [1, 7, 33])
def test_parity_with_the_actor_of_the_humanoid(file, batch):
    agent = load_policy("humanoid")
    generator = torch.Generator().manual_seed(1)
    observation = torch.randn(batch, 82, generator=generator)
    style = agent.space.sample((batch,), generator)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = agent.actor(TensorDict(observation=observation, style=style, batch_size=[batch]))["action"]
    (action,) = run(file, observation=observation, style=style).values()
    np.testing.assert_allclose(action, expected.numpy(), rtol=0, atol=1e-5)


def test_rounding_in_the_largest_shipped_network_is_no_difference(tmp_path):
    agent = load_policy("combat_full")
    plain = DeterministicAction(agent.actor)
    assert largest_difference(write(plain, tmp_path / "fighter.onnx"), plain, agent.space) <= TOLERANCE


def test_the_file_names_no_folder_of_this_machine(file):
    content = file.read_bytes()
    assert not any(str(Path(module.__file__).parent).encode() in content for module in (coachable, torch, torchrl))
    assert b".py" not in content


def test_the_file_describes_itself(file):
    session = onnxruntime.InferenceSession(str(file))
    assert [(i.name, i.shape[1]) for i in session.get_inputs()] == [("observation", 82), ("style", 4)]
    assert [(o.name, o.shape[1]) for o in session.get_outputs()] == [("action", 21)]
    metadata = session.get_modelmeta().custom_metadata_map
    space = StyleSpace.from_json(metadata["style_space"])
    assert space == load_policy("humanoid").space
    assert (space["step_length"].unit, space["step_length"].low, space["step_length"].high) == ("m", 0.3, 0.65)
    assert [p.kind for p in space.parameters] == ["choice", "setpoint"]
    assert float(metadata["control_step"]) == 0.025
    assert metadata["schema_version"] == str(SCHEMA_VERSION)
    assert metadata["domain"] == "humanoid"
    assert metadata["schema_version"] == "3"
    blocks = json.loads(metadata["observation"])
    assert sum(block["width"] for block in blocks) == 82
    assert (blocks[0]["name"], blocks[0]["unit"], blocks[0]["entries"][0]) == ("joint_angles", "rad", "abdomen_z")
    (motors,) = json.loads(metadata["action"])
    assert (motors["entries"][0], motors["unit"][0]) == ("abdomen_y", "40 N m")
    assert len(json.loads(metadata["recording"])) == 7


def test_it_is_one_file(file):
    assert [path.name for path in file.parent.iterdir()] == ["policy.onnx"]


def test_mixed_actions_leave_as_axes_and_choices(tmp_path):
    torch.manual_seed(0)  # with some weights one choice is the likeliest everywhere
    heads = ActionHeads((4, 2, 3), axes=2)
    actor = make_mixed_actor(5, heads, SPACE, widths=(16, 16)).eval()
    plain = DeterministicAction(actor)
    out = write(plain, tmp_path / "mixed.onnx")
    observation, style = torch.randn(40, 5), SPACE.sample((40,))
    results = run(out, observation=observation, style=style)
    shapes = {name: value.shape for name, value in results.items()}
    assert shapes == {"axes": (40, 2), "choices": (40, 3), "probabilities": (40, 9)}
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = actor(TensorDict(observation=observation, style=style, batch_size=[40]))
    action = acted["action"]
    np.testing.assert_allclose(results["probabilities"], acted["probs"].numpy(), rtol=0, atol=1e-5)
    np.testing.assert_allclose(results["axes"], heads.split(action)[1].numpy(), rtol=0, atol=1e-5)
    np.testing.assert_array_equal(results["choices"], heads.choices(action).numpy())
    assert len(np.unique(results["choices"][:, 0])) > 1
    assert largest_difference(out, plain, SPACE) <= TOLERANCE


def test_nothing_is_dropped(tmp_path):
    actor = make_gaussian_actor(3, 2, SPACE, widths=(64, 64), dropout=0.5).eval()
    plain = DeterministicAction(actor)
    observation, style = torch.randn(9, 3), SPACE.sample((9,))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = actor(TensorDict(observation=observation, style=style, batch_size=[9]))["action"]
    (action,) = run(write(plain, tmp_path / "dropout.onnx"), observation=observation, style=style).values()
    np.testing.assert_allclose(action, expected.numpy(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("heads", [ActionHeads((3, 2)), ActionHeads(axes=2)])
def test_only_the_components_that_exist(tmp_path, heads):
    actor = make_mixed_actor(4, heads, SPACE, widths=(8,)).eval()
    plain = DeterministicAction(actor)
    observation, style = torch.randn(9, 4), SPACE.sample((9,))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        action = actor(TensorDict(observation=observation, style=style, batch_size=[9]))["action"]
        only, *probabilities = plain(observation, style)
    assert len(probabilities) == (1 if heads.categorical else 0)
    expected = heads.choices(action) if heads.categorical else action
    torch.testing.assert_close(only, expected)


@pytest.fixture(scope="module")
def traced(short_run):
    """A small policy, and its graph."""
    actor = load_policy(short_run).actor.eval()
    return actor, _trace(DeterministicAction(actor))


def test_a_file_that_disagrees_is_noticed(traced, tmp_path):
    actor = copy.deepcopy(traced[0])
    plain = DeterministicAction(actor)
    out = tmp_path / "old.onnx"
    out.write_bytes(traced[1].model_proto.SerializeToString())
    assert largest_difference(out, plain, echo_space()) <= TOLERANCE
    with torch.no_grad():
        policy_network(actor).trunk.head.bias += 0.5
        assert largest_difference(out, plain, echo_space()) > 0.01
        policy_network(actor).trunk.head.bias.fill_(float("nan"))
        assert largest_difference(out, plain, echo_space()) == float("inf"), "NaN is no agreement"


def test_a_full_disk_is_one_sentence_with_the_space_needed(short_run, traced, tmp_path, monkeypatch):
    monkeypatch.setattr("coachable.export.onnx._trace", lambda _: traced[1])

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(
        OSError, match=r"^cannot write \S+: it needs about \d+\.\d MB, .* MB are free \(No space left on"
    ):
        export(short_run, tmp_path / "out" / "policy.onnx")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_policy_without_style_is_refused():
    with pytest.raises(ValueError, match="expected one, as made by"):
        DeterministicAction(make_gaussian_actor(3, 2, None, widths=(8,)))


def test_the_command(short_run, traced, tmp_path, capsys, monkeypatch):
    """An agent of a domain that is not built in: everything but the control step."""
    monkeypatch.setattr("coachable.export.onnx._trace", lambda _: traced[1])  # takes seconds
    out = tmp_path / "echo.onnx"
    assert main(["export", "onnx", str(short_run), "--out", str(out)]) == 0
    assert re.search(r"wrote .*echo\.onnx .* from torch", capsys.readouterr().out)
    metadata = onnxruntime.InferenceSession(str(out)).get_modelmeta().custom_metadata_map
    assert metadata["domain"] == "echo" and "control_step" not in metadata


def test_a_missing_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert main(["export", "onnx", "humanoid"]) == 2
    assert "pip install 'coachable[export]'" in capsys.readouterr().err


def test_the_documented_program_needs_no_torch(file):
    (program,) = re.findall(r"```python\n(.*?)```", (DOCS / "guides" / "export.md").read_text(), re.DOTALL)
    assert len(program.splitlines()) <= 30
    blocked = "import sys\nsys.modules['torch'] = None\nsys.modules['coachable'] = None\n"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", blocked + program], cwd=file.parent, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "t_pose" in done.stdout and "(21,)" in done.stdout
