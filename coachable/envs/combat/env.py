"""`CombatEnv`, a TorchRL environment of N fights against machines."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from coachable.envs.combat import constants as c
from coachable.envs.combat.damage import ElementNumbers
from coachable.envs.combat.features import observation_size, observe
from coachable.envs.combat.fight import run_step
from coachable.envs.combat.gamepad import GAMEPAD, canonical_rows
from coachable.envs.combat.rewards import (
    COMPONENT_SLICES,
    NUM_COMPONENTS,
    event_components,
    style_weights,
    task_weights,
)
from coachable.envs.combat.state import State, start_fights
from coachable.envs.combat.step_frames import Noise, Rules
from coachable.envs.combat.tables import MACHINES, SITES, STYLES, check_styles
from coachable.envs.combat.traits import (
    AMMO_SLOTS,
    MACHINE_NAMES,
    MAGAZINE,
    Traits,
    ammo_sections,
    ammo_table,
    look_up_traits,
    machine_table,
    site_table,
)
from coachable.envs.combat.traps import TrapNumbers
from coachable.finite import require_action
from coachable.keys import EVENTS, SCENARIO, STYLE_FEATURES, TASK_REWARD
from coachable.ranges import AMOUNT, COUNT, Range
from coachable.specs import set_specs

COMPONENTS_KEY = "components"
"""Key of the raw components of a step, `(N, 44)`, for evaluation; see `rewards.COMPONENTS`."""


class CombatEnv(EnvBase):
    """Environment of fights of one player with a gamepad against machines, in steps of 0.2 s (paper: 5 Hz).

    The environment is independent of the style. It emits `task_reward` and the `style_features` g_i, from which
    `StyleReward` computes sum_i w_i g_i. A fight terminates when all machines or the player are dead, or when the
    player leaves the Dynamic Anchor Bound. It is truncated after `episode_steps`.

    Args:
        num_envs: Number N of fights.
        seed: Seed of machines, sites and fights.
        machines: Machine types from which each fight draws uniformly; the paper's 19 by default.
        sites: Sites from which each fight draws uniformly; all three by default.
        num_enemies: Number of machines per fight, 1 or 2, of independently drawn types.
        styles: Names of the styles whose features and events are emitted, in this order; all 18 by default.
        observation: "full" (629 numbers) or "small" (190).
        reward_scale: "sim" or "paper", for a reward of 60 or 1000 for a removed part. Use the style space of the same
            scale.
        episode_steps: Number of steps after which a fight is truncated.
        traps: Number of traps of each type in the inventory.
        assist: Aim assist: "full", "small" or "off".
        kill_event: Whether `events` has one more column, for the death of all machines.
        components: Whether to emit `components` (N, 44), too.
        device: Device of all tensors.

    Keys written: `observation` (N, 629), `task_reward` (N, 1), `style_features` (N, 18), `events` (N, 18) bool,
    `scenario` (N, 1) int64, `done`, `terminated`, `truncated` (N, 1). The scenario of a fight is its machine, the first
    one of two: an index into `scenario_names`, or -1 for an assigned machine that is not among `machines`.

    Raises:
        ValueError: If an option or a name is unknown, or a number is out of range.

    Example:
        >>> env = CombatEnv(num_envs=2, seed=0, machines=["Scrounger"], observation="small")
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 190])
    """

    runs_past_time_limit = True
    """An episode may be continued after it was truncated."""

    def __init__(
        self,
        num_envs: int = 128,
        *,
        seed: int | None = None,
        machines: Sequence[str] | None = None,
        sites: Sequence[str] | None = None,
        num_enemies: int = 1,
        styles: Sequence[str] | None = None,
        observation: str = "full",
        reward_scale: str = "sim",
        episode_steps: int = c.EPISODE_STEPS,
        traps: int = 10,
        assist: str = "full",
        kill_event: bool = False,
        components: bool = False,
        device: torch.device | str = "cpu",
    ) -> None:
        COUNT.check("num_envs", num_envs)
        Range("[1, 2]", whole=True).check("num_enemies", num_enemies)
        COUNT.check("episode_steps", episode_steps)
        AMOUNT.check("traps", traps)
        if assist not in c.ASSIST:
            raise ValueError(f"assist is {assist!r}: expected one of {list(c.ASSIST)}")
        super().__init__(device=device, batch_size=torch.Size((num_envs,)))
        self.num_envs, self.num_enemies = num_envs, num_enemies
        self.observation, self.episode_steps, self.traps, self.assist = observation, episode_steps, traps, assist
        self.styles = check_styles(styles)
        self.kill_event, self.emit_components = kill_event, components
        machines = tuple(MACHINES) if machines is None else machines
        self._machine_pool = _numbers("machines", machines, MACHINE_NAMES)
        self.scenario_names = tuple(dict.fromkeys(machines))
        self._site_pool = _numbers("sites", SITES if sites is None else sites, SITES)
        self._assigned: tuple[Tensor, Tensor] | None = None
        self._load_tables(reward_scale)
        self._random = torch.Generator(self._on)
        self._make_specs()
        self.state = self._fresh()
        self._look_up()
        self._set_seed(seed)  # after the draws of the state that `reset` replaces

    def assign(self, machines: Sequence[str | Sequence[str]], sites: Sequence[str]) -> None:
        """Assign machines and sites to the fights from their next reset on, instead of drawing them.

        Args:
            machines: Machine type, or one type per enemy, of each of the N fights.
            sites: Site of each of the N fights.

        Raises:
            ValueError: If a name is unknown or there are not N of them.
        """
        rows = [[names] * self.num_enemies if isinstance(names, str) else list(names) for names in machines]
        if len(rows) != self.num_envs or len(sites) != self.num_envs or {len(r) for r in rows} != {self.num_enemies}:
            raise ValueError(
                f"assign got {len(rows)} machines and {len(sites)} sites: expected {self.num_envs} of each, and "
                f"{self.num_enemies} machines per fight"
            )
        site = _numbers("sites", sites, SITES).to(self._on)
        columns = [_numbers("machines", [row[i] for row in rows], MACHINE_NAMES) for i in range(self.num_enemies)]
        self._assigned = torch.stack(columns).to(self._on), site
        self._place_pillars(torch.cat([site, self.state.site]))

    # -- TorchRL ---------------------------------------------------------------------------------------------------

    def _load_tables(self, reward_scale: str) -> None:
        on = self._on
        self._machines, self._ammo, self._sites = machine_table(on), ammo_table(on), site_table(on)
        self._sections, self._elements = ammo_sections(on), ElementNumbers.load(on)
        self._magazines = self._ammo[:, MAGAZINE : MAGAZINE + 1]
        chosen = [STYLES.index(name) for name in self.styles]
        weights = torch.cat([task_weights().unsqueeze(0), style_weights(reward_scale)[chosen]])
        self._weights, self._fires = weights.to(on), event_components()[chosen].to(on)
        self._machine_pool, self._site_pool = self._machine_pool.to(on), self._site_pool.to(on)
        position = {name: index for index, name in enumerate(self.scenario_names)}
        self._scenarios = torch.tensor([position.get(name, -1) for name in MACHINE_NAMES], device=on)
        self._place_pillars(self._site_pool)

    def _place_pillars(self, sites: Tensor) -> None:
        """Load the pillars only if a fight may have them, because they cost time."""
        needed = bool((self._sites[sites, 2] > 0).any())
        self._pillars = torch.tensor(c.PILLARS, device=self._on).T.contiguous() if needed else None

    @property
    def _on(self) -> torch.device:
        return torch.device("cpu") if self.device is None else self.device

    def _make_specs(self) -> None:
        column, events = torch.Size((self.num_envs, 1)), len(self.styles) + self.kill_event
        further: dict[str, int | TensorSpec] = {
            EVENTS: Binary(events, torch.Size((self.num_envs, events)), dtype=torch.bool, device=self._on),
            SCENARIO: Unbounded(column, dtype=torch.int64, device=self._on),
        }
        set_specs(
            self,
            action=GAMEPAD.spec(self.batch_size, device=self._on),
            observation=observation_size(self.observation),
            style_features=len(self.styles),
            further=further | ({COMPONENTS_KEY: NUM_COMPONENTS} if self.emit_components else {}),
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            self._random.seed()
        else:
            self._random.manual_seed(seed)

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        partial = None if tensordict is None else tensordict.get("_reset", None)
        fresh = self._fresh()
        self.state = fresh if partial is None else self.state.replaced_where(partial.view(-1), fresh)
        self._look_up()
        return self._emit(torch.zeros((NUM_COMPONENTS, self.num_envs), device=self._on), reset=True)

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action").detach()
        require_action(action, self.num_envs, GAMEPAD.action_dim)
        pad = canonical_rows(action.to(torch.float32).T.contiguous())
        noise = Noise.draw(self.num_enemies, self.num_envs, self._random)
        components = run_step(self.state, pad, self.rules, noise, self._ammo, self._sections)
        return self._emit(components, reset=False)

    def _emit(self, components: Tensor, reset: bool) -> TensorDictBase:
        won = (self.state.enemy_hp <= 0).all(0)
        lost = components[COMPONENT_SLICES["death"]] + components[COMPONENT_SLICES["out_of_bounds"]] > 0
        ended = (won | lost[0]).unsqueeze(-1) & (not reset)
        late = (self.state.steps >= self.episode_steps).unsqueeze(-1) & ~ended & (not reset)
        values = (self._weights @ components).T
        events = (self._fires @ components.clamp(min=0.0) > 0).T  # build-up also decays
        if self.kill_event:
            events = torch.cat([events, won.unsqueeze(-1)], -1)
        ammo = self._ammo.index_select(0, self.state.weapon * AMMO_SLOTS + self.state.section).T
        found = {
            "observation": observe(self.state, self.traits, ammo, self.observation, self.episode_steps),
            TASK_REWARD: values[:, :1].contiguous(),
            STYLE_FEATURES: values[:, 1:].contiguous(),
            EVENTS: events.contiguous(),
            SCENARIO: self._scenarios[self.state.machine[0]].unsqueeze(-1),
            "done": ended | late,
            "terminated": ended,
            "truncated": late,
        }
        if self.emit_components:
            found[COMPONENTS_KEY] = components.T.contiguous()
        if not reset:
            found["reward"] = found[TASK_REWARD].clone()
        return TensorDict(found, batch_size=self.batch_size, device=self._on)

    # -- state -----------------------------------------------------------------------------------------------------

    def _fresh(self) -> State:
        """Return new fights for all rows, so that the count of random numbers does not depend on which rows reset."""
        n, on = self.num_envs, self._on
        drawn = torch.randint(len(self._machine_pool), (self.num_enemies, n), generator=self._random, device=on)
        machine = self._machine_pool[drawn]
        site = self._site_pool[torch.randint(len(self._site_pool), (n,), generator=self._random, device=on)]
        if self._assigned is not None:
            machine, site = (tensor.clone() for tensor in self._assigned)
        traits = look_up_traits(self._machines, machine)
        return start_fights(machine, site, traits, self._magazines, float(self.traps), self._random)

    def _look_up(self) -> None:
        """Load the tables of the machines and sites of the present fights."""
        self.traits: Traits = look_up_traits(self._machines, self.state.machine)
        traps = TrapNumbers.of(self.traits) if self.traps else None
        site = self._sites.index_select(0, self.state.site).T.contiguous()
        self.rules = Rules(self.traits, site, self._elements, traps, self._pillars, c.ASSIST[self.assist])

    def simulator_state(self) -> dict[str, Any]:
        """Return all tensors that the next step depends on, with the fights first, for exact resumption."""
        tensors: dict[str, Any] = {
            name: value.movedim(-1, 0).clone().cpu() for name, value in self.state.tensors().items()
        }
        return tensors | {"random": {"generator": self._random.get_state().clone()}}

    def load_simulator_state(self, state: dict[str, Any]) -> None:
        """Restore what `simulator_state` returned.

        Args:
            state: Result of `simulator_state` of an environment with as many fights and enemies.

        Raises:
            ValueError: If it comes from another number of fights or enemies.
        """
        shape, expected = tuple(state["machine"].shape), (self.num_envs, self.num_enemies)
        if shape != expected:
            raise ValueError(
                f"state of {shape[0]} envs with {shape[1]} enemies given, this env has {expected[0]} with {expected[1]}"
            )
        names = self.state.tensors()
        self.state = State(**{name: state[name].movedim(0, -1).contiguous().to(self._on) for name in names})
        self._random.set_state(state["random"]["generator"])
        self._place_pillars(torch.cat([self._site_pool, self.state.site]))
        self._look_up()


def _numbers(what: str, names: Sequence[str], known: Sequence[str]) -> Tensor:
    """Return the indices of names, (len(names),) int64."""
    unknown = sorted({name for name in names if name not in known})
    if unknown or isinstance(names, str) or not names:
        raise ValueError(f"{what} are {names!r}: expected a list of at least one of {list(known)}")
    return torch.tensor([known.index(name) for name in names])
