"""Trade-off of lap time against tyre wear and fuel, by dynamic programming over speeds on a fixed line.

    python -m coachable.domains.racing.frontier docs/results/racing

The car is a point mass with a friction ellipse, an engine and brakes. A lap consists of stages of about 6 m. In each
stage the programme chooses throttle or brakes to minimise lap time + λ · resource. A sweep of λ gives the best
trade-off on this line, apart from the effects that a point mass neglects.
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coachable.envs.racing.circuit.circuits import load_track
from coachable.envs.racing.circuit.line import minimum_curvature_line
from coachable.envs.racing.circuit.profile import Envelope
from coachable.envs.racing.circuit.track import Track
from coachable.envs.racing.physics.cars import Car, Resources, load_car
from coachable.envs.racing.physics.powertrain import (
    ENGINE_EFFICIENCY,
    FRICTION_SHARE,
    FUEL_DENSITY,
    FUEL_ENERGY,
    IDLE_RATE,
)
from coachable.envs.racing.physics.tyres import WEAR_ENERGY
from coachable.envs.racing.race.driver import line_geometry
from coachable.evaluation.figures import drawing
from coachable.evaluation.style_grid import write_csv

STAGE = 6.0  # [m], about
SPEEDS = np.linspace(4.0, 100.0, 385)  # [m/s], from below the speed of the slowest corner
THROTTLE = np.linspace(0.0, 1.0, 12)  # share of the engine's power; 0 is coasting
BRAKE = np.array([0.15, 0.3, 0.5, 0.75, 0.9, 1.0])  # share of the braking that the ellipse leaves
RESOURCES = ("tyre", "fuel")
TANK = 100.0  # [l]
WORN = 0.75  # mean wear that ends a stint
_TOO_FAST = 1e4  # [s], cost of a speed that the corner does not allow
# Engine speed relative to its highest, as a constant and a slope over power: the middle of the gearbox's shift band.
_CRUISE = (0.56, 0.34)

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Lap:
    """Result of one lap.

    Attributes:
        time: Lap time [s].
        fuel: Fuel used [l].
        wear: Mean wear of the tyres.
    """

    time: float
    fuel: float
    wear: float


class LapProgramme:
    """Dynamic programme for the laps of least cost of one car on one track.

    Args:
        track: Circuit.
        car: Parameters of one car, as numbers.
        resources: Wear and fuel rates; `fuel_exponent` determines how much part throttle saves.
        fuel: Fuel on board, half a tank by default [l].
        line: Offset from the centre line (n,); by default the line of least curvature [m].

    Example:
        >>> programme = LapProgramme(load_track("ring"), load_car("gt3"), Resources(wear=1.0, fuel=1.0))
        >>> [lap] = programme.laps("fuel", [0.0])
        >>> 18 < lap.time < 22
        True
    """

    def __init__(
        self, track: Track, car: Car, resources: Resources, *, fuel: float = TANK / 2, line: np.ndarray | None = None
    ) -> None:
        curvature, spacing = line_geometry(track, minimum_curvature_line(track) if line is None else line)
        ends = np.concatenate([[0.0], np.cumsum(spacing)])
        count = max(3, round(ends[-1] / STAGE))
        self.step = float(ends[-1] / count)
        middle = (np.arange(count) + 0.5) * self.step
        self.curvature = np.abs(np.interp(middle, ends, np.append(curvature, curvature[0])))
        self.car, self.resources, self.envelope = car, resources, Envelope(car, fuel=fuel)
        self._tables()

    def laps(self, resource: str, prices: Sequence[float]) -> list[Lap]:
        """Return the lap of least cost for each price.

        The cost of a lap is its time plus the price times the use of the resource, a Lagrangian of "least use at a
        given time". Backward dynamic programming over the stages of the lap minimises it (Bellman's equation); a second
        lap closes the loop.

        Args:
            resource: "tyre" or "fuel".
            prices: Values of λ: seconds per unit of mean wear, or per litre.

        Raises:
            ValueError: If the resource is unknown.
        """
        if resource not in RESOURCES:
            raise ValueError(f"unknown resource {resource!r}: expected tyre or fuel")
        price = np.asarray(prices, dtype=float)[:, None, None]
        count = len(self.curvature)
        value = np.zeros((len(prices), len(SPEEDS)))
        choice = np.zeros((count, len(prices), len(SPEEDS)), dtype=np.int64)
        for stage in range(2 * count - 1, -1, -1):  # the second lap gives the values at the end of the first
            k = stage % count
            after, cost, allowed = self._stage(k)
            spent = cost["time"] + price * cost[resource]
            total = spent + self._ahead(value, after)
            total = np.where(allowed, total, _TOO_FAST)
            choice[k] = total.argmin(-1)
            value = total.min(-1)
        return self._drive(choice)

    def _tables(self) -> None:
        """Compute the quantities that do not depend on the stage, for all V speeds and U choices of the pedals."""
        car, envelope = self.car, self.envelope
        v = SPEEDS[:, None]
        power = THROTTLE[None, :]
        rev = _CRUISE[0] + _CRUISE[1] * power
        engine = rev * car.rpm_max * (2 * math.pi / 60.0)  # [rad/s]
        drag_power = car.engine_brake * (0.3 + 0.7 * rev) * engine
        # Acceleration by the engine: that at full throttle times the share of power, less the engine brake.
        self._pull = power * envelope.engine(v) - (1.0 - power) * car.efficiency * drag_power / envelope.mass / v
        burning = car.power * power**self.resources.fuel_exponent + FRICTION_SHARE * drag_power
        rate = np.where(power > 0.02, burning / (ENGINE_EFFICIENCY * FUEL_ENERGY), 0.0)
        rate = self.resources.fuel * np.maximum(rate, IDLE_RATE) / FUEL_DENSITY
        idle = np.full(len(BRAKE), self.resources.fuel * IDLE_RATE / FUEL_DENSITY)
        self._fuel_rate = np.concatenate([rate[0], idle])  # (U,) [l/s]
        self._friction, self._drag = envelope.friction(SPEEDS), envelope.drag(SPEEDS)
        self._driven = np.minimum(envelope.traction(SPEEDS) / self._friction, 1.0)

    def _stage(self, k: int) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
        """Return the speeds after stage k (V, U), its costs (V, U) each, and whether the tyres allow it (V, U)."""
        lateral = (SPEEDS**2 * self.curvature[k])[:, None]
        friction, driven = self._friction[:, None], self._driven[:, None]
        left = np.sqrt(np.clip(friction**2 - lateral**2, 0.0, None))
        pull = np.minimum(self._pull, driven * left)
        braked = -BRAKE[None, :] * left
        tyre = np.concatenate([pull, braked], axis=1)  # acceleration by the tyres
        after = np.sqrt(np.clip(SPEEDS[:, None] ** 2 + 2 * self.step * (tyre - self._drag[:, None]), 1.0, None))
        seconds = 2 * self.step / (SPEEDS[:, None] + after)
        # Only the driven axle pulls; all wheels brake.
        share = np.concatenate([np.broadcast_to(driven, pull.shape), np.ones_like(braked)], axis=1)
        power = share * self._slip_power(tyre / share, lateral) + (1.0 - share) * self._slip_power(0.0, lateral)
        wear = self.resources.wear * self.envelope.mass * power * seconds / 4 / WEAR_ENERGY
        allowed = np.broadcast_to(lateral <= friction, after.shape) & (after >= SPEEDS[0]) & (after <= SPEEDS[-1])
        return after, {"time": seconds, "fuel": self._fuel_rate * seconds, "tyre": wear}, allowed

    def _slip_power(self, along: Any, across: np.ndarray) -> np.ndarray:
        """Return the power lost in slip per mass [W/kg] at accelerations [m/s²], by inverting the tyre curve."""
        car, speed = self.car, SPEEDS[:, None]
        total = np.sqrt(along**2 + across**2) + 1e-9
        used = np.minimum(total / self._friction[:, None], 1.0)
        slip = np.tan(np.arcsin(used) / car.shape) / math.tan(math.pi / 2 / car.shape)
        return speed * slip * (car.peak_slip_ratio * along**2 + math.tan(car.peak_slip_angle) * across**2) / total

    @staticmethod
    def _ahead(value: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Interpolate values (Λ, V) at speeds (V, U) linearly, to (Λ, V, U)."""
        place = np.clip((after - SPEEDS[0]) / (SPEEDS[1] - SPEEDS[0]), 0.0, len(SPEEDS) - 1.0)
        below = np.minimum(place.astype(np.int64), len(SPEEDS) - 2)
        part = place - below
        return value[:, below] * (1.0 - part) + value[:, below + 1] * part

    def _drive(self, choice: np.ndarray) -> list[Lap]:
        """Drive two laps by each of the choices (S, Λ, V) and return the second ones."""
        count, prices = choice.shape[:2]
        each = np.arange(prices)
        speed = np.full(prices, 40.0)
        spent: dict[str, np.ndarray] = {}
        for _ in range(2):
            spent = {name: np.zeros(prices) for name in ("time", "fuel", "tyre")}
            for k in range(count):
                after, cost, allowed = self._stage(k)
                fastest = np.flatnonzero(allowed.any(1))[-1]
                place = np.clip((speed - SPEEDS[0]) / (SPEEDS[1] - SPEEDS[0]), 0.0, fastest)
                low = np.minimum(place.astype(np.int64), max(fastest - 1, 0))
                part = place - low
                pedals = choice[k, each, low], choice[k, each, low + 1]

                def mean(table: np.ndarray, low=low, part=part, pedals=pedals) -> np.ndarray:
                    return (1.0 - part) * table[low, pedals[0]] + part * table[low + 1, pedals[1]]

                for name in spent:
                    spent[name] += mean(np.broadcast_to(cost[name], after.shape))
                speed = mean(after)
        time, fuel, wear = (spent[name] for name in ("time", "fuel", "tyre"))
        return [Lap(float(time[i]), float(fuel[i]), float(wear[i])) for i in range(prices)]


def sweep(
    car: str,
    resource: str,
    prices: Sequence[float],
    *,
    exponent: float = 2.5,
    track: str = "lakeside",
    fuel: float = TANK / 2,
) -> Rows:
    """Return the rows of the trade-off as dictionaries, the fastest lap first.

    Args:
        car: Name of a shipped car.
        resource: "tyre" or "fuel".
        prices: Values of λ in seconds per lap at the fastest lap's use; at 1 a lap's use of the resource is worth 1 s.
        exponent: Exponent n of the fuel law.
        track: Name of a shipped circuit.
        fuel: Fuel on board, half a tank by default [l].
    """
    rates = Resources.calibrated(car)
    programme = LapProgramme(load_track(track), load_car(car), Resources(rates.wear, rates.fuel, exponent), fuel=fuel)
    [free] = programme.laps(resource, [0.0])
    use = {"tyre": free.wear, "fuel": free.fuel}[resource]
    rows = []
    for price, lap in zip([0.0, *prices], [free, *programme.laps(resource, [p / use for p in prices])], strict=True):
        spent = {"tyre": lap.wear, "fuel": lap.fuel}[resource]
        rows.append(
            {
                "car": car,
                "resource": resource,
                "fuel_exponent": exponent,
                "price": price,
                "lap_time": lap.time,
                "seconds_lost": lap.time - free.time,
                "fuel_per_lap": lap.fuel,
                "wear_per_lap": lap.wear,
                "range_gain": use / spent - 1.0,
            }
        )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Write frontier.csv and frontier.png to the folder that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder")
    out: Path = parser.parse_args(arguments).out
    out.mkdir(parents=True, exist_ok=True)
    prices = [1.0, 2.0, 4.0, 6.0, 9.0, 12.0, 16.0, 24.0]
    curves = [
        sweep(car, resource, prices, exponent=exponent)
        for car in ("gt3", "x2019")
        for resource, exponent in (("tyre", 2.5), ("fuel", 2.5), ("fuel", 1.0))
    ]
    write_csv([row for rows in curves for row in rows], out / "frontier.csv")
    draw(curves, out / "frontier.png")


def draw(curves: Sequence[Rows], path: Path) -> None:
    """Draw the gain in range over the seconds lost per lap, with one curve per car and resource.

    Args:
        curves: One frontier per car and resource, as rows with `seconds_lost` [s] and `range_gain` (share).
        path: Image file to write.
    """
    styles = {("tyre", 2.5): "-", ("fuel", 2.5): "--", ("fuel", 1.0): ":"}
    with drawing(path, size=(7.0, 4.2)) as ((axes,),):
        for rows in curves:
            first = rows[0]
            label = "tyre life" if first["resource"] == "tyre" else f"fuel range, n = {first['fuel_exponent']:g}"
            axes.plot(
                [row["seconds_lost"] for row in rows],
                [100 * row["range_gain"] for row in rows],
                styles[first["resource"], first["fuel_exponent"]],
                color={"gt3": "C0", "x2019": "C1"}[first["car"]],
                marker="o",
                markersize=3,
                label=f"{first['car']}, {label}",
            )
        axes.set(xlim=(0, 6), ylim=(0, 120), xlabel="lap time lost [s]", ylabel="range gained [%]")
        axes.set_title("Lakeside: what a point mass can trade (n = 2.5 is the game-like fuel law)", fontsize=10)
        axes.legend(fontsize=8)


if __name__ == "__main__":
    main()
