"""ONNX graphs from functions, also from functions that compute with NumPy."""

import contextlib
import logging
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from coachable.contract.exported_model import parts_of
from coachable.extras import from_extra


def graph_of(function: nn.Module, example: Mapping[str, Tensor], outputs: Sequence[str]) -> Any:
    """Return the ONNX model of a module that may convert tensors to NumPy arrays and compute with them.

    Code that simulates with NumPy can thus be exported as it is, instead of being written a second time. Sizes are
    those of the example; branches and the types of containers must not depend on values.

    Args:
        function: Module without parameters, from tensors to a tuple of tensors.
        example: Inputs by name, in the order of the arguments.
        outputs: Names of the outputs.

    Returns:
        The model, an `onnx.ModelProto`.

    Raises:
        ImportError: If the extra `export` is not installed.
    """
    onnx = import_onnx()
    inputs = tuple(value.clone() for value in example.values())  # one tensor for two inputs would make them one
    found: list[tuple[Any, Sequence[Any]]] = []

    def keep(graph: Any, _: Any) -> Any:
        def run(*values: Any) -> Any:
            found.append((graph, values))
            return graph(*values)

        return run

    # Dynamo turns NumPy's functions into torch's. Arrays that the code finds elsewhere become inputs of its graph.
    with quietly():
        torch.compile(function, backend=keep, fullgraph=True, dynamic=False)(*inputs)
        ((graph, values),) = found
        program = torch.export.export(_Captured(graph, values, inputs), inputs).run_decompositions()
        names: dict[str, Any] = {"input_names": list(example), "output_names": list(outputs)}
        options: dict[str, Any] = {"dynamo": True, "external_data": False, "verbose": False, "optimize": False}
        written: Any = torch.onnx.export(program, **options, **names)
        _simplify(written.model)
    exported = written.model_proto
    forget_sources(exported)
    _replace_cosines(onnx, exported.graph)
    del exported.graph.value_info[:]
    onnx.checker.check_model(exported)
    return exported


def forget_sources(model: Any) -> None:
    """Remove, in place, where in the source code each part of a model comes from, which names folders of this machine.

    The model, an `onnx.ModelProto`, must not have its contract yet.
    """
    for part in list(parts_of(model)):
        for name in {"doc_string", "metadata_props"}.intersection(part.DESCRIPTOR.fields_by_name):
            part.ClearField(name)


def _simplify(model: Any) -> None:
    """Inline functions and compute constants, in place.

    The exporter's own optimisation also drops summands below 1e-8, of which some keep a division by 0 away.
    """
    from onnxscript import optimizer

    optimizer.inline(model)
    optimizer.fold_constants(model)
    optimizer.remove_unused_nodes(model)


def _replace_cosines(onnx: Any, graph: Any) -> None:
    """Compute cosines as sines, because the runtime of browsers has no cosine in float64."""
    double = onnx.TensorProto.DOUBLE
    known = (*graph.value_info, *graph.input, *graph.output)
    angles = {value.name for value in known if value.type.tensor_type.elem_type == double}
    cosines = [node for node in graph.node if node.op_type == "Cos" and node.output[0] in angles]
    if cosines:
        quarter = onnx.helper.make_tensor("quarter_turn", double, (), [math.pi / 2])
        graph.initializer.append(quarter)
    for node in cosines:
        (angle,), shifted = node.input, f"{node.name}_shifted"
        place = list(graph.node).index(node)
        node.op_type, node.input[0] = "Sin", shifted
        graph.node.insert(place, onnx.helper.make_node("Add", [angle, "quarter_turn"], [shifted], f"{node.name}_add"))


class _Captured(nn.Module):
    """Captured graph whose further inputs are constants."""

    def __init__(self, graph: Any, values: Sequence[Any], inputs: Sequence[Tensor]) -> None:
        super().__init__()
        self.graph = graph
        self._places = [next((i for i, own in enumerate(inputs) if own is value), None) for value in values]
        for k, value in enumerate(values):
            if self._places[k] is None:
                self.register_buffer(f"constant_{k}", torch.as_tensor(value))

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        places = enumerate(self._places)
        return self.graph(*(getattr(self, f"constant_{k}") if i is None else inputs[i] for k, i in places))


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Keep the exporter from logging which optional packages are missing, and from warning about itself."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def import_onnx() -> Any:
    """Return the package `onnx`, once everything that writes with it is there.

    Raises:
        ImportError: If the extra `export` is not installed; the message says how to install it.
    """
    with from_extra("export"):
        import onnx
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    return onnx
