"""`WebPart`: what a domain adds to the page that `coachable export --web` writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor, nn

__all__ = ["Measure", "WebPart", "WebScene"]


@dataclass(frozen=True)
class Measure:
    """Measured quantity that the page shows.

    Attributes:
        name: Name of the measure, as in the domain's `StyleMeasures`.
        parameter: Style parameter beside which the page shows it, or "" for none.
        text: What it is called on the page.
        unit: Unit, or "" for none.
        share: Whether it is a share of time, which the page shows in percent.
        at_marks: Whether the values at the last marks are listed beside the request.
        circular: Whether it is a direction in degrees, whose mean is that of directions.
    """

    name: str
    parameter: str
    text: str
    unit: str = ""
    share: bool = False
    at_marks: bool = False
    circular: bool = False


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


@dataclass(frozen=True)
class WebPart:
    """What the page needs to know of a domain that MuJoCo simulates, with one agent.

    The page steps `dynamics` by a control step, reads the sensors of `kinematics` in the new state, and calls
    `features` with them.

    Attributes:
        title: Title of the page.
        summary: One sentence for the visitor.
        dynamics: XML of the model that is stepped, without external assets.
        kinematics: XML of the model whose sensors the features read, without external assets.
        features: Module with the arguments `positions` (1, nq), `velocities` (1, nv), `sensors` (1, S) and `controls`
            (1, C) in float64, `style` (1, d) in float32 and `memory` (1, M) in float64. It returns `observation`
            float32, `measured` float32 in the order of `measures` with NaN where there is no value, `mark` (1, 5)
            float64, which is x, y, the direction's x and y, and the side of a mark on the ground, or NaN, `memory`
            for the next call, and `terminated` (1,) bool.
        example: Example of these arguments by name.
        measures: Measured quantities.
        starts: Initial states, each with `positions`, `memory` and `observation` as lists of numbers.
        physics: Constants of the physics: `control_step` and `physics_step` [s], `substeps`, `episode_steps` and
            whatever else is worth telling.
        push: Force [N] and `duration` [s] of the page's push, which acts on the first three velocities.
        followed: Body that the camera follows.
        scene: How the model is drawn.
        opens: Request with which the page opens, by name; what it lacks has its default.
        picture: What the picture shows, for those who do not see it.
        licence: Notice that the licence of the model asks for, or "" for none.
        terminated: Verb for a terminated episode in the past tense.
    """

    title: str
    summary: str
    dynamics: str
    kinematics: str
    features: nn.Module
    example: Mapping[str, Tensor]
    measures: Sequence[Measure]
    starts: Sequence[Mapping[str, Sequence[float]]]
    physics: Mapping[str, Any]
    push: Mapping[str, float]
    followed: str
    terminated: str
    scene: WebScene
    opens: Mapping[str, Any] = field(default_factory=dict)
    picture: str = "The agent"
    licence: str = ""
