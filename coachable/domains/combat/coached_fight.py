"""Evaluation of style switches during sequences of fights: the effect of each switch and its delay."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from coachable.domain import Domain
from coachable.envs.combat.constants import PLAYER_HP
from coachable.envs.combat.tables import ELEMENTS, STYLES
from coachable.envs.combat.traits import MACHINE_NAMES
from coachable.evaluation.figures import drawing
from coachable.evaluation.switching import SWITCH_PERIOD
from coachable.evaluation.wording import readable
from coachable.styles import StyleSpace
from coachable.training.rollout import Rollout
from coachable.training.weights import LoadedPolicy

SOURCES = STYLES[:8]
STATES = tuple(style for style in STYLES if style in ELEMENTS)
_OUTCOMES = ("won", "died", "out_of_bounds")
_BAR = 1.0  # [s], width of the bars of a timeline


@dataclass(frozen=True)
class CoachedFights:
    """N sequences of fights of T steps. When a fight ends, the next one starts with the same request.

    Attributes:
        names: Styles that are requested, each alone and at its maximum.
        requests: Number of the requested style (T, N), which changes every `period` steps. Sequence 0 has the styles in
            their order, the others have them in random order.
        period: Number of steps between switches.
        control_step: Duration of a step [s].
        measures: Measures of `CombatMeasures` in each step by name, (T, N) each.
        player: Health of the player after each step (T, N), as a share of full health.
        machine: Health of the machine after each step (T, N), as a share of full health.
        opponent: Number of the machine in `MACHINE_NAMES` (T, N).
        done: Whether each step is the last one of a fight (T, N) bool.
    """

    names: tuple[str, ...]
    requests: np.ndarray
    period: int
    control_step: float
    measures: Mapping[str, np.ndarray]
    player: np.ndarray
    machine: np.ndarray
    opponent: np.ndarray
    done: np.ndarray

    def switches(self) -> list[dict[str, Any]]:
        """Summarise the time from the switches to each style, and to all of them, until the next switch.

        Returns:
            Rows with `style`, or "all styles"; `switches`, their number; `complied`, the share of switches after which
            damage counts for the style; `median_seconds`, the median time from a switch to the first such damage, which
            is infinite if there is none; and `share`, the share of the damage that counts for the style.
        """
        starts = range(self.period, len(self.requests) - self.period + 1, self.period)
        if not starts:
            return []

        def windows(values: np.ndarray) -> np.ndarray:  # (T, N) -> (switches, period, N)
            return np.stack([values[start : start + self.period] for start in starts])

        asked, damage = windows(np.nan_to_num(self.measures["requested"])), windows(self.measures["damage"])
        wanted = windows(self.requests)[:, 0]
        seconds = ((asked > 0).argmax(1) + 1) * self.control_step
        first = np.where((asked > 0).any(1), seconds.round(6), np.inf)
        rows = []
        for number, name in enumerate([*self.names, "all styles"]):
            mine = wanted == number if number < len(self.names) else np.ones_like(wanted, dtype=bool)
            if not mine.any():
                continue
            counted, total = asked.sum(1)[mine].sum(), damage.sum(1)[mine].sum()
            rows.append(
                {
                    "style": name,
                    "switches": int(mine.sum()),
                    "complied": float(np.isfinite(first[mine]).mean()),
                    "median_seconds": float(np.median(first[mine])),
                    "share": float(counted / total) if total > 0 else float("nan"),
                }
            )
        return rows

    def outcomes(self) -> dict[str, int]:
        """Count the fights that ended, and their outcomes, without those that the end of a sequence interrupted."""
        ended = {name: int((self.measures[name] * self.done).sum()) for name in _OUTCOMES}
        return {"fights": int(self.done.sum()), **ended}

    def timeline(self) -> list[dict[str, Any]]:
        """Return sequence 0 with a row per step, until every style was requested once.

        `machine` is the machine's type, `player_health` and `machine_health` are shares, and the sources are damage
        [HP]. `ended` is the outcome of the fight in its last step, and empty before.
        """
        rows, fight = [], 0
        for step in range(min(len(self.names) * self.period, len(self.requests))):
            ended = next((name for name in _OUTCOMES if self.measures[name][step, 0]), "timeout")
            row: dict[str, Any] = {"seconds": (step + 1) * self.control_step, "fight": fight}
            row["machine"] = MACHINE_NAMES[self.opponent[step, 0]]
            row["requested"] = self.names[self.requests[step, 0]]
            row |= {"player_health": float(self.player[step, 0]), "machine_health": float(self.machine[step, 0])}
            row |= {name: float(self.measures[name][step, 0]) for name in SOURCES}
            row["counted"] = float(np.nan_to_num(self.measures["requested"][step, 0]))
            row["ended"] = ended if self.done[step, 0] else ""
            fight += bool(self.done[step, 0])
            rows.append(row)
        return rows


def requests_of(space: StyleSpace) -> tuple[str, ...]:
    """Return the styles for which every hit either counts or does not: those of damage sources and of states.

    Styles of parts are left out.
    """
    return tuple(name for name in space.names if name in (*SOURCES, *STATES))


def fight_coached(
    domain: Domain, agent: LoadedPolicy, *, sequences: int, steps: int, seed: int, progress: bool
) -> CoachedFights:
    """Run sequences of fights with an agent whose style is switched.

    Args:
        domain: Domain combat, as the agent was trained in; machines and sites are drawn at random.
        agent: Policy with at least two styles of `requests_of`.
        sequences: Number N of sequences.
        steps: Number T of steps of each sequence.
        seed: Seed of scenarios, fights, actions and requests.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: If there are fewer than two such styles, or no sequences.
    """
    names = requests_of(agent.space)
    if len(names) < 2 or sequences < 1:
        raise ValueError(f"{sequences} sequences with the styles {list(names)}: expected at least 1 and 2 styles")
    high = dict(zip(agent.space.names, agent.space.high.tolist(), strict=True))
    theta = agent.space.make_all({name: high[name]} for name in names)
    period = max(1, min(SWITCH_PERIOD, steps // len(names)))
    requests = _draw_requests(len(names), -(-steps // period), sequences, seed).repeat_interleave(period, 0)[:steps]

    env = domain.styled_env(agent.space, sequences, seed=seed)
    simulation: Any = env.base_env
    rollout = Rollout(env, seed)
    rollout.begin(theta[requests[0]])
    rows: list[dict[str, torch.Tensor]] = []
    label = f"{sequences} sequences of fights, style switched every {period} steps" if progress else None
    for request in tqdm(requests, desc=label, disable=True if label is None else None, leave=False):
        transition = rollout.step(agent.actor, theta[request])
        row = domain.measures.step(transition)
        state = simulation.state
        row |= {"player health": state.hp / PLAYER_HP, "opponent": state.machine[0].clone()}
        row |= {"machine health": state.enemy_hp.sum(0) / simulation.traits.hp.sum(0)}
        row["done"] = transition.get(("next", "done"))[:, 0]
        rows.append(row)
        rollout.begin_ended()
    env.close()
    record = {name: torch.stack([row[name] for row in rows]).numpy() for name in rows[0]}
    player, machine = (record.pop(f"{who} health").clip(0.0, 1.0) for who in ("player", "machine"))
    opponent, done = record.pop("opponent"), record.pop("done")
    return CoachedFights(names, requests.numpy(), period, domain.control_step, record, player, machine, opponent, done)


def _draw_requests(styles: int, windows: int, sequences: int, seed: int) -> torch.Tensor:
    """Draw the numbers of styles (windows, sequences), never the same twice in a row."""
    generator = torch.Generator().manual_seed(seed)
    further = torch.randint(1, styles, (windows, sequences), generator=generator)
    further[0] = torch.randint(styles, (sequences,), generator=generator)
    further[:, 0] = 1
    further[0, 0] = 0
    return further.cumsum(0) % styles


def draw_timeline(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw damage by source and health over time, under bands of the requested style (paper, timeline of a fight).

    Args:
        rows: Result of `CoachedFights.timeline`; steps in which a row says `brittle` are hatched.
        path: PNG file to write.
    """
    times = np.array([row["seconds"] for row in rows])
    step = float(times[0])
    colours = {source: f"C{number}" for number, source in enumerate(SOURCES)}
    size = (min(24.0, 4.0 + 0.09 * float(times[-1])), 5.0)
    panels = drawing(path, 3, size=size, grid=False, sharex=True, height_ratios=[3, 0.4, 2])
    with panels as ((top,), (ticks,), (bottom,)):
        edges = np.arange(0.0, times[-1] + _BAR, _BAR)
        requested = {row["requested"] for row in rows}
        base = np.zeros(len(edges) - 1)
        for source in SOURCES:
            done = np.array([row[source] for row in rows])
            height = np.histogram(times - step / 2, edges, weights=done)[0] / _BAR
            if done.any() or source in requested:
                style = {"align": "edge", "color": colours[source], "label": readable(source)}
                top.bar(edges[:-1], height, _BAR, base, **style)
            base += height
        damage = np.array([sum(row[source] for source in SOURCES) for row in rows])
        counted = np.array([row["counted"] for row in rows])
        for hits, level, colour in ((counted > 0, 1, "C2"), ((damage > 0) & (counted <= 0), 0, "C1")):
            ticks.eventplot(times[hits], lineoffsets=level, linelengths=0.8, colors=colour)
        for fight in dict.fromkeys(row["fight"] for row in rows):
            own = [row for row in rows if row["fight"] == fight]
            for name, style in (("player", "k-"), ("machine", "C1--")):
                health = [row[f"{name}_health"] for row in own]
                bottom.plot([row["seconds"] for row in own], health, style, label=None if fight else name)
            start, ended = own[0]["seconds"] - step, readable(own[-1]["ended"])
            text = f"{own[0]['machine']}\n{ended}".strip()
            bottom.text(start + 0.3, 1.06, text, fontsize=7, va="bottom", clip_on=False)
        _mark(rows, colours, (top, ticks, bottom))

        top.set_ylabel("damage [HP/s]")
        top.set_ylim(0, max(1.0, 1.2 * float(base.max())))
        top.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        ticks.set_yticks([0, 1], ["other hits", "as requested"], fontsize=7)
        ticks.set_ylim(-0.6, 1.6)
        bottom.set(ylabel="health", xlabel="time [s]", xlim=(0, times[-1]))
        bottom.set_ylim(0, 1.45)
        bottom.set_yticks([0, 0.5, 1])
        bottom.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _mark(rows: Sequence[Mapping[str, Any]], colours: Mapping[str, Any], panels: Sequence[Any]) -> None:
    """Draw bands of the requested style, and lines at the ends of fights."""
    step = rows[0]["seconds"]
    starts = [i for i, row in enumerate(rows) if i == 0 or row["requested"] != rows[i - 1]["requested"]]
    for start, end in zip(starts, [*starts[1:], len(rows)], strict=True):
        name, left, right = rows[start]["requested"], start * step, end * step
        for panel in panels:
            panel.axvspan(left, right, color=colours.get(name, "0.6"), alpha=0.15, lw=0)
        style = {"transform": panels[0].get_xaxis_transform(), "ha": "center", "va": "top", "fontsize": 8}
        panels[0].text((left + right) / 2, 0.99, readable(name), **style)
    for row in rows:
        if row.get("brittle"):
            panels[0].axvspan(
                row["seconds"] - step, row["seconds"], facecolor="none", edgecolor="0.7", hatch="//", lw=0
            )
        if row["ended"]:
            for panel in panels:
                panel.axvline(row["seconds"], color="0.3", lw=0.8, ls=":")
