"""`StepPart`: what a domain whose own step is exported adds to the page that `coachable export web` writes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor, nn

from coachable.export.graph import graph_of
from coachable.export.loop_graph import repeated
from coachable.export.web.part import PagePart
from coachable.scene.frame import Backdrop, Map, Viewpoint
from coachable.scene.gauge_form import GaugeForm
from coachable.scene.palette import Colour, css
from coachable.scene.parts import Parts
from coachable.scene.recorded import encode_backdrop, encode_figures

OUTPUTS = ("observation", "measured", "figures", "marks", "gauges", "camera", "memory_after", "terminated")
"""Outputs of the graph of a control step, see `Steps.judge`."""

_STEP, _BACKDROP, _FIGURES = "step.onnx", "backdrop.bin", "figures.bin"
_LAUNCHED, _LANDED = "launched", "landed"


@dataclass(frozen=True)
class Steps:
    """A control step as functions without branches on values or random numbers, for one agent.

    Attributes:
        command: Module with the arguments `memory` (1, S), which is the whole state as one row, and `action` (1, A). It
            returns the state of the physics before its first substep, and constants of the control step.
        advance: Module with these two arguments, which returns the state of the physics after a substep.
        substeps: Number of substeps of a control step.
        judge: Module with the arguments `memory`, `action`, `style` (1, d), and the state of the physics before the
            first and after the last substep. It returns, in the order of `OUTPUTS`, the observation (1, D), what is
            measured (1, M) with NaN where there is no value, poses of figures (1, F, 7) as place [m] and unit
            quaternion, new marks on the ground (1, K, 4) as x, y, length [m] and direction [rad] or NaN, numbers of the
            gauges (1, G), the place that the camera follows and the direction in which it looks (1, 4) [m, rad], the
            whole state after the step (1, S), and whether the episode terminates (1,) bool.
        memory: Example of a whole state (1, S).
        action: Example of an action (1, A).
        style: Example of a style (1, d).
    """

    command: nn.Module
    advance: nn.Module
    substeps: int
    judge: nn.Module
    memory: Tensor
    action: Tensor
    style: Tensor


def step_graph(steps: Steps) -> Any:
    """Return the graph of a control step, with the inputs `memory`, `action` and `style` and the outputs `OUTPUTS`."""
    given = {"memory": steps.memory, "action": steps.action}
    launched, inputs = steps.command(*given.values())
    moved = {_LAUNCHED: launched, "constants": inputs}
    judged = given | {"style": steps.style, _LAUNCHED: launched, _LANDED: launched.clone()}
    return repeated(
        graph_of(steps.command, given, tuple(moved)),
        graph_of(steps.advance, moved, (_LANDED,)),
        graph_of(steps.judge, judged, OUTPUTS),
        steps.substeps,
    )


@dataclass(frozen=True, kw_only=True)
class StepPart(PagePart):
    """What the page needs to know of a domain whose control step is exported as a graph.

    `starts` have `memory`, `observation`, `figures`, `gauges` and `camera`, as `Steps.judge` returns them.

    Attributes:
        steps: The control step.
        figures: Shapes of the figures, each in its own frame.
        backdrop: What does not move.
        viewpoint: Where the camera is at first.
        legend: Colours and what they mean.
        marks: Number of marks that are kept.
        mark_size: Width and thickness of a mark [m].
        mark_height: Height of its middle [m].
        mark_colour: Its colour.
        gauges: How gauges are made from the numbers.
        values: Names of these numbers, in order.
        map: Small map with one place, or None.
    """

    kind = "stepped"
    packages = ("onnxruntime-web", "three")

    steps: Steps
    figures: Sequence[Parts]
    backdrop: Backdrop
    viewpoint: Viewpoint
    legend: Sequence[tuple[Colour, str]]
    marks: int
    mark_size: tuple[float, float]
    mark_height: float
    mark_colour: Colour
    gauges: Sequence[GaugeForm]
    values: Sequence[str]
    map: Map | None = None

    def files(self) -> dict[str, bytes]:
        """Return the graph of a control step, the shapes of the figures and the backdrop; see `PagePart.files`."""
        return {
            _STEP: step_graph(self.steps).SerializeToString(),
            _FIGURES: encode_figures(self.figures),
            _BACKDROP: encode_backdrop(self.backdrop),
        }

    def told(self) -> dict[str, Any]:
        """Return how the scene is drawn; see `PagePart.told`."""
        return {
            "graphs": {"step": _STEP},
            "figures": _FIGURES,
            "backdrop": _BACKDROP,
            "viewpoint": vars(self.viewpoint),
            "legend": [[css(colour), meaning] for colour, meaning in self.legend],
            "marks": {
                "most": self.marks,
                "size": list(self.mark_size),
                "height": self.mark_height,
                "colour": list(self.mark_colour),
            },
            "gauges": [form.told() for form in self.gauges],
            "values": list(self.values),
            "map": None if self.map is None else _map(self.map),
        }


def _map(shown: Map) -> dict[str, Any]:
    """Return an outline in a picture of 100 by 100, and how a place gets there: `offset` + `scale` * place."""
    outline, (origin, one) = Map(shown.outline, [(0.0, 0.0), (1.0, 1.0)], shown.colours).scaled(100.0, 100.0)
    return {
        "outline": np.round(outline, 1).tolist(),
        "offset": origin.tolist(),
        "scale": (one - origin).tolist(),
        "colour": css(shown.colours[0]),
    }
