"""`HumanoidEnv`: N walking humanoids as one TorchRL environment."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded
from torchrl.envs import EnvBase

from coachable.envs.humanoid.features import (
    STYLE_FEATURES_SIZE,
    STYLED_SPEED_SIZE,
    WALK,
    WALK_SIZE,
    pack_style_features,
    pack_walk,
)
from coachable.envs.humanoid.gait import GaitTracker
from coachable.envs.humanoid.model import CONTROL_STEP, NUM_ACTIONS, NUM_POSITIONS
from coachable.envs.humanoid.observation import (
    OBSERVATION_SIZE,
    cosine_to_course,
    observe,
    rotate_to_course,
)
from coachable.envs.humanoid.rewards import COSTS, bearing_reward, move_reward, walk_costs
from coachable.envs.humanoid.simulation import HumanoidSimulation, Kinematics
from coachable.finite import require_action
from coachable.keys import STYLE_FEATURES, TASK_REWARD
from coachable.ranges import COUNT, NOT_NEGATIVE, POSITIVE, Range
from coachable.specs import set_specs

EPISODE_STEPS = 1000
FALL_HEIGHT = 1.1  # [m], an episode ends when the head is lower
HEADING_SPREAD = 0.3  # [rad], initial heading relative to the course
STEP_MAX = 1.0  # [s], a step that takes longer times out
PUSH_DURATION = 0.2  # [s]
_PUSH_STEPS = round(PUSH_DURATION / CONTROL_STEP)
_POSTURES = 512  # collision-free arm postures prepared at construction


class HumanoidEnv(EnvBase):
    """DeepMind Control humanoid on an infinite plane, observed for walking with a style.

    The env knows no style: it emits `task_reward` and the raw `style_features` from which `StyleReward` computes the
    style's part. Episodes start upright with random arms and end when the head falls below 1.1 m (terminated) or
    after `episode_steps` (truncated).

    Args:
        num_envs: N, stepped together.
        num_threads: physics threads; default: one per core that this process may use, at most `num_envs`.
        seed: seed of the initial states.
        episode_steps: control steps (25 ms) after which an episode is truncated.
        step_max: time without a foot strike after which a step times out [s].
        start_speed: largest speed along the course at the start of an episode [m/s]; it is drawn uniformly from 0.
        end_at_timeout: whether a step that times out ends the episode like a fall, so that standing still does not pay.
        costs: weights of `walk_costs`, which are taken off the task reward; none by default, as in the paper.
        push_force: largest force of random pushes of the torso [N], in any horizontal direction for 0.2 s; 0 for none.
        push_interval: mean time between pushes [s].
        push_share: share of the environments, the first ones, with random pushes; regular pushes are in all.
        regular_pushes: whether every push has the largest force and comes exactly `push_interval` after the last one.
        styled_speed: whether the style sets the speed. The task reward is then `bearing_reward`, and the style features
            have the forward speed and the bearing, too.

    Keys written: `observation` (N, 82) float32, `task_reward` (N, 1), `style_features` (N, 13 or 15), `walk` (N, 7),
    `done`, `terminated`, `truncated` (N, 1).

    Example:
        >>> env = HumanoidEnv(num_envs=2, seed=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 82])
    """

    runs_past_time_limit = True
    """An episode may be continued after it was truncated."""

    def __init__(
        self,
        num_envs: int = 32,
        *,
        num_threads: int | None = None,
        seed: int | None = None,
        episode_steps: int = EPISODE_STEPS,
        step_max: float = STEP_MAX,
        start_speed: float = 0.0,
        end_at_timeout: bool = False,
        costs: Mapping[str, float] | None = None,
        push_force: float = 0.0,
        push_interval: float = 2.0,
        push_share: float = 1.0,
        regular_pushes: bool = False,
        styled_speed: bool = False,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if step_max <= 0:
            raise ValueError(f"step_max must be positive seconds, got {step_max}")
        COUNT.check("episode_steps", episode_steps)
        NOT_NEGATIVE.check("start_speed", start_speed)
        NOT_NEGATIVE.check("push_force", push_force)
        POSITIVE.check("push_interval", push_interval)
        Range("[0, 1]").check("push_share", push_share)
        if unknown := set(costs or {}) - set(COSTS):
            raise ValueError(f"costs of {', '.join(sorted(unknown))}: expected some of {', '.join(COSTS)}")
        for name, weight in (costs or {}).items():
            NOT_NEGATIVE.check(f"costs.{name}", weight)
        super().__init__(device="cpu", batch_size=torch.Size((num_envs,)))
        if num_threads is None:
            affinity = getattr(os, "sched_getaffinity", None)  # missing on macOS and Windows
            num_threads = min(len(affinity(0)) if affinity else os.cpu_count() or 1, num_envs)
        self.num_envs = num_envs
        self.episode_steps = episode_steps
        self.start_speed, self.end_at_timeout = start_speed, end_at_timeout
        # One thread is the calling one: no pool to wake.
        self.simulation = HumanoidSimulation(num_envs, 0 if num_threads == 1 else num_threads)
        self.gait = GaitTracker.create(num_envs, step_max)
        self.course = np.zeros(num_envs)
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self.costs = {name: weight for name, weight in (costs or {}).items() if weight}
        self.push_force, self.push_interval, self.regular_pushes = push_force, push_interval, regular_pushes
        self._may_be_pushed = np.arange(num_envs) < round(push_share * num_envs)
        self.push = np.zeros((num_envs, 3))
        self._push_left = np.zeros(num_envs, dtype=np.int64)
        self.styled_speed = styled_speed
        self._features_size = STYLED_SPEED_SIZE if styled_speed else STYLE_FEATURES_SIZE
        self._observation = np.zeros((num_envs, OBSERVATION_SIZE), dtype=np.float32)
        self._postures = self._find_postures()
        self._random = np.random.default_rng(seed)
        set_specs(
            self,
            action=Bounded(-1.0, 1.0, torch.Size((num_envs, NUM_ACTIONS)), dtype=torch.float32),
            observation=OBSERVATION_SIZE,
            style_features=self._features_size,
            further={WALK: WALK_SIZE},
        )

    def steer(self, course: float | np.ndarray) -> None:
        """Set the direction that counts as forward, counter-clockwise from +x [rad], for all envs or each (N,)."""
        self.course[:] = course

    def push_torso(self, force: np.ndarray) -> None:
        """Push each torso with a force (N, 3) in the world frame [N] for the next 0.2 s; zeros leave a row alone."""
        rows = np.any(force != 0, axis=1)
        self.push[rows], self._push_left[rows] = force[rows], _PUSH_STEPS

    @property
    def pushing(self) -> np.ndarray:
        """Force (N, 3) with which each torso will be pushed in the next control step [N], as far as it is known."""
        return np.where(self._push_left[:, None] > 0, self.push, 0.0)

    # -- TorchRL ---------------------------------------------------------------------------------------------------

    def _set_seed(self, seed: int | None) -> None:
        self._random = np.random.default_rng(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        partial = None if tensordict is None else tensordict.get("_reset", None)
        mask = np.ones(self.num_envs, dtype=bool) if partial is None else partial.reshape(self.num_envs).numpy()
        rows = np.flatnonzero(mask)
        if len(rows):
            self._start_episodes(rows)
        zero = torch.zeros(self.num_envs, 1)
        done = torch.zeros(self.num_envs, 1, dtype=torch.bool)
        return TensorDict(
            {
                "observation": torch.from_numpy(self._observation.copy()),
                TASK_REWARD: zero,
                STYLE_FEATURES: torch.zeros(self.num_envs, self._features_size),
                WALK: torch.zeros(self.num_envs, WALK_SIZE),
                "done": done,
                "terminated": done.clone(),
                "truncated": done.clone(),
            },
            batch_size=self.batch_size,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action").detach()
        require_action(action, self.num_envs, NUM_ACTIONS)
        controls = np.clip(action.numpy().astype(np.float64), -1.0, 1.0)
        diverged = self.simulation.step(controls, self._pushes())
        self.steps += 1
        kinematics = self.simulation.kinematics()
        forces, power = self.simulation.forces(), self.simulation.power()
        report = self.gait.update(kinematics, self._knees(), forces, self.course)
        forward_speed = rotate_to_course(kinematics.com_velocity, self.course)[:, 0]
        upright = kinematics.torso_axes[:, 2, 2]
        facing = cosine_to_course(kinematics.pelvis_quaternion, self.course)
        further: tuple[np.ndarray, ...] = ()
        if self.styled_speed:
            task_reward = bearing_reward(kinematics.head_height, upright, facing, controls)
            further = (forward_speed, task_reward)
        else:
            task_reward = move_reward(forward_speed, kinematics.head_height, upright, facing, controls)
        if self.costs:
            costs = walk_costs(power, forces, kinematics.foot_clearance, report)
            task_reward = task_reward - sum(weight * costs[name] for name, weight in self.costs.items())
        arms = self.simulation.positions[:, self.simulation.model.arm_positions]
        ended = (kinematics.head_height < FALL_HEIGHT) | diverged
        if self.end_at_timeout:
            ended |= report.timed_out
        terminated = torch.from_numpy(ended)[:, None]
        truncated = torch.from_numpy(self.steps >= self.episode_steps)[:, None] & ~terminated
        reward = torch.from_numpy(task_reward.astype(np.float32))[:, None]
        self._observation = self._observe(kinematics, np.arange(self.num_envs))
        return TensorDict(
            {
                "observation": torch.from_numpy(self._observation.copy()),
                TASK_REWARD: reward,
                "reward": reward.clone(),
                STYLE_FEATURES: torch.from_numpy(pack_style_features(arms, report, *further)),
                WALK: torch.from_numpy(pack_walk(power, report)),
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            batch_size=self.batch_size,
        )

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Stop the physics threads."""
        if not self.is_closed:
            self.simulation.close()
        super().close(raise_if_closed=raise_if_closed)

    # -- state -----------------------------------------------------------------------------------------------------

    def simulator_state(self) -> dict[str, Any]:
        """Return everything that the next step depends on, as tensors and plain values, for exact resumption."""
        arrays = {
            "state": self.simulation.state,
            "course": self.course,
            "steps": self.steps,
            "push": self.push,
            "push_left": self._push_left,
            "observation": self._observation,
        }
        arrays |= {f"gait.{name}": value for name, value in self.gait.arrays().items()}
        tensors: dict[str, Any] = {name: torch.from_numpy(value.copy()) for name, value in arrays.items()}
        return tensors | {"random": self._random.bit_generator.state}

    def load_simulator_state(self, state: dict[str, Any]) -> None:
        """Restore what `simulator_state` returned.

        Raises:
            ValueError: if it comes from another number of envs.
        """
        arrays = {name: value.numpy() for name, value in state.items() if isinstance(value, torch.Tensor)}
        if len(arrays["state"]) != self.num_envs:
            raise ValueError(f"state of {len(arrays['state'])} envs given, this env has {self.num_envs}")
        self.simulation.state[:] = arrays["state"]
        self.course[:] = arrays["course"]
        self.steps[:] = arrays["steps"]
        self.push[:] = arrays["push"]
        self._push_left[:] = arrays["push_left"]
        self._observation[:] = arrays["observation"]
        for name in self.gait.arrays():
            setattr(self.gait, name, arrays[f"gait.{name}"].copy())
        self._random.bit_generator.state = state["random"]

    def _start_episodes(self, rows: np.ndarray) -> None:
        """Place walkers upright, with feet on the ground, random arms and a heading near the course."""
        positions = np.tile(self.simulation.model.dynamics.qpos0, (len(rows), 1))  # all joints at 0
        postures = self._random.integers(0, len(self._postures), len(rows))
        positions[:, self.simulation.model.arm_positions] = self._postures[postures]
        positions[:, 2] = self._standing_height
        heading = self.course[rows] + self._random.uniform(-HEADING_SPREAD, HEADING_SPREAD, len(rows))
        positions[:, 3], positions[:, 6] = np.cos(heading / 2), np.sin(heading / 2)
        self.simulation.state[rows, 0] = 0.0
        self.simulation.state[rows, 1 : 1 + NUM_POSITIONS] = positions
        self.simulation.state[rows, 1 + NUM_POSITIONS :] = 0.0
        if self.start_speed:
            speed = self._random.uniform(0.0, self.start_speed, len(rows))
            forward = np.stack([np.cos(self.course[rows]), np.sin(self.course[rows])], axis=1)
            self.simulation.state[rows, 1 + NUM_POSITIONS : 3 + NUM_POSITIONS] = speed[:, None] * forward
        self.steps[rows] = 0
        self._push_left[rows] = 0
        kinematics = self.simulation.kinematics(rows)
        feet = kinematics.feet[..., :2]
        self.gait.reset(rows, self._random.integers(0, 2, len(rows)), feet, self._knees()[rows], kinematics.soles)
        self._observation[rows] = self._observe(kinematics, rows)

    def _pushes(self) -> np.ndarray:
        """Return the force on each torso in this control step (N, 3) [N], and begin the pushes that are due."""
        if self.push_force:
            begins = (self._random.random(self.num_envs) < CONTROL_STEP / self.push_interval) & (self._push_left == 0)
            begins &= self._may_be_pushed
            size = self._random.uniform(0.0, self.push_force, self.num_envs)
            if self.regular_pushes:
                begins = (self.steps > 0) & (self.steps % max(1, round(self.push_interval / CONTROL_STEP)) == 0)
                size = np.full(self.num_envs, self.push_force)
            angle = self._random.uniform(-np.pi, np.pi, self.num_envs)
            force = np.stack([size * np.cos(angle), size * np.sin(angle), np.zeros(self.num_envs)], axis=1)
            self.push_torso(np.where(begins[:, None], force, 0.0))
        pushed = np.where(self._push_left[:, None] > 0, self.push, 0.0)
        self._push_left = np.maximum(self._push_left - 1, 0)
        return pushed

    def _find_postures(self) -> np.ndarray:
        """Draw arm postures (M, 6) without self-collision, uniformly within the joint limits."""
        # Always the same set, so that an env's seed decides only which of them an episode starts with.
        random = np.random.default_rng(0)
        model = self.simulation.model
        state = self.simulation.state[:1].copy()
        self._standing_height = float(state[0, 3] - self.simulation.kinematics_of(state).foot_clearance.min())
        lower, upper = model.arm_ranges.T
        found = []
        while len(found) < _POSTURES:
            posture = random.uniform(lower, upper)
            # Contacts with the floor do not count: the search happens above it.
            state[0, 3] = self._standing_height + 1.0
            state[0, 1 + model.arm_positions] = posture
            if self.simulation.count_contacts(state[0]) == 0:
                found.append(posture)
        return np.array(found)

    def _knees(self) -> np.ndarray:
        return self.simulation.positions[:, self.simulation.model.knee_positions]

    def _observe(self, kinematics: Kinematics, rows: np.ndarray) -> np.ndarray:
        """Return the scaled observation (len(rows), 82) float32 of the states that `kinematics` belongs to."""
        positions, velocities = self.simulation.positions[rows], self.simulation.velocities[rows]
        return observe(positions, velocities, kinematics, self.course[rows], self.gait.observe(self.course)[rows])
