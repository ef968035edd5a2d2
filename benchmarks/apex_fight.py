"""A fight against the Apex Thunderjaw under four requests in turn, and how a request for frost is answered (paper)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from fight_queue import damage_by_source_and_state, source_damage

from coachable.domains.combat.coached_fight import SOURCES
from coachable.envs.combat.constants import PLAYER_HP
from coachable.envs.combat.env import COMPONENTS_KEY
from coachable.envs.combat.rewards import COMPONENT_SLICES
from coachable.envs.combat.tables import ELEMENTS
from coachable.evaluation.video import asked_line, caption
from coachable.training.rollout import Rollout

if TYPE_CHECKING:
    from coachable.domain import Domain
    from coachable.training.weights import LoadedPolicy

__all__ = ["APEX", "FightLog", "brittle_rows", "log_fights", "requests_in_turn"]

APEX = "Apex Thunderjaw"
_WISHED = (
    "ancestors_return",
    "traps",
    "fire",
    "frost",
    "skykiller",
    "melee",
)  # those that the agent has, in this order
_REQUESTS = 4
_FROST = ELEMENTS.index("frost")


class FightLog:
    """Step by step record of N fights against the Apex Thunderjaw, whose request changes with the machine's health.

    Attributes:
        names: Requested styles, in their order.
        request: Number of the requested style (T, N).
        damage: Damage by source (T, N, 8) [HP].
        in_frost: Damage by source while frost makes the machine brittle (T, N, 8) [HP].
        brittle: Whether the machine is brittle after each step (T, N) bool.
        chilled: Whether a hit builds frost up in each step (T, N) bool.
        counted: Damage that counts for the request (T, N) [HP].
        player: Health of the player, as a share (T, N).
        machine: Health of the machine, as a share (T, N).
        alive: Steps up to the end of each fight (T, N) bool.
        won: Whether the player won (N,) bool.
        control_step: Duration of a step [s].
    """

    def __init__(self, names: Sequence[str], control_step: float, rows: list[dict[str, torch.Tensor]]) -> None:
        self.names, self.control_step = tuple(names), control_step
        record = {name: torch.stack([row[name] for row in rows]).numpy() for name in rows[0]}
        self.request, self.damage, self.in_frost = record["request"], record["damage"], record["in_frost"]
        self.brittle, self.chilled, self.counted = record["brittle"], record["chilled"], record["counted"]
        self.player, self.machine, self.alive = record["player"], record["machine"], record["alive"]
        self.won = np.asarray((record["won"] & record["alive"]).any(0))

    def best(self) -> int:
        """Return the number of a fight that was won, or else of the one that left the machine with the least health."""
        return int(np.where(self.alive, self.machine, 1.0).min(0).argmin())

    def timeline(self, fight: int) -> list[dict[str, Any]]:
        """Return one fight with a row per step, for `draw_timeline`."""
        rows = []
        length = int(self.alive[:, fight].sum())
        for step in range(length):
            row: dict[str, Any] = {"seconds": (step + 1) * self.control_step, "fight": 0, "machine": APEX}
            row["requested"] = self.names[self.request[step, fight]]
            row |= {
                "player_health": float(self.player[step, fight]),
                "machine_health": float(self.machine[step, fight]),
            }
            row |= dict(zip(SOURCES, self.damage[step, fight].tolist(), strict=True))
            row |= {"counted": float(self.counted[step, fight]), "brittle": bool(self.brittle[step, fight])}
            row["ended"] = ("won" if self.won[fight] else "not won") if step == length - 1 else ""
            rows.append(row)
        return rows


def requests_in_turn(names: Sequence[str]) -> tuple[str, ...]:
    """Return the four requests, or as many as an agent with these styles has, with frost last (paper).

    Raises:
        ValueError: If the agent has none of the styles.
    """
    chosen = [name for name in _WISHED if name in names][:_REQUESTS]
    if not chosen:
        raise ValueError(f"the agent has the styles {list(names)}: expected at least one of {list(_WISHED)}")
    return tuple(sorted(chosen, key=lambda name: name == "frost"))


def log_fights(
    domain: Domain, agent: LoadedPolicy, names: Sequence[str], *, fights: int, seed: int, draw: tuple[Any, int] | None
) -> tuple[FightLog, list[np.ndarray]]:
    """Fight the Apex Thunderjaw while the request changes each time it has lost another equal share of its health.

    Args:
        domain: Domain combat, as the agent was trained in.
        agent: Policy.
        names: Styles to request, each alone and at its maximum.
        fights: Number of fights.
        seed: Seed of fights and actions.
        draw: Renderer and number of the fight to film, or None.

    Returns:
        The record, and the film's frames.
    """
    high = dict(zip(agent.space.names, agent.space.high.tolist(), strict=True))
    theta = agent.space.make_all({name: high[name]} for name in names)
    env = domain.styled_env(agent.space, fights, seed=seed)
    simulation: Any = env.base_env
    simulation.assign([APEX] * fights, ["Arena"] * fights)
    rollout = Rollout(env, seed)
    request = torch.zeros(fights, dtype=torch.long)
    rollout.begin(theta[request])
    alive = torch.ones(fights, dtype=torch.bool)
    rows: list[dict[str, torch.Tensor]] = []
    frames: list[np.ndarray] = []
    while alive.any():
        transition = rollout.step(agent.actor, theta[request])
        components, measured = transition.get(("next", COMPONENTS_KEY)), domain.measures.step(transition)
        state = simulation.state
        health = (state.enemy_hp[0] / simulation.traits.hp[0]).clamp(0.0, 1.0)
        damage, by_state = source_damage(components), damage_by_source_and_state(components)
        row = {"request": request, "damage": damage, "in_frost": by_state[..., _FROST], "alive": alive}
        row["brittle"] = state.state_timer[_FROST, 0] > 0
        row["chilled"] = components[:, COMPONENT_SLICES["buildup"]][:, _FROST] > 0
        row |= {"counted": measured["requested"].nan_to_num(), "won": measured["won"] > 0}
        row |= {"player": (state.hp / PLAYER_HP).clamp(0.0, 1.0), "machine": health}
        rows.append({name: value.clone() for name, value in row.items()})
        if draw is not None and alive[draw[1]]:
            frames.append(_frame(draw[0], env, draw[1], agent, names, request, damage))
        alive = alive & ~transition.get(("next", "done"))[:, 0]
        request = torch.maximum(request, ((1.0 - health) * len(names)).long().clamp(max=len(names) - 1))
    env.close()
    return FightLog(names, domain.control_step, rows), frames


def _frame(
    renderer: Any,
    env: Any,
    fight: int,
    agent: LoadedPolicy,
    names: Sequence[str],
    request: torch.Tensor,
    damage: torch.Tensor,
) -> np.ndarray:
    name = names[int(request[fight])]
    wish = {name: float(agent.space[name].high)}
    hits = [f"{source} {hp:.0f} HP" for source, hp in zip(SOURCES, damage[fight].tolist(), strict=True) if hp > 0]
    asked = asked_line(agent.space, wish, agent.space.describe(agent.space.make(strict=True, **wish)))
    return caption(renderer.draw(env, fight), (asked, f"hits: {', '.join(hits) or 'none'}".replace("_", " ")))


def brittle_rows(log: FightLog) -> list[dict[str, Any]]:
    """Count how the phases in which the machine is brittle begin and are used, by the weapon that began them.

    Returns:
        Rows with `begun_by`, the source of most damage in the steps that built the frost up, or "all"; `phases`, their
        number; `switched`, the share in which another source does most of the damage while the machine is brittle; and
        each source's share of the damage in these phases.
    """
    phases = [phase for fight in range(log.alive.shape[1]) for phase in _phases(log, fight)]
    rows = []
    for begun in [*SOURCES, "all"]:
        mine = [(first, used) for first, used in phases if begun in (SOURCES[first], "all")]
        if not mine:
            continue
        used = np.sum([used for _, used in mine], 0)
        switched = float(np.mean([int(used.argmax()) != first for first, used in mine]))
        row: dict[str, Any] = {"begun_by": begun, "phases": len(mine), "switched": switched}
        rows.append(row | dict(zip(SOURCES, (used / max(used.sum(), 1e-9)).tolist(), strict=True)))
    return rows


def _phases(log: FightLog, fight: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the source that began each brittle phase of a fight, and the damage by source in it, if there is any."""
    built, used = np.zeros(len(SOURCES)), np.zeros(len(SOURCES))
    first = None
    for step in range(int(log.alive[:, fight].sum())):
        brittle = log.brittle[step, fight]
        if first is None and log.chilled[step, fight]:
            built = built + log.damage[step, fight]
        if first is None and brittle and built.any():
            first, used = int(built.argmax()), np.zeros(len(SOURCES))
        if first is not None:
            used = used + log.in_frost[step, fight]
            if not brittle:
                if used.any():
                    yield first, used
                built, first = np.zeros(len(SOURCES)), None
    if first is not None and used.any():
        yield first, used
