"""What a domain shows of a state: primitives, labels, gauges and a legend."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from torchrl.envs import EnvBase

from coachable.scene.palette import Colour
from coachable.scene.parts import Numbers, Parts, Surface


@dataclass(frozen=True)
class Label:
    """Text at a place.

    Attributes:
        text: The text, without line breaks.
        position: Place (3,) [m].
    """

    text: str
    position: Numbers


@dataclass(frozen=True)
class Gauge:
    """Quantity beside the scene.

    Attributes:
        name: What it is.
        text: Its value with the unit.
        share: Length of its bar, from 0 to 1, or None for a text alone.
        colour: Colour of its bar.
    """

    name: str
    text: str
    share: float | None = None
    colour: Colour = (0, 114, 178)


@dataclass(frozen=True)
class Map:
    """Small map beside the scene.

    Attributes:
        outline: Points of a closed line (n, 2) [m].
        places: Places on it (2,) [m], the agent's first.
        colours: Colours of the places, which are repeated if there are too few.
    """

    outline: np.ndarray
    places: Sequence[tuple[float, float]]
    colours: Sequence[Colour]

    def scaled(self, width: float, height: float) -> tuple[np.ndarray, np.ndarray]:
        """Return outline and places in a picture, with y downwards and a margin of 8 %.

        Args:
            width: Width of the picture [pixels].
            height: Height of the picture [pixels].

        Returns:
            Outline (n, 2) and places (m, 2) [pixels].
        """
        low, high = self.outline.min(0), self.outline.max(0)
        scale = 0.84 * min(width / (high[0] - low[0]), height / (high[1] - low[1]))
        middle, centre = (low + high) / 2, np.array([width, height]) / 2
        outline, places = self.outline, np.asarray(self.places)
        down = np.array([scale, -scale])
        return centre + down * (outline - middle), centre + down * (places - middle)


@dataclass(frozen=True)
class Backdrop:
    """What does not move.

    Attributes:
        surfaces: Ground and other triangles.
        parts: Primitives on it.
        travels: Whether it is a pattern that repeats every metre and goes along with the agent.
    """

    surfaces: Sequence[Surface]
    parts: Parts = field(default_factory=Parts)
    travels: bool = False


@dataclass(frozen=True)
class Frame:
    """What is to be seen of one state.

    Attributes:
        parts: Primitives that move. Where two frames in a row have equally many of each shape, those in between are
            drawn as well.
        focus: Place that the camera follows (3,) [m].
        heading: Direction in which the agent faces, counter-clockwise from +x [rad].
        place: Key of the backdrop, which is drawn anew when the key changes.
        marks: Primitives that stay where they are, such as footprints.
        glows: Translucent primitives, such as lines of fire.
        labels: Texts in the scene.
        gauges: Quantities beside the scene.
        map: Small map, if there is one.
        episode: Key of the episode; frames of different ones do not continue each other.
    """

    parts: Parts
    focus: Numbers
    heading: float
    place: Hashable = ""
    marks: Parts = field(default_factory=Parts)
    glows: Parts = field(default_factory=Parts)
    labels: Sequence[Label] = ()
    gauges: Sequence[Gauge] = ()
    map: Map | None = None
    episode: Hashable = 0


@dataclass(frozen=True)
class Viewpoint:
    """Where the camera is at first, relative to the focus.

    Attributes:
        distance: Distance from the focus [m].
        elevation: Angle above the horizon [deg].
        azimuth: Direction from the focus to the camera, counter-clockwise from +x, or from the heading if the camera
            turns with the agent [deg].
        turns: Whether the camera turns with the agent.
        far: Distance up to which the scene is drawn [m].
        height: Height of the focus [m].
    """

    distance: float
    elevation: float
    azimuth: float
    turns: bool = False
    far: float = 200.0
    height: float = 0.9

    @property
    def haze(self) -> tuple[float, float]:
        """Distances from the camera at which things begin to fade, and at which they cannot be seen any more [m]."""
        return 2.0 * self.distance, self.far


class Stage(Protocol):
    """Description of a domain's scene.

    It may remember what happened since an episode began, such as footprints, and is therefore used for one row of one
    environment.
    """

    @property
    def viewpoint(self) -> Viewpoint:
        """Where the camera is at first."""
        ...

    @property
    def legend(self) -> Sequence[tuple[Colour, str]]:
        """Colours and what they mean."""
        ...

    def backdrop(self, env: EnvBase, row: int = 0) -> Backdrop:
        """Return what does not move, for the place of the last frame."""
        ...

    def frame(self, env: EnvBase, row: int = 0, asked: Mapping[str, float | str] | None = None) -> Frame:
        """Return what is visible in the present state of one row.

        Args:
            env: The base environment.
            row: Row of the batch.
            asked: Style in force by name, if known.
        """
        ...
