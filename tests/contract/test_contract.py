"""A contract says what was exported, and files from strangers are refused with one clear sentence."""

import base64
import json
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coachable.cli import main
from coachable.contract.contract import Contract, ContractError, Recorded
from coachable.contract.exported_model import OnnxPolicy, OnnxRun, read_model
from coachable.distributions.action_heads import ActionHeads
from coachable.export.onnx import write_onnx
from coachable.files import CheckpointError
from coachable.networks.mixed import make_mixed_actor
from coachable.signals import Signal
from coachable.styles import Choice, Setpoint, StyleSpace
from coachable.training.weights import LoadedPolicy, load_policy, widths_of

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")

SPACE = StyleSpace([Choice("hat", ("red", "blue")), Setpoint("speed", 0.5, 2.0, unit="m/s")], name="toy")
HEADS = ActionHeads((3, 2), axes=1)


def numbers(*shape):
    return np.random.default_rng(0).normal(size=shape).astype(np.float32)


RECORDED = Recorded(7, numbers(5, 4), numbers(4, 3), numbers(4, 6), numbers(3, 4), numbers(2, 6), numbers(2, 4))
CONTRACT = Contract(
    space=SPACE,
    observation=(Signal("motion", 3, ("m/s", "rad", ""), ("speed", "turn", "wind")), Signal("fuel", 1, "100 l")),
    action=(Signal("gear", 3, "", ("low", "middle", "high")), Signal("lights", 2), Signal("pedal", 1)),
    choice_sizes=(3, 2),
    domain="toy",
    control_step=0.05,
    environment={"cars": 3},
    frames=100,
    updates=None,
    recorded=RECORDED,
)


@pytest.fixture(scope="module")
def actor():
    torch.manual_seed(0)
    return make_mixed_actor(4, HEADS, SPACE, widths=(16,)).eval()


@pytest.fixture(scope="module")
def file(actor, tmp_path_factory):
    """A model with CONTRACT as its contract."""
    out = tmp_path_factory.mktemp("contract") / "toy.onnx"
    agent = LoadedPolicy(actor, SPACE, {}, {"domain": "toy", "source": "here", "frames": 100, "updates": None})
    write_onnx(agent, None, out)
    return rewritten(out, out, CONTRACT.to_metadata())


def rewritten(file, out, metadata):
    model = onnx.load(file)
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, metadata)
    onnx.save(model, out)
    return out


def same(ours, theirs):
    for name, value in vars(ours).items():
        np.testing.assert_array_equal(value, getattr(theirs, name))


def test_a_contract_survives_bit_for_bit(file):
    read = Contract.from_metadata(CONTRACT.to_metadata())
    assert replace(read, recorded=None) == replace(CONTRACT, recorded=None)
    same(read.recorded, RECORDED)
    assert read.widths == (4, 6)
    assert replace(read_model(file)[0], recorded=None) == replace(CONTRACT, recorded=None)


def test_an_exported_model_acts_like_its_actor(file, actor):
    agent = load_policy(file)
    assert isinstance(agent.actor, OnnxPolicy)
    assert (agent.space, agent.config, widths_of(agent)) == (SPACE, {"env": {"cars": 3}}, (4, 6))
    assert agent.metadata == {"domain": "toy", "source": str(file), "frames": 100, "updates": None}
    inputs = TensorDict({"observation": torch.randn(50, 4), "style": SPACE.sample((50,))}, [50])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(agent.actor(inputs.clone())["action"], actor(inputs.clone())["action"])
    torch.manual_seed(0)
    drawn = torch.stack([agent.actor(inputs.clone())["action"] for _ in range(200)])
    torch.testing.assert_close(drawn[..., :3].mean((0, 1)), actor(inputs)["probs"][:, :3].mean(0), atol=0.02, rtol=0)
    assert HEADS.spec((50,)).is_in(drawn[0])


def packed(array, shape=None):
    data = base64.b64encode(zlib.compress(np.asarray(array, "<f4").tobytes())).decode()
    return {"shape": list(shape or np.shape(array)), "data": data}


def recording(**changes):
    return json.dumps(json.loads(RECORDED.to_json()) | changes)


BOMB = {"shape": [5, 4], "data": base64.b64encode(zlib.compress(bytes(1 << 26))).decode()}
BAD = {
    "no contract": ({"schema_version": None}, "has no contract: expected a file written by coachable export"),
    "newer": ({"schema_version": "9"}, "version 9, which is newer than version 3 of this release: install a newer"),
    "older": ({"schema_version": "2"}, "version 2: expected 3; export the agent anew"),
    "no version": ({"schema_version": "x"}, "has the version 'x': expected 3"),
    "no space": ({"style_space": None}, "lacks style_space"),
    "no JSON": ({"style_space": "{"}, "style space is not valid JSON"),
    "nested": ({"environment": "[" * 100_000}, "environment is not valid JSON"),
    "NaN": ({"environment": '{"a": NaN}'}, "environment is not valid JSON"),
    "a list": ({"environment": "[1]"}, "environment is a list: expected a dict"),
    "an empty space": ({"style_space": "{}"}, "style space cannot be used: style space has schema version None"),
    "a long text": ({"environment": " " * (1 << 21)}, "environment has 2,097,152 characters: expected at most"),
    "a block of nothing": ({"observation": '[{"name": "a"}]'}, "observation has a block that cannot be used"),
    "too many names": (
        {"observation": '[{"name": "a", "width": 1, "unit": "", "entries": ["b", "c"]}]'},
        "signal 'a' has 2 names: expected one for each of 1",
    ),
    "a wide block": (
        {"observation": '[{"name": "a", "width": 100000000, "unit": "", "entries": []}]'},
        "observation has 100,000,000 entries: expected 1 to 131,072",
    ),
    "another width": (
        {"observation": '[{"name": "a", "width": 5, "unit": "", "entries": []}]', "recording": None},
        r"takes inputs of the widths \{'observation': 4, 'style': 3\}: its contract says \{'observation': 5",
    ),
    "other choices": ({"choice_sizes": "[2, 2]"}, r"output choices|output axes has the shape \(2, 1\)"),
    "wrong choices": ({"choice_sizes": '["a"]'}, r"choices have the sizes \['a'\]"),
    "no time": ({"control_step": "-1"}, "control step is '-1': expected a time above 0 s"),
    "no count": ({"frames": "many"}, "frames are 'many': expected a whole number"),
    "no seed": ({"recording": recording(seed=-1)}, "recording has the seed -1"),
    "no arrays": ({"recording": '{"seed": 0}'}, r"recording has the arrays \[\]"),
    "a number": ({"recording": recording(rest=3)}, "rest of its recording has the shape None"),
    "a wrong shape": ({"recording": recording(rest=packed(numbers(3, 5)))}, r"has the shape \[3, 5\]: expected 4"),
    "a huge shape": (
        {"recording": recording(rest={"shape": [1 << 40, 4], "data": ""})},
        "at most 10,000 rows and 16,777,216",
    ),
    "too little": ({"recording": recording(rest=packed(numbers(2, 4), (3, 4)))}, "does not have the size of its shape"),
    "a bomb": ({"recording": recording(observation=BOMB)}, "does not have the size of its shape"),
    "no base64": ({"recording": recording(rest={"shape": [3, 4], "data": "?"})}, "cannot be unpacked"),
    "infinite": ({"recording": recording(rest=packed(np.full((3, 4), np.inf)))}, "values that are not finite"),
    "no probes": (
        {"recording": recording(probe=packed(np.zeros((0, 4))), probe_action=packed(np.zeros((0, 6))))},
        "recording has no probes: expected a step with each axis and choice",
    ),
    "another length": ({"recording": recording(style=packed(numbers(2, 3)))}, "do not have the lengths of one run"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_contracts_are_one_sentence(what, file, tmp_path, capsys):
    change, message = BAD[what]
    metadata = {name: value for name, value in (CONTRACT.to_metadata() | change).items() if value is not None}
    bad = rewritten(file, tmp_path / "bad.onnx", metadata)
    with pytest.raises(CheckpointError, match=rf"bad\.onnx cannot be used: .*({message})"):
        read_model(bad)
    assert main(["verify", str(bad)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("coachable verify: ") and error.count("\n") == 1


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_file_is_one_sentence(share, file, tmp_path):
    cut = tmp_path / "cut.onnx"
    cut.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(CheckpointError, match=r"cut\.onnx (is not an ONNX file|cannot be used).* cut short"):
        read_model(cut)


def test_other_files_are_refused(tmp_path, file):
    with pytest.raises(CheckpointError, match="no such file"):
        read_model(tmp_path / "none.onnx")
    text = tmp_path / "text.onnx"
    text.write_text("This is a text, and no model at all. " * 100)
    with pytest.raises(CheckpointError, match="is not an ONNX file"):
        load_policy(text)


def test_nothing_beside_the_file_is_read_or_run(file, tmp_path):
    """Weights elsewhere on the disk, and operators of other libraries, also inside of branches."""
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(4096))
    model = onnx.load(file)
    tensor = next(t for t in model.graph.initializer if len(t.raw_data) > 64)
    onnx.external_data_helper.set_external_data(tensor, str(secret))
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    outside = tmp_path / "outside.onnx"
    outside.write_bytes(model.SerializeToString())
    with pytest.raises(CheckpointError, match="has weights in other files"):
        read_model(outside)
    model = onnx.load(file)
    inner = onnx.helper.make_graph([onnx.helper.make_node("Evil", [], ["y"], domain="com.evil")], "branch", [], [])
    model.graph.node.append(onnx.helper.make_node("If", ["c"], ["z"], then_branch=inner, else_branch=inner))
    foreign = tmp_path / "foreign.onnx"
    foreign.write_bytes(model.SerializeToString())
    with pytest.raises(CheckpointError, match=r"has operators of com\.evil"):
        read_model(foreign)


def test_sparse_weights_in_other_files_are_refused(file, tmp_path):
    """onnxruntime would read them, wherever in the file they are named."""
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(4096))
    outside = onnx.helper.make_tensor("values", onnx.TensorProto.FLOAT, (4,), np.zeros(4, np.float32).tobytes(), True)
    onnx.external_data_helper.set_external_data(outside, str(secret))
    outside.ClearField("raw_data")
    outside.data_location = onnx.TensorProto.EXTERNAL
    inside = onnx.helper.make_tensor("indices", onnx.TensorProto.INT64, (4,), range(4))
    constant = onnx.helper.make_sparse_tensor(outside, inside, (1024,))
    for attributes in ({"sparse_value": constant}, {"sparse_values": [constant]}):
        model = onnx.load(file)
        model.graph.node.append(onnx.helper.make_node("Constant", [], ["planted"], **attributes))
        planted = tmp_path / "planted.onnx"
        planted.write_bytes(model.SerializeToString())
        with pytest.raises(CheckpointError, match="has weights in other files"):
            read_model(planted)
    model = onnx.load(file)
    model.graph.sparse_initializer.append(constant)
    planted.write_bytes(model.SerializeToString())
    with pytest.raises(CheckpointError, match="has weights in other files"):
        read_model(planted)


def test_a_graph_that_cannot_run_is_one_sentence(file, tmp_path):
    model = onnx.load(file)
    model.graph.node[0].op_type = "NoSuchOperator"
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(model.SerializeToString())
    with pytest.raises(CheckpointError, match=r"broken\.onnx cannot be used: onnxruntime cannot load its graph"):
        read_model(broken)


def test_other_outputs_than_the_contract_says(file):
    content = file.read_bytes()
    with pytest.raises(ContractError, match=r"has the outputs .*: its contract says \['action'\]"):
        OnnxRun(content, replace(CONTRACT, choice_sizes=()))


@pytest.mark.parametrize("kind", [onnx.TensorProto.STRING, onnx.TensorProto.INT64])
def test_an_action_that_is_no_number_is_refused(file, kind):
    model = onnx.load(file)
    out = model.graph.output[0]
    for node in model.graph.node:
        node.output[:] = ["number" if name == out.name else name for name in node.output]
        node.input[:] = ["number" if name == out.name else name for name in node.input]
    model.graph.node.append(onnx.helper.make_node("Cast", ["number"], [out.name], to=kind))
    out.type.tensor_type.elem_type = kind
    with pytest.raises(ContractError, match=r"its output \w+ has the type .*: expected that of its contract"):
        OnnxRun(model.SerializeToString(), CONTRACT)
