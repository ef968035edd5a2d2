"""Top-down images of a race with track, cars and tyre wear."""

from __future__ import annotations

from typing import cast

import numpy as np
from torchrl.envs import EnvBase

from coachable.envs.racing.env import RacingEnv
from coachable.envs.racing.physics.state import ROW, WEARS

VIEW = 60.0  # [m] from the car to the left and right border of the image
_GRASS = "#7ba05b"
_CAR_COLOURS = ("#d62728", "#1f77b4", "#ff7f0e", "#9467bd", "#17becf")


class RacingRenderer:
    """Renderer of the surroundings of one car, with a map of the track in a corner.

    Args:
        width: Width of the image [px].
        height: Height of the image [px].
    """

    def __init__(self, width: int = 640, height: int = 480) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor=_GRASS)
        self._canvas = FigureCanvasAgg(self._figure)
        self._view = VIEW, VIEW * height / width

    def draw(self, env: EnvBase, row: int = 0) -> np.ndarray:
        """Return an image (height, width, 3) uint8 of the car of a row and of the cars of its group.

        Args:
            env: A `RacingEnv`, or an environment around it.
            row: Row of the car in the middle.
        """
        from matplotlib.patches import Polygon

        while not isinstance(env, RacingEnv):
            env = cast(EnvBase, env.base_env)
        state = env.state.cpu().numpy()
        self._figure.clear()
        axes = self._figure.add_axes((0, 0, 1, 1), facecolor=_GRASS)
        x, y = state[ROW["x"], row], state[ROW["y"], row]
        self._road(axes, env, row, x, y)
        for car, column in enumerate(_mates(env, row)):
            shape = _corners(env, state, column)
            colour = _CAR_COLOURS[car % len(_CAR_COLOURS)]
            axes.add_patch(Polygon(shape, closed=True, facecolor=colour, edgecolor="black", linewidth=0.6))
        axes.set(xlim=(x - self._view[0], x + self._view[0]), ylim=(y - self._view[1], y + self._view[1]))
        axes.axis("off")
        speed = 3.6 * float(np.hypot(state[ROW["vx"], row], state[ROW["vy"], row]))
        wear = " ".join(f"{100 * w:.0f}" for w in state[WEARS, row])
        gear, fuel = state[ROW["gear"], row], state[ROW["fuel"], row]
        text = f"{speed:3.0f} km/h  gear {gear:.0f}  fuel {fuel:.1f} l  wear {wear} %"
        axes.text(0.02, 0.96, text, transform=axes.transAxes, va="top", family="monospace", fontsize=9, color="white")
        self._map(env, state, row)
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Clear the figure."""
        self._figure.clear()

    @staticmethod
    def _road(axes, env: RacingEnv, row: int, x: float, y: float) -> None:
        table = _circuit(env, row)
        normal = np.stack([-table[:, 3], table[:, 2]], axis=1)
        left = table[:, :2] + table[:, 5:6] * normal
        right = table[:, :2] - table[:, 6:7] * normal
        near = np.hypot(table[:, 0] - x, table[:, 1] - y) < 2.5 * VIEW
        for start, stop in _runs(near):
            index = np.arange(start, stop + 1) % len(table)
            outline = np.concatenate([left[index], right[index][::-1]])
            axes.fill(*outline.T, color="#555555", linewidth=0)
            for edge in (left, right):
                axes.plot(*edge[index].T, color="white", linewidth=1.2)

    def _map(self, env: RacingEnv, state: np.ndarray, row: int) -> None:
        axes = self._figure.add_axes((0.76, 0.70, 0.23, 0.29))
        table = _circuit(env, row)
        axes.plot(*np.vstack([table[:, :2], table[:1, :2]]).T, color="white", linewidth=1.0)
        for car, column in enumerate(_mates(env, row)):
            place = state[ROW["x"], column], state[ROW["y"], column]
            axes.plot(*place, "o", color=_CAR_COLOURS[car % len(_CAR_COLOURS)], markersize=3)
        axes.set_aspect("equal")
        axes.axis("off")


def _circuit(env: RacingEnv, row: int) -> np.ndarray:
    """Return the table of the circuit that the car of a row is on."""
    return env.tracks[int(env.circuit[row % env.races])].table.numpy()


def _mates(env: RacingEnv, row: int) -> list[int]:
    """Return the columns of the cars that meet the car of a row, itself first."""
    car, race = divmod(row, env.races)
    group = env.group[:, race].cpu()
    others = [k for k in range(env.cars) if k != car and group[k] == group[car]]
    return [k * env.races + race for k in (car, *others)]


def _corners(env: RacingEnv, state: np.ndarray, column: int) -> np.ndarray:
    """Return the corners of the body, (4, 2) [m]."""
    length, width = (
        float(value[column]) if hasattr(value, "shape") else value
        for value in (env.garage.car.length, env.garage.car.width)
    )
    yaw = state[ROW["yaw"], column]
    local = 0.5 * np.array([[length, width], [-length, width], [-length, -width], [length, -width]])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return local @ turn + [state[ROW["x"], column], state[ROW["y"], column]]


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last index of each stretch of a closed mask; the last may be beyond the end."""
    if mask.all():
        return [(0, len(mask))]
    starts = np.flatnonzero(mask & ~np.roll(mask, 1))
    ends = np.flatnonzero(mask & ~np.roll(mask, -1))
    return [(int(s), int(next((e for e in ends if e >= s), ends[0] + len(mask)))) for s in starts]
