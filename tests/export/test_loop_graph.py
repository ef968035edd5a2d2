"""Graphs of which one part repeats."""

import numpy as np
import pytest
import torch
from torch import nn

pytest.importorskip("onnxscript")
onnxruntime = pytest.importorskip("onnxruntime")

from coachable.export.graph import graph_of  # noqa: E402
from coachable.export.loop_graph import repeated  # noqa: E402


class Before(nn.Module):
    def forward(self, start, other):
        return start + 1.0, other.cos()


class Body(nn.Module):
    def forward(self, value, factor):
        return (value * factor,)


class After(nn.Module):
    def forward(self, start, late, end):
        return (end + start - late,)


def test_the_body_is_computed_as_often_as_asked():

    def example(*names):
        return {name: torch.ones(1, 1) for name in names}

    before = graph_of(Before(), example("start", "other"), ("value", "factor"))
    body = graph_of(Body(), example("value", "factor"), ("end",))
    after = graph_of(After(), example("start", "late", "end"), ("result",))
    model = repeated(before, body, after, 3)
    assert [value.name for value in model.graph.input] == ["start", "other", "late"]
    session = onnxruntime.InferenceSession(model.SerializeToString())
    start, other, late = (np.array([[value]], np.float32) for value in (2.0, 0.5, 4.0))
    (result,) = session.run(None, {"start": start, "other": other, "late": late})
    assert result == pytest.approx((2.0 + 1.0) * np.cos(0.5) ** 3 + 2.0 - 4.0, rel=1e-6)
    with pytest.raises(ValueError, match="reads factor, value: expected outputs of the one before"):
        repeated(body, body, after, 3)
