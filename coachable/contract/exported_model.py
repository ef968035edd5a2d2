"""Exported models: reading the file without trusting it, and running it with onnxruntime."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModuleBase
from torchrl.envs.utils import exploration_type

from coachable.contract.contract import Contract, ContractError
from coachable.distributions.action_heads import ActionHeads
from coachable.extras import from_extra
from coachable.files import CheckpointError
from coachable.keys import STYLE

_LARGEST = 1 << 30  # [byte]
_STANDARD = ("", "ai.onnx")  # domains of operators that every runtime has


class OnnxRun:
    """Graph of a policy in onnxruntime, on one thread.

    Args:
        content: The file's content.
        contract: Contract with which inputs and outputs have to agree.

    Raises:
        ContractError: If they do not agree, or onnxruntime cannot run the graph.
    """

    def __init__(self, content: bytes, contract: Contract) -> None:
        import onnxruntime

        self._heads = ActionHeads(contract.choice_sizes, contract.widths[1] - sum(contract.choice_sizes))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # errors are raised, and need not be printed, too
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime has many kinds of exceptions
            raise ContractError(f"onnxruntime cannot load its graph: {_first_line(error)}") from None
        inputs = {i.name: i.shape[1] if len(i.shape) == 2 else None for i in self._session.get_inputs()}
        expected = {"observation": contract.widths[0], "style": contract.space.dim}
        if inputs != expected:
            raise ContractError(f"its graph takes inputs of the widths {inputs}: its contract says {expected}")
        self._names = [output.name for output in self._session.get_outputs()]
        outputs = _output_widths(self._heads, self._names)
        if sorted(self._names) != sorted(outputs):
            raise ContractError(f"its graph has the outputs {self._names}: its contract says {list(outputs)}")
        rows = self(*(np.zeros((2, width), np.float32) for width in expected.values()))
        for name, width in outputs.items():
            if rows[name].dtype.kind != ("i" if name == "choices" else "f"):
                raise ContractError(f"its output {name} has the type {rows[name].dtype}: expected that of its contract")
            if rows[name].shape != (2, width):
                raise ContractError(f"its output {name} has the shape {rows[name].shape}: its contract says {width}")

    def __call__(self, observation: np.ndarray, style: np.ndarray) -> dict[str, np.ndarray]:
        """Return the outputs by name for observations (N, D) and styles (N, d).

        Raises:
            ContractError: If onnxruntime cannot run the graph.
        """
        inputs = {"observation": observation.astype(np.float32), "style": style.astype(np.float32)}
        try:
            values = self._session.run(self._names, inputs)
        except Exception as error:  # onnxruntime has many kinds of exceptions
            raise ContractError(f"onnxruntime cannot run its graph: {_first_line(error)}") from None
        return dict(zip(self._names, map(np.asarray, values), strict=True))

    def act(self, observation: np.ndarray, style: np.ndarray, sample: bool = False) -> np.ndarray:
        """Return actions (N, A): the one-hots of choices, then the axes.

        Args:
            observation: Observations (N, D).
            style: Styles (N, d).
            sample: Whether to draw choices with torch's generator instead of taking the likeliest.
        """
        outputs = self(observation, style)
        if not self._heads.categorical:
            return outputs["axes" if "axes" in outputs else "action"]
        choices = torch.from_numpy(outputs["choices"])
        if sample:
            parts = torch.from_numpy(outputs["probabilities"]).split(self._heads.categorical, -1)
            if not all(part.isfinite().all() for part in parts):
                raise ContractError("the model's probabilities are not finite: the model cannot act")
            choices = torch.cat([torch.multinomial(part.clamp(min=0.0), 1) for part in parts], -1)
        axes = torch.from_numpy(outputs["axes"]) if self._heads.axes else None
        limits = torch.tensor(self._heads.categorical) - 1
        return self._heads.from_choices(choices.clamp(min=0).minimum(limits), axes).numpy()


class OnnxPolicy(TensorDictModuleBase):
    """Policy that runs an exported model; it reads `observation` and `style` and writes `action`.

    Choices are drawn by default, as the exported actor draws them. Axes are always the deterministic ones, because the
    file does not have their spread.
    """

    def __init__(self, run: OnnxRun, contract: Contract) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["observation", STYLE], ["action"]
        self._run, self.contract = run, contract
        kind = InteractionType.RANDOM if contract.choice_sizes else InteractionType.DETERMINISTIC
        self.default_interaction_type = kind

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        kind = exploration_type() or self.default_interaction_type
        sample = bool(self.contract.choice_sizes) and kind is InteractionType.RANDOM
        observation, style = (tensordict.get(key).cpu().numpy() for key in ("observation", STYLE))
        action = self._run.act(observation, style, sample)
        return tensordict.set("action", torch.from_numpy(action))


def read_model(file: Path | str) -> tuple[Contract, OnnxRun]:
    """Read an exported model, an ONNX file that may come from anybody: its contract and its graph.

    Raises:
        CheckpointError: If there is no such file, it is damaged, or it has no contract that this release reads; the
            message is one sentence that names the file.
        ImportError: If the extra `export` is not installed.
    """
    with from_extra("export"):
        import onnx
        import onnxruntime  # noqa: F401
    file = Path(file)
    if not file.is_file():
        raise CheckpointError(f"no such file: {file}")
    size = file.stat().st_size
    if size > _LARGEST:
        raise CheckpointError(f"{file} has {size:,} bytes: expected at most {_LARGEST:,}")
    content = file.read_bytes()
    try:
        model = onnx.load_model_from_string(content)
    except Exception as error:  # a damaged file may raise anything
        raise CheckpointError(f"{file} is not an ONNX file, or is damaged or cut short ({size:,} bytes)") from error
    try:
        _check_graph(onnx, model)
        contract = Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})
        return contract, OnnxRun(content, contract)
    except ContractError as error:
        raise CheckpointError(f"{file} cannot be used: {error}") from None


def _check_graph(onnx: Any, model: Any) -> None:
    """Refuse operators of other libraries, and weights in other files, which the file could name freely."""
    if not model.graph.node:
        raise ContractError("it has no graph: it is not an ONNX file, or is cut short")
    parts = list(parts_of(model))
    own = {*_STANDARD, *(function.domain for function in model.functions)}
    foreign = {part.domain for part in parts if isinstance(part, onnx.NodeProto)} - own
    if foreign:
        raise ContractError(f"it has operators of {', '.join(sorted(foreign))}: expected those of ONNX itself")
    tensors = (part for part in parts if isinstance(part, onnx.TensorProto))
    if any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in tensors):
        raise ContractError("it has weights in other files: expected all of them inside")


def parts_of(message: Any) -> Iterator[Any]:
    """Yield a message of the file and all messages inside it, wherever graphs, operators or tensors may be nested."""
    yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for part in (value,) if hasattr(value, "ListFields") else value:
                yield from parts_of(part)


def _output_widths(heads: ActionHeads, names: list[str]) -> dict[str, int]:
    if not heads.categorical:
        return {"axes" if names == ["axes"] else "action": heads.axes}
    choices = {"choices": len(heads.categorical), "probabilities": heads.num_categorical}
    return ({"axes": heads.axes} if heads.axes else {}) | choices


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
