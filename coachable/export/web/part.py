"""`WebPart`: what a domain that MuJoCo simulates adds to the page that `coachable export web` writes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from torch import Tensor, nn

from coachable.export.graph import graph_of

_OUTPUTS = ("observation", "measured", "mark", "memory_after", "terminated")
_MODELS = {"dynamics": "dynamics.xml", "kinematics": "kinematics.xml"}
_FEATURES = "features.onnx"


@dataclass(frozen=True)
class Measure:
    """Measured quantity that the page shows.

    Attributes:
        name: Name of the measure, as in the domain's `StyleMeasures`.
        parameter: Style parameter beside which the page shows it, or "" for none.
        text: What it is called on the page, or "" if the page does not show it.
        unit: Unit, or "" for none.
        share: Whether it is a share of time, which the page shows in percent.
        at_marks: Whether the values at the last marks are listed beside the request.
        circular: Whether it is a direction in degrees, whose mean is that of directions.
        comparable: Whether it is measured in what the parameter asks for, so that the slider shows it, too.
        digits: Number of digits after the point.
        per: Name of the measure by whose mean the mean of this one is divided, or "" for none.
    """

    name: str
    parameter: str
    text: str
    unit: str = ""
    share: bool = False
    at_marks: bool = False
    circular: bool = False
    comparable: bool = True
    digits: int = 2
    per: str = ""


@dataclass(frozen=True)
class WebScene:
    """How the page draws the model: the colours of the domain's stage.

    Attributes:
        bodies: Colours of the bodies by name, as in CSS; `body` for the others.
        body: Colour of bodies that are not named.
        links: Capsules between two bodies, each with `bodies`, `radius` [m] and `colour`.
        balls: Balls on a body, each with `body`, `at` (3,) [m] in the body's frame, `diameter` [m] and `colour`.
        ground: Colour of the ground.
        lines: Colours of the lines at half metres and at metres.
        marks: Colours of the marks on the ground by side.
        lengths: Number of the latest marks that have their measured value beside them.
        shortest: Smallest value that is written [unit of the measure].
        asked: Colour of the line where a mark of the requested value is.
        course: Colour of the arrow along the course.
        viewpoint: Where the camera is, as in `coachable.scene.frame.Viewpoint`.
        legend: Colours and what they mean.
    """

    bodies: Mapping[str, str]
    body: str
    links: Sequence[Mapping[str, Any]]
    balls: Sequence[Mapping[str, Any]]
    ground: str
    lines: tuple[str, str]
    marks: tuple[str, str]
    lengths: int
    shortest: float
    asked: str
    course: str
    viewpoint: Mapping[str, Any]
    legend: Sequence[tuple[str, str]]


@dataclass(frozen=True, kw_only=True)
class PagePart:
    """What every page needs to know of a domain with one agent.

    Attributes:
        title: Title of the page.
        summary: One sentence for the visitor.
        measures: Measured quantities.
        starts: Initial states, with lists of numbers by name.
        physics: Constants of the physics: `control_step` [s], `substeps`, `episode_steps` and whatever else is worth
            telling.
        terminated: Verb for a terminated episode in the past tense.
        opens: Request with which the page opens, by name; what it lacks has its default.
        picture: What the picture shows, for those who do not see it.
        licence: Notice that the licence of the model asks for, or "" for none.
        window: Time over which shares and means are taken [s].
        idle: Parameters that nothing on the page depends on. They have no slider and stay at what `opens` has.
        idle_note: Sentence that says so, with the reason.
    """

    kind: ClassVar[str]
    """Name of the page's script, without its ending."""
    packages: ClassVar[tuple[str, ...]]
    """Packages of other projects that the page needs, see `coachable.export.web.pinned_files`."""

    title: str
    summary: str
    measures: Sequence[Measure]
    starts: Sequence[Mapping[str, Sequence[float]]]
    physics: Mapping[str, Any]
    terminated: str
    opens: Mapping[str, Any] = field(default_factory=dict)
    picture: str = "The agent"
    licence: str = ""
    window: float = 3.0
    idle: Sequence[str] = ()
    idle_note: str = ""

    def files(self) -> dict[str, bytes]:
        """Return the files of the page beside the policy, by name.

        Raises:
            ImportError: If the extra `export` is not installed.
        """
        raise NotImplementedError

    def told(self) -> dict[str, Any]:
        """Return what only this kind of page has in `manifest.json`."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class WebPart(PagePart):
    """What the page needs to know of a domain that MuJoCo simulates.

    The page steps `dynamics` by a control step, reads the sensors of `kinematics` in the new state, and calls
    `features` with them. `starts` have `positions`, `memory` and `observation`; `physics` has `physics_step` [s], too.

    Attributes:
        dynamics: XML of the model that is stepped, without external assets.
        kinematics: XML of the model whose sensors the features read, without external assets.
        features: Module with the arguments `positions` (1, nq), `velocities` (1, nv), `sensors` (1, S) and `controls`
            (1, C) in float64, `style` (1, d) in float32 and `memory` (1, M) in float64. It returns `observation`
            float32, `measured` float32 in the order of `measures` with NaN where there is no value, `mark` (1, 5)
            float64, which is x, y, the direction's x and y, and the side of a mark on the ground, or NaN, `memory`
            for the next call, and `terminated` (1,) bool.
        example: Example of these arguments by name.
        push: Force [N] and `duration` [s] of the page's push, which acts on the first three velocities.
        followed: Body that the camera follows.
        scene: How the model is drawn.
    """

    kind = "simulated"
    packages = ("@mujoco/mujoco", "onnxruntime-web", "three")

    dynamics: str
    kinematics: str
    features: nn.Module
    example: Mapping[str, Tensor]
    push: Mapping[str, float]
    followed: str
    scene: WebScene

    def files(self) -> dict[str, bytes]:
        """Return the models and the graph of the features; see `PagePart.files`."""
        texts = {_MODELS["dynamics"]: self.dynamics, _MODELS["kinematics"]: self.kinematics}
        features = graph_of(self.features, self.example, _OUTPUTS)
        return {name: text.encode() for name, text in texts.items()} | {_FEATURES: features.SerializeToString()}

    def told(self) -> dict[str, Any]:
        """Return how the model is stepped and drawn; see `PagePart.told`."""
        return {
            "scene": vars(self.scene),
            "legend": [list(entry) for entry in self.scene.legend],
            "models": _MODELS,
            "graphs": {"features": _FEATURES},
            "push": dict(self.push),
            "followed": self.followed,
        }
