"""`RacingEnv`, a TorchRL environment of B races of A cars with one row per car."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded, Unbounded
from torchrl.envs import EnvBase

from coachable.envs.racing.circuit.circuits import load_tracks
from coachable.envs.racing.circuit.profile import Envelope, speed_profiles
from coachable.envs.racing.circuit.track import Course, Track
from coachable.envs.racing.physics.cars import Resources, compound_table
from coachable.envs.racing.physics.simulation import SUBSTEPS, Simulation, maybe_compile
from coachable.envs.racing.physics.state import STATE_ROWS
from coachable.envs.racing.race.features import style_features_size
from coachable.envs.racing.race.garage import Garage
from coachable.envs.racing.race.observation import COURSE_POINTS, observation_groups
from coachable.envs.racing.race.referee import TELEMETRY, WRONG_WAY_TIME, Referee, Verdict
from coachable.envs.racing.race.rescue import back_on_track, way_clear
from coachable.envs.racing.race.rivals import Rivals
from coachable.envs.racing.race.run import RUN_ROWS, Field, Run
from coachable.envs.racing.race.scenarios import Conditions, Scenario, Starter, race_scenarios
from coachable.envs.racing.race.task import TaskWeights
from coachable.finite import require_action
from coachable.keys import SCENARIO, STYLE_FEATURES, TASK_REWARD
from coachable.ranges import COUNT
from coachable.specs import set_specs

EPISODE_STEPS = 1500  # 150 s
TELEMETRY_KEY = "telemetry"

Driver = Callable[[Field, Tensor], Tensor]
"""Function of a field and observations (M, D) that returns the actions (M, 2) of its last M cars.

Drivers control the cars that the agent does not.
"""


class RacingEnv(EnvBase):
    """Environment of B races of A cars, in which row k * B + b is car k of race b.

    A car is a row and not a nested agent, so that styles, rewards, replay and losses treat it like any other
    environment. The cars of a race start and end their episode together. When one car terminates (wrong way, stopped,
    outside the walls), the others of its race are truncated, unless stranded cars are put back. None of this depends
    on the style.

    Args:
        num_envs: Number of rows: the cars that the agent drives, which are races times `controlled`.
        cars: Number A of cars in each race.
        controlled: Number of cars of each race that the agent drives, the first ones; all by default. `driver` drives
            the others.
        driver: Driver of the other cars.
        track: Name of a circuit, a `Track`, several of them, or the name of a set, see `load_tracks`. With several
            circuits, races take turns on them: race b drives its episode e on circuit b + e, modulo the number of
            circuits, all counted from 0.
        car: Name of a shipped car, "pool" for cars drawn from a pool of 530, one model per race and episode, or
            "gt3_pool" for its 50 GT3-like cars in turn.
        adaptive: Whether cars of the pool that spin are drawn more often; otherwise all are equally likely.
        scenarios: Kinds of starts of the episodes; by default the mixture of `race_scenarios`.
        conditions: Tyres and fuel at the start.
        resources: Wear and fuel rates.
        weights: Weights of the task reward.
        course_points: Number of points of each edge of the track in the observation.
        curvature: Whether the observation has the curvature of the track ahead instead of the place on the lap, which
            is 0 then. Use it for agents that will drive circuits on which they were not trained.
        opponents: Whether the observation has columns for opponents; by default it has them if there are several cars.
            They are 0 for a car that is alone.
        episode_steps: Number of control steps (0.1 s) after which an episode is truncated.
        wrong_way_time: Time of driving backwards that ends an episode [s].
        put_back: Whether to put stranded cars (wrong way, stopped, outside the walls) back on the track at 15 m/s as
            soon as no other car is near, and to terminate no episode. Use it for races. A stranded car pays
            `TaskWeights.stranded` in every step until then.
        copies: Number of races with equal starts: race b starts like race b + races / copies. Use it to compare styles
            on equal terms.
        substeps: Number of substeps of the physics in a control step; use 40 for accurate runs.
        compiled: Whether to compile the physics and the task. This takes minutes at first and is several times faster
            then. (TorchRL reserves the name `compile`.)
        device: Device of all tensors.
        seed: Seed of the starts; each race, up to `copies`, has a random stream of its own.
        num_threads: Ignored; torch's own threads are used.

    Keys written: `observation` (N, D), `task_reward` (N, 1), `style_features` (N, 10 + 3 (A - 1)), `telemetry` (N, 15),
    `scenario` (N, 1) int64, `done`, `terminated`, `truncated` (N, 1).

    Raises:
        ValueError: If the car or the track is unknown, or if the numbers of cars and races do not fit together, or if
            a switch is not a bool.

    Example:
        >>> env = RacingEnv(num_envs=2, track="ring", seed=0)
        >>> env.rollout(3)["next", "style_features"].shape
        torch.Size([2, 3, 10])
    """

    runs_past_time_limit = True
    """An episode may be continued after it was truncated."""

    def __init__(
        self,
        num_envs: int = 64,
        *,
        cars: int = 1,
        controlled: int | None = None,
        driver: Driver | None = None,
        track: str | Track | Sequence[str | Track] = "lakeside",
        car: str = "gt3",
        adaptive: bool = True,
        scenarios: Sequence[Scenario] | None = None,
        conditions: Conditions | None = None,
        resources: Resources | None = None,
        weights: TaskWeights | None = None,
        course_points: int = COURSE_POINTS,
        curvature: bool = False,
        opponents: bool | None = None,
        episode_steps: int = EPISODE_STEPS,
        wrong_way_time: float = WRONG_WAY_TIME,
        put_back: bool = False,
        copies: int = 1,
        substeps: int = SUBSTEPS,
        compiled: bool = False,
        device: torch.device | str = "cpu",
        seed: int | None = None,
        num_threads: int | None = None,
    ) -> None:
        controlled = cars if controlled is None else controlled
        if not 1 <= controlled <= cars:
            raise ValueError(f"controlled is {controlled}: expected 1 to {cars}, the number of cars in a race")
        if num_envs < 1 or num_envs % controlled:
            raise ValueError(
                f"num_envs is {num_envs}: expected a positive multiple of the {controlled} controlled cars"
            )
        COUNT.check("episode_steps", episode_steps)
        if controlled < cars and driver is None:
            raise ValueError(f"{cars - controlled} cars of each race have no driver: pass one as driver=")
        if copies < 1 or (num_envs // controlled) % copies:
            raise ValueError(f"copies is {copies}: expected a divisor of the {num_envs // controlled} races")
        opponents = cars > 1 if opponents is None else opponents
        if cars > 1 and not opponents:
            raise ValueError(f"opponents is False for {cars} cars: expected True, or None, in a race of several cars")
        switches = {"adaptive": adaptive, "curvature": curvature, "opponents": opponents, "put_back": put_back}
        for name, value in (switches | {"compiled": compiled}).items():
            if not isinstance(value, bool):
                raise ValueError(f"{name} is {value!r}: expected True or False")
        super().__init__(device=device, batch_size=torch.Size((num_envs,)))
        self.num_envs, self.cars, self.controlled = num_envs, cars, controlled
        self.races, self.driver, self.episode_steps = num_envs // controlled, driver, episode_steps
        self.put_back = put_back
        self._start_of_race = torch.arange(self.races, device=device) % (self.races // copies)
        self.tracks = load_tracks(track)
        place = torch.device(device)
        self.course = Course(self.tracks, place)
        self.garage = Garage(car, cars, self.races, place, adaptive=adaptive)
        self.simulation = Simulation(
            self.garage.car, resources or Resources(), cars=cars, substeps=substeps, compile=compiled, device=place
        )
        self.referee = Referee(
            self.course,
            weights or TaskWeights(),
            cars,
            substeps,
            course_points,
            pool=self.garage.pooled,
            opponents=opponents,
            curvature=curvature,
            wrong_way_time=wrong_way_time,
        )
        bends, spacings = [one.table[:, 4].numpy() for one in self.tracks], [one.spacing for one in self.tracks]
        speeds = torch.tensor(np.concatenate(speed_profiles(Envelope(self.garage.typical), bends, spacings)))
        self.starter = Starter(self.course, scenarios or race_scenarios(cars), conditions or Conditions(), speeds, cars)
        self._command = maybe_compile(self.referee.command, place, compiled)
        self._judge = maybe_compile(self.referee.judge, place, compiled)
        self._compounds = compound_table().to(place)
        rows = cars * self.races
        self.state = torch.zeros(STATE_ROWS, rows, device=place)
        self.run = torch.zeros(RUN_ROWS, rows, device=place)
        self.compound = torch.zeros(2 + len(self._compounds), rows, device=place)
        self.group = torch.zeros(cars, self.races, dtype=torch.int64, device=place)
        self.scenario = torch.zeros(self.races, dtype=torch.int64, device=place)
        self.episode = torch.zeros(self.races, dtype=torch.int64, device=place)
        self.seeds = torch.zeros(self.races, dtype=torch.int64, device=place)
        self.observation_groups = observation_groups(opponents, self.garage.pooled, course_points, curvature)
        self.observation_size = sum(group.width for group in self.observation_groups)
        self._observation = torch.zeros(rows, self.observation_size, device=place)
        self._set_seed(seed)
        set_specs(
            self,
            action=Bounded(-1.0, 1.0, torch.Size((num_envs, 2)), dtype=torch.float32, device=place),
            observation=self.observation_size,
            style_features=style_features_size(cars),
            further={
                TELEMETRY_KEY: len(TELEMETRY),
                SCENARIO: Unbounded(torch.Size((num_envs, 1)), dtype=torch.int64, device=place),
            },
        )

    # -- TorchRL ---------------------------------------------------------------------------------------------------

    def _set_seed(self, seed: int | None) -> None:
        start = int(torch.randint(2**31, ()).item()) if seed is None else seed
        self.seeds = start % 2**43 * 1_000_003 + self._start_of_race  # fits into 64 bits
        self.episode = torch.zeros_like(self.episode)
        self.course.assign(self.circuit.repeat(self.cars))
        self.garage.reset()

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        partial = None if tensordict is None else tensordict.get("_reset", None)
        if partial is None:
            races = torch.ones(self.races, dtype=torch.bool, device=self.device)
        else:
            wanted = partial.reshape(self.controlled, self.races)
            races = wanted.any(0)
            if bool((wanted != races).any()):
                raise ValueError("_reset has only some rows of a race: expected all rows of a race or none")
        self._start_races(races)
        self._observation = self.referee.observe(
            self.state, self.run, self.compound, self.garage.car, self.simulation.wheels, self._groups
        )
        zero = torch.zeros(self.num_envs, 1, device=self.device)
        done = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device)
        return TensorDict(
            {
                "observation": self._observation[: self.num_envs].clone(),
                TASK_REWARD: zero,
                STYLE_FEATURES: zero.expand(-1, style_features_size(self.cars)).clone(),
                TELEMETRY_KEY: zero.expand(-1, len(TELEMETRY)).clone(),
                SCENARIO: self._scenario_rows(),
                "done": done,
                "terminated": done.clone(),
                "truncated": done.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action").detach()
        require_action(action, self.num_envs, 2)  # steering and pedals
        action = action.clamp(-1.0, 1.0).to(torch.float32)
        if self.driver is not None and self.controlled < self.cars:
            driven = self.driver(self.field, self._observation[self.num_envs :])
            action = torch.cat([action, driven.detach().clamp(-1.0, 1.0).to(action)])
        old, inputs = self._command(self.state, self.run, action, self.compound)
        new, impact = self.simulation.step(old, inputs, self.group)
        several = () if impact is None else (self.group, impact)
        verdict = self._judge(
            old, new, self.run, action, self.compound, self.garage.car, self.simulation.wheels, *several
        )
        if self.put_back:
            verdict = self._rescue(verdict)
        self.state, self.run, self._observation = verdict.state, verdict.run, verdict.observation
        n = self.num_envs
        terminated = verdict.terminated[:n, None]
        over = (verdict.terminated.reshape(self.cars, -1).any(0)) | (self._steps >= self.episode_steps)
        truncated = over.repeat(self.controlled)[:, None] & ~terminated
        reward = verdict.reward[:n, None]
        return TensorDict(
            {
                "observation": verdict.observation[:n].clone(),
                TASK_REWARD: reward,
                "reward": reward.clone(),
                STYLE_FEATURES: verdict.features[:n],
                TELEMETRY_KEY: verdict.telemetry[:n],
                SCENARIO: self._scenario_rows(),
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    # -- state -----------------------------------------------------------------------------------------------------

    def simulator_state(self) -> dict[str, Any]:
        """Return all tensors that the next step depends on, for exact resumption."""
        tensors = {name: getattr(self, name).clone() for name in _STATE}
        state = tensors | {"observation_now": self._observation.clone()} | self.garage.state()
        return state | ({"rivals": self.driver.state()} if isinstance(self.driver, Rivals) else {})

    def load_simulator_state(self, state: dict[str, Any]) -> None:
        """Restore what `simulator_state` returned.

        Args:
            state: Result of `simulator_state` of an environment with as many races and cars.

        Raises:
            ValueError: If it comes from other numbers of races or cars.
        """
        if state["group"].shape != self.group.shape:
            cars, races = state["group"].shape
            raise ValueError(f"state of {races} races of {cars} cars given, this env has {self.races} of {self.cars}")
        for name in _STATE:
            setattr(self, name, state[name].to(self.device, copy=True))
        self.course.assign(self.circuit.repeat(self.cars))
        self._observation = state["observation_now"].to(self.device, copy=True)
        self.garage.load_state(state)
        self.simulation.set_cars(self.garage.car)
        if isinstance(self.driver, Rivals):
            self.driver.load_state(state["rivals"])

    def follow(self, policy: nn.Module) -> None:
        """Set the policy that rivals copy; it has no effect without rivals."""
        if isinstance(self.driver, Rivals):
            self.driver.follow(policy)

    @property
    def circuit(self) -> Tensor:
        """Number of the circuit of each race (B,), an index into `tracks`."""
        return (self._start_of_race + (self.episode - 1).clamp(min=0)) % len(self.tracks)

    @property
    def field(self) -> Field:
        """All cars in their present state, for drivers."""
        wheels, grip = self.simulation.wheels, self.compound[0]
        cars = (self.state, self.run, self.garage.car, wheels, grip)
        return Field(*cars, self.course, self.group, self.seeds, self.episode)

    @property
    def scenario_names(self) -> tuple[str, ...]:
        """Names of the scenarios, in the order of the numbers in `scenario`."""
        return tuple(scenario.name for scenario in self.starter.scenarios)

    @property
    def _groups(self) -> Tensor | None:
        return self.group if self.cars > 1 else None

    @property
    def _steps(self) -> Tensor:
        return Run(*self.run.unbind(0)).steps[: self.races]

    def _scenario_rows(self) -> Tensor:
        return self.scenario.repeat(self.controlled)[:, None]

    def _rescue(self, verdict: Verdict) -> Verdict:
        """Put stranded cars back on a clear stretch of the track instead of ending their episodes."""
        stranded, course, car = verdict.terminated, self.course, self.garage.car
        verdict = verdict._replace(terminated=torch.zeros_like(stranded))
        if not stranded.any():
            return verdict
        run = Run(*verdict.run.unbind(0))
        helped = stranded & way_clear(course, run, stranded, self.group)
        state = torch.where(helped, back_on_track(course, car, verdict.state, run), verdict.state)
        begun = Run(*self.referee.begin(state, run.s, run.distance, car, self._groups).unbind(0))
        begun = begun._replace(steps=run.steps, spins=run.spins)
        packed_run = torch.where(helped, torch.stack(list(begun)), verdict.run)
        observation = self.referee.observe(state, packed_run, self.compound, car, self.simulation.wheels, self._groups)
        return verdict._replace(state=state, run=packed_run, observation=observation)

    def _start_races(self, races: Tensor) -> None:
        """Start new episodes of the races (B,) bool and leave the others unchanged."""
        self.episode = self.episode + races
        self.course.assign(self.circuit.repeat(self.cars))
        if self.garage.pooled:
            self.garage.draw(races, self.seeds, self.episode, Run(*self.run.unbind(0)).spins)
            self.simulation.set_cars(self.garage.car)
        starts = self.starter.draw(self.seeds, self.episode, self.garage.car, self.circuit)
        rows = races.repeat(self.cars)
        self.state = torch.where(rows, starts.state.reshape(STATE_ROWS, -1), self.state)
        self.group = torch.where(races, starts.group, self.group)
        self.scenario = torch.where(races, starts.scenario, self.scenario)
        kind = starts.compound.reshape(-1)
        one_hot = torch.nn.functional.one_hot(kind, len(self._compounds)).to(self.compound)
        compound = torch.cat([self._compounds[kind], one_hot], dim=1).T
        self.compound = torch.where(rows, compound, self.compound)
        run = self.referee.begin(
            self.state, starts.s.reshape(-1), starts.distance.reshape(-1), self.garage.car, self._groups
        )
        self.run = torch.where(rows, run, self.run)


_STATE = ("state", "run", "compound", "group", "scenario", "episode", "seeds")
