"""Starts of episodes: opponents, positions, speeds, tyres and fuel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from coachable.envs.racing.circuit.track import Course, Track
from coachable.envs.racing.physics.cars import COMPOUNDS, RACE_COMPOUNDS, Car
from coachable.envs.racing.physics.state import HEATS, ROW, SPINS, STATE_ROWS, WEARS
from coachable.envs.racing.race.counter_rng import normal, uniforms

STARTS = ("solo", "field", "rolling", "slipstream", "passing", "recovery", "launch")
GRID_SLOTS = 20
ROLLING_GAP = 14.0  # [m] between cars of a rolling start
_LAUNCH_SPEED = 60.0  # [m/s]
_PASSING_SPREAD = 0.2  # of the speed, between the slowest and the fastest car of a passing start
_WEAR_MAX, _WEAR_SPREAD = 0.75, 0.05
_FUEL = (10.0, 100.0)  # [l]
_HEAT = (30.0, 130.0)  # [°C], as hot as a stint makes them
_MEDIUM = COMPOUNDS.index("race_medium")
FUEL = 30.0  # [l], of cars that use none up
_DRAWS = 18  # random numbers per car and episode
_SHARES = {"solo": 0.30, "one_to_one": 0.15, "field": 0.25, "rolling": 0.10, "slipstream": 0.10, "recovery": 0.10}
_SHARES_ALONE = {"solo": 0.8, "recovery": 0.2}


@dataclass(frozen=True)
class Scenario:
    """One kind of start of an episode.

    Attributes:
        name: Name of the scenario and of its replay table.
        share: Share of the episodes.
        start: Positions and speeds: "solo" (anywhere, alone), "field" (cars in a line), "rolling" (two columns before
            the starting line), "slipstream" (close together in a line, on the longest straight), "passing" (there too,
            but spread across the track and some up to a fifth faster than others), "recovery" (off course, spun, slow)
            or "launch" (any heading and up to 60 m/s; every second start is an ordinary one).
        group: Number of cars that see and touch each other. Cars of different groups share the road without meeting.

    Raises:
        ValueError: If there is no such start.
    """

    name: str
    share: float
    start: str
    group: int = 1

    def __post_init__(self) -> None:
        if self.start not in STARTS:
            raise ValueError(f"scenario {self.name!r} starts {self.start!r}: expected one of {', '.join(STARTS)}")


SOLO = (Scenario("solo", 1.0, "solo"),)  # anywhere on the course, alone


def drift_scenarios() -> tuple[Scenario, ...]:
    """Return launches at random positions, speeds and orientations (paper).

    Half of the starts are ordinary (our choice).
    """
    return (Scenario("launch", 1.0, "launch"),)


def race_scenarios(cars: int, shares: Mapping[str, float] | None = None) -> tuple[Scenario, ...]:
    """Return the kinds of starts that a training mixes.

    The paper has scenarios "similar" to those of Wurman et al. (2022), without a list.

    Args:
        cars: Number of cars in a race.
        shares: Share of each kind of start, by its name; by default `_SHARES`, or for one car `_SHARES_ALONE`.

    Raises:
        ValueError: If there is no such kind.
    """
    if shares is None:
        shares = _SHARES if cars > 1 else _SHARES_ALONE
    kinds = {
        "solo": ("solo", 1),
        "one_to_one": ("field", 2),
        "field": ("field", cars),
        "rolling": ("rolling", cars),
        "slipstream": ("slipstream", cars),
        "passing": ("passing", cars),
        "recovery": ("recovery", 1),
    }
    if unknown := set(shares) - set(kinds):
        raise ValueError(f"shares of {', '.join(sorted(unknown))} given: expected some of {', '.join(kinds)}")
    return tuple(Scenario(name, shares[name], *kind) for name, kind in kinds.items() if name in shares)


def rolling_start(cars: int) -> tuple[Scenario, ...]:
    """Return rolling starts of races in which every car is in one group."""
    return (Scenario("rolling", 1.0, "rolling", cars),)


@dataclass(frozen=True)
class Conditions:
    """Conditions of tyres and fuel at the start.

    Attributes:
        wear: Whether tyres start worn, with X ~ U(0, 0.75) and each tyre from N(X, 0.05), clipped (paper).
        fuel: Fuel, or None for U(10, 100) (paper) [l].
        heat: Temperature of the tyres, or None for U(30, 130) [°C].
        compounds: Indices into `COMPOUNDS`, of which one is drawn uniformly per race.
    """

    wear: bool = False
    fuel: float | None = FUEL
    heat: float | None = 80.0
    compounds: tuple[int, ...] = (_MEDIUM,)

    @classmethod
    def resources(cls) -> Conditions:
        """Return the conditions of the tyre and fuel task."""
        return cls(wear=True, fuel=None, heat=None, compounds=RACE_COMPOUNDS)

    @classmethod
    def any_compound(cls) -> Conditions:
        """Return the conditions of the aggressiveness task: nine compounds, drawn uniformly."""
        return cls(compounds=tuple(range(len(COMPOUNDS))))


@dataclass(frozen=True)
class Starts:
    """Starts of B races of A cars, (A, B) or (…, A, B)."""

    state: Tensor  # (29, A, B)
    s: Tensor  # [m]
    distance: Tensor  # behind the first car of the group, 0 or negative [m]
    group: Tensor  # int64
    compound: Tensor  # int64, of `COMPOUNDS`
    scenario: Tensor  # (B,) int64


class Starter:
    """Sampler of starts on one course.

    Args:
        course: Track.
        scenarios: Mixture of scenarios.
        conditions: Tyres and fuel.
        speeds: Sensible speed at each node of the course (n,) [m/s].
        cars: Number A of cars in a race.

    Raises:
        ValueError: If there are more cars than grid slots, `scenarios` are not scenarios, or their shares do not add up
            to 1.
    """

    def __init__(
        self, course: Course, scenarios: Sequence[Scenario], conditions: Conditions, speeds: Tensor, cars: int
    ) -> None:
        if cars > GRID_SLOTS:
            raise ValueError(f"{cars} cars for {GRID_SLOTS} grid slots: expected at most {GRID_SLOTS} cars")
        if not all(isinstance(scenario, Scenario) for scenario in scenarios):
            raise ValueError(f"scenarios is {scenarios!r}: expected a list of Scenario")
        total = sum(scenario.share for scenario in scenarios)
        if not scenarios or abs(total - 1.0) > 1e-6:
            raise ValueError(f"shares of the scenarios add up to {total:g}: expected 1")
        self.course, self.scenarios, self.conditions, self.cars = course, tuple(scenarios), conditions, cars
        device = course.table.device
        self.speeds = speeds.to(device, torch.float32)
        shares = torch.tensor([scenario.share for scenario in scenarios], device=device)
        self._bounds = shares.cumsum(0)[:-1]
        self._start = torch.tensor([STARTS.index(scenario.start) for scenario in scenarios], device=device)
        self._group = torch.tensor([scenario.group for scenario in scenarios], device=device)
        self._compounds = torch.tensor(conditions.compounds, device=device)
        straights = [_longest_straight(track) for track in course.tracks]
        half = [float(track.table[:, 5:7].min()) for track in course.tracks]
        margin = [float(track.table[:, 7].min()) for track in course.tracks]
        columns = [*zip(*straights, strict=True), half, margin]
        self._circuits = torch.tensor(columns, dtype=torch.float32, device=device)  # (4, number of circuits)

    def draw(self, seed: Tensor, episode: Tensor, car: Car, circuit: Tensor) -> Starts:
        """Draw the starts of all races.

        Args:
            seed: Seed of each race (B,) int64.
            episode: Number of episodes that each race has started (B,) int64.
            car: Parameters.
            circuit: Number of the circuit of each race (B,) int64.
        """
        u = uniforms(seed, episode, _DRAWS, self.cars)
        first = u[:, 0]  # (rows, B), numbers that the cars of a race share
        scenario = torch.bucketize(first[0], self._bounds, right=True)
        kind, size = self._start[scenario], self._group[scenario]
        # Cars in a random order, so that no row always starts in front.
        order = u[1].argsort(0).argsort(0)
        group = order // size
        alone = size == 1

        def chosen(*names: str) -> Tensor:
            return torch.stack([kind == STARTS.index(name) for name in names]).any(0)

        length = self.course.race_length(self.cars)
        straight, extent, half, margin = self._circuits[:, circuit]
        rank = (order % size).to(u.dtype)  # place within the group, from the front
        close = chosen("slipstream", "passing")
        gap = torch.where(
            chosen("rolling"),
            ROLLING_GAP,
            torch.where(close, 7.0 + 6.0 * first[2], 8.0 + 22.0 * first[2]),
        )
        lead = torch.where(close, straight + extent * (0.2 + 0.4 * first[3]), length * first[3])
        lead = torch.where(chosen("rolling"), length - 10.0, lead)
        # Groups that do not meet spread over the track.
        s = torch.where(alone, length * u[4], lead + group * 97.0 - rank * gap)
        s = torch.remainder(s, length)
        spread = 2.0 * u[5] - 1.0
        column = torch.where(order % 2 == 0, 0.4, -0.4)
        offset = torch.where(
            chosen("rolling"), column, torch.where(chosen("slipstream"), 0.3 * first[6] - 0.15, 0.6 * spread)
        )
        offset = offset * half
        pace = torch.where(alone, 0.3 + 0.6 * u[7], 0.6 + 0.3 * first[7])
        sensible = self._sensible(s)
        slowest = sensible.min(0).values
        speed = pace * torch.where(alone, sensible, slowest)
        speed = torch.where(chosen("passing"), speed * (1.0 + _PASSING_SPREAD * (u[9] - 0.5)), speed)
        yaw_error = 0.05 * (2.0 * u[8] - 1.0)

        beside = half + margin - 3.0
        lost = chosen("recovery").expand_as(s)
        offset, speed = torch.where(lost, spread * beside, offset), torch.where(lost, 20.0 * u[7], speed)
        any_way = math.pi * (2.0 * u[8] - 1.0)
        launched = chosen("launch") & (u[9] < 0.5)
        offset = torch.where(chosen("launch"), 0.9 * half * spread, offset)
        speed = torch.where(launched, _LAUNCH_SPEED * u[7], speed)
        yaw_error = torch.where(lost | launched, any_way, yaw_error)

        compound = self._compounds[(first[10] * len(self._compounds)).long().clamp(max=len(self._compounds) - 1)]
        state = self._state(car, s, offset, yaw_error, speed, u)
        distance = torch.where(alone, 0.0, -rank * gap)
        return Starts(state, s, distance, group, compound.expand_as(order).contiguous(), scenario)

    def _state(self, car: Car, s: Tensor, offset: Tensor, yaw_error: Tensor, speed: Tensor, u: Tensor) -> Tensor:
        """Return the state (29, A, B) of rolling cars with tyres and fuel drawn from the conditions."""
        placed = (value.expand_as(s).reshape(-1) for value in (s, offset, yaw_error, speed))
        state = rolling_cars(self.course, car, *placed).reshape(-1, *s.shape)
        conditions = self.conditions
        low, high = _HEAT
        state[HEATS] = low + (high - low) * u[11] if conditions.heat is None else conditions.heat
        low, high = _FUEL
        state[ROW["fuel"]] = low + (high - low) * u[12] if conditions.fuel is None else conditions.fuel
        if conditions.wear:
            common = _WEAR_MAX * u[13]
            front = torch.stack([normal(u[14], u[15]), normal(u[14], (u[15] + 0.25) % 1.0)])
            rear = torch.stack([normal(u[16], u[17]), normal(u[16], (u[17] + 0.25) % 1.0)])
            state[WEARS] = (common + _WEAR_SPREAD * torch.cat([front, rear])).clamp(0.0, 1.0)
        return state

    def _sensible(self, s: Tensor) -> Tensor:
        return self.speeds[self.course.node(s.reshape(-1))].reshape(s.shape)


def rolling_cars(course: Course, car: Car, s: Tensor, offset: Tensor, yaw_error: Tensor, speed: Tensor) -> Tensor:
    """Return the state of cars that roll freely in a suitable gear, with heat, wear and fuel at 0.

    Args:
        course: Track.
        car: Parameters.
        s: Distance along the track (...) [m].
        offset: Offset from the centre line to the left (...) [m].
        yaw_error: Heading relative to the track (...) [rad].
        speed: Speed (...) [m/s].

    Returns:
        State (29, ...).
    """
    state = torch.zeros(STATE_ROWS, *s.shape, dtype=course.table.dtype, device=s.device)
    x, y, direction = course.place(s, offset)
    radius = car.wheel_radius.reshape(s.shape) if isinstance(car.wheel_radius, Tensor) else car.wheel_radius
    for name, value in (("x", x), ("y", y), ("yaw", direction + yaw_error), ("vx", speed)):
        state[ROW[name]] = value
    state[SPINS] = speed / radius
    state[ROW["gear"]] = (1.0 + speed / 14.0).floor().clamp(max=5.0)
    return state


def _longest_straight(track: Track) -> tuple[float, float]:
    """Return start and length of the longest stretch with hardly any curvature [m]."""
    straight = (track.table[:, 4].abs() < 1e-3).tolist()
    best, start, run = (0, 0), 0, 0
    for index, flag in enumerate(straight * 2):
        run = run + 1 if flag else 0
        if run == 1:
            start = index
        if best[1] < run <= len(straight):
            best = (start, run)
    return best[0] % len(straight) * track.spacing, best[1] * track.spacing
