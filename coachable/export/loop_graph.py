"""ONNX graphs of which one part repeats, such as the substeps of a simulation."""

from typing import Any

from coachable.export.graph import import_onnx


def repeated(before: Any, body: Any, after: Any, times: int) -> Any:
    """Return the model that computes `before` once, then `body` several times, then `after`.

    Values are connected by their names. The output of `body` replaces its first input after each repetition; `after`
    reads the last value under the output's name. What else `body` and `after` read are outputs of `before`; `before`
    and `after` may also read inputs of the model.

    Args:
        before: Model, as from `coachable.export.graph.graph_of`.
        body: Model with one output.
        after: Model whose outputs are those of the result.
        times: How often `body` is computed.

    Returns:
        The model, an `onnx.ModelProto`. Its inputs are those of `before`, then those that only `after` reads.

    Raises:
        ImportError: If the extra `export` is not installed.
        ValueError: If `body` reads a value that neither it nor `before` computes.
    """
    onnx = import_onnx()
    helper = onnx.helper
    carried, result = body.graph.input[0].name, body.graph.output[0].name
    made = {value.name for value in before.graph.output}
    if unknown := {value.name for value in body.graph.input} - made:
        raise ValueError(f"the repeated graph reads {', '.join(sorted(unknown))}: expected outputs of the one before")
    first = _apart(before.graph, "before_", set())
    again = _apart(body.graph, "body_", {carried, result})
    last = _apart(after.graph, "after_", set())

    count, on = helper.make_tensor("times", onnx.TensorProto.INT64, (), [times]), onnx.TensorProto.BOOL
    inner = helper.make_graph(
        [helper.make_node("Identity", ["body_go_on"], ["body_going_on"], "body_keep"), *again.node],
        "body",
        [
            helper.make_tensor_value_info("body_number", onnx.TensorProto.INT64, ()),
            helper.make_tensor_value_info("body_go_on", on, ()),
            again.input[0],
        ],
        [helper.make_tensor_value_info("body_going_on", on, ()), again.output[0]],
    )
    loop = helper.make_node("Loop", ["times", "", carried], [result], "repeat", body=inner)
    own = [value for value in last.input if value.name not in {*made, result}]
    inputs = {value.name: value for value in (*first.input, *own)}
    graph = helper.make_graph(
        [*first.node, loop, *last.node],
        "step",
        list(inputs.values()),
        list(last.output),
        [count, *first.initializer, *again.initializer, *last.initializer],
    )
    model = helper.make_model(graph, opset_imports=after.opset_import, ir_version=after.ir_version)
    onnx.checker.check_model(model, full_check=True)
    return model


def _apart(graph: Any, prefix: str, inner: set[str]) -> Any:
    """Return a copy of a graph whose names begin with a prefix, except inputs and outputs that are not in `inner`."""
    copy = type(graph)()
    copy.CopyFrom(graph)
    shared = {value.name for value in (*copy.input, *copy.output)} - inner

    def renamed(name: str) -> str:
        return name if not name or name in shared else prefix + name

    for node in copy.node:
        node.name = prefix + node.name
        node.input[:] = [renamed(name) for name in node.input]
        node.output[:] = [renamed(name) for name in node.output]
    for value in (*copy.input, *copy.output, *copy.initializer):
        value.name = renamed(value.name)
    return copy
