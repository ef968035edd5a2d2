"""Evaluation of fights in every style: damage matrix, wins, parts, response to a weight, and switches (paper)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from coachable.domain import Domain
from coachable.domains.combat.coached_fight import (
    SOURCES,
    STATES,
    CoachedFights,
    draw_timeline,
    fight_coached,
    requests_of,
)
from coachable.domains.combat.styles import single_styles
from coachable.envs.combat.tables import MACHINES, SITES, STYLES, UNSEEN_MACHINES
from coachable.evaluation.episode_records import record_episodes
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.figures import draw_heat_map, drawing
from coachable.evaluation.statistics import rank_correlation
from coachable.evaluation.style_grid import markdown_table, policy_sentence, rows_where, write_results
from coachable.evaluation.sweep import WeightSweep, sweep_weights
from coachable.evaluation.wording import readable
from coachable.styles import StyleSpace
from coachable.training.weights import LoadedPolicy

PARTS = STYLES[8:11]
COMPOSED_WEAPON, COMPOSED_ELEMENTS = "corrosive_blastsling", ("acid", "adhesive", "purgewater")  # those of its bombs
PAIRS = ("Apex Thunderjaw", "Slaughterspine")  # two of these at once are out of distribution
OUTCOMES = ("won", "died", "out_of_bounds", "timeout")


def composed_styles(space: StyleSpace) -> list[dict[str, float]]:
    """Return the blastsling together with the element of each of its bombs, as far as the space has them (paper)."""
    if COMPOSED_WEAPON not in space.names:
        return []
    high = dict(zip(space.names, space.high.tolist(), strict=True))
    elements = [name for name in COMPOSED_ELEMENTS if name in space.names]
    neutral = dict.fromkeys(space.names, 0.0)
    return [neutral | {name: high[name] for name in (COMPOSED_WEAPON, element)} for element in elements]


def style_label(cell: Mapping[str, float]) -> str:
    """Return a style's name in tables, such as "default", "melee", "no skykiller" or "corrosive_blastsling + acid"."""
    named = [name if value > 0 else f"no {name}" for name, value in cell.items() if value]
    return " + ".join(named) or "default"


def evaluate_fights(domain: Domain, agent: LoadedPolicy, out: Path, settings: EvaluationSettings) -> str:
    """Fight every machine in every style and write tables, figures and a report.

    The files are `damage.csv` (damage by kind and requested style), `wins.csv` (by style and machine), `unseen.csv`
    (wins against machines and pairs that occur in no training), `outcomes.csv` (by machine), `sweep.csv` (share of a
    style's damage over its weight), `switches.csv` (effects of switches of the style during fights), `timeline.csv`
    (some fights in a row, step by step), `damage.png`, `sweep.png`, `timeline.png`, `report.md` and `summary.json`.

    Args:
        domain: Domain combat, as the agent was trained in.
        agent: Policy, which samples its actions, as in training.
        out: Folder, which is created if it is missing.
        settings: `episodes` is the number of fights per style and machine, at random sites; `steps` is their largest
            length. `switch_episodes` is the number of sequences of fights, of the same length, with a style that
            switches; an agent with fewer than two styles of damage has none.

    Returns:
        The report as Markdown.
    """
    episodes, seed, progress = settings.episodes, settings.seed, settings.progress
    out.mkdir(parents=True, exist_ok=True)
    space, steps = agent.space, settings.steps or domain.episode_steps
    cells = single_styles(space) + composed_styles(space)
    labels = [style_label(cell) for cell in cells]
    machines = list(agent.config["env"].get("machines") or MACHINES)
    options: dict[str, Any] = {"episodes": episodes, "steps": steps, "seed": seed, "progress": progress}
    fights = fight_matrix(domain, agent, cells, [(name,) for name in machines], **options)
    damage, wins = damage_rows(fights, labels), _win_rows(fights, labels, machines)
    outcomes = _outcomes(fights, machines)
    alone = fight_matrix(domain, agent, cells, [(name,) for name in UNSEEN_MACHINES], **options)
    pairs = fight_matrix(domain, agent, cells, [(name, name) for name in PAIRS], **options)
    twice = _win_rows(pairs, labels, [f"two {name}" for name in PAIRS])
    unseen = [one | two for one, two in zip(_win_rows(alone, labels, list(UNSEEN_MACHINES)), twice, strict=True)]
    sweeps = settings.sweeps
    if sweeps is None:
        sweeps = sweep_weights(domain, agent, points=7, **options)
    sweep = _sweep_rows(sweeps)
    tables = {"damage": damage, "wins": wins, "unseen": unseen, "outcomes": outcomes, "sweep": sweep}
    coached = None
    if settings.switch_episodes and len(requests_of(space)) > 1:
        sequences = settings.switch_episodes
        coached = fight_coached(domain, agent, sequences=sequences, steps=steps, seed=seed, progress=progress)
        timeline = coached.timeline()
        tables |= {"switches": coached.switches(), "timeline": timeline}
        draw_timeline(timeline, out / "timeline.png")
    _draw_damage(damage, out / "damage.png")
    _draw_sweep(sweep, out / "sweep.png")
    scores = {row["style"]: row["style_score"] for row in damage if row["style_score"] is not None}
    summary = {
        "style_score": scores,
        "win_rate": {row["style"]: row["won"] for row in damage},
        "rank_correlation": _correlations(sweep),
        "fights_per_style": len(machines) * episodes,
        "switching": {row["style"]: row for row in tables.get("switches", [])}.get("all styles"),
        "seed": seed,
    }
    report = _report(agent, tables, summary, episodes, steps, seed)
    if coached is not None:
        report += _switch_report(coached, tables["switches"])
    return write_results(out, report, summary, tables)


def fight_matrix(
    domain: Domain,
    agent: LoadedPolicy,
    cells: Sequence[Mapping[str, float]],
    opponents: Sequence[tuple[str, ...]],
    *,
    episodes: int,
    steps: int,
    seed: int,
    progress: bool,
) -> dict[str, np.ndarray]:
    """Run fights in every style against every opponent.

    Args:
        domain: Domain combat, as the agent was trained in.
        agent: Policy.
        cells: Styles.
        opponents: Types of the one or two machines of each opponent.
        episodes: Number of fights per style and opponent.
        steps: Largest number of steps of a fight.
        seed: Seed of sites, fights and actions.
        progress: Whether to show a progress bar.

    Returns:
        Sum of each measure over each fight, (styles, opponents, episodes).
    """
    space, shape = agent.space, (len(cells), len(opponents), episodes)
    theta = space.make_all(cells)
    theta = theta.repeat_interleave(len(opponents) * episodes, 0)
    longest = max(steps, domain.episode_steps)
    env = domain.styled_env(space, len(theta), seed=seed, num_enemies=len(opponents[0]), episode_steps=longest)
    sites = np.random.default_rng(seed).choice(SITES, len(opponents) * episodes)
    names = [machines for machines in opponents for _ in range(episodes)] * len(cells)
    simulation: Any = env.base_env
    simulation.assign(names, [str(site) for site in sites] * len(cells))
    label = f"{len(cells)} styles x {len(opponents)} opponents x {episodes} fights" if progress else None
    record = record_episodes(env, agent.actor, theta, domain.measures, steps=steps, seed=seed, progress=label)
    sums = domain.measures.summarise(record.measures, record.alive)
    sums["timeout"] = 1.0 - sums["won"] - torch.maximum(sums["died"], sums["out_of_bounds"])
    sums["seconds"] = record.alive.sum(0) * domain.control_step
    return {name: value.reshape(shape).double().numpy() for name, value in sums.items()}


def damage_rows(fights: Mapping[str, np.ndarray], labels: Sequence[str]) -> list[dict[str, Any]]:
    """Return for each requested style the shares of damage by source and elemental state, and parts per fight.

    Args:
        fights: Results of `fight_matrix`, (styles, opponents, fights) by name.
        labels: Names of the requested styles.
    """
    rows = []
    for index, label in enumerate(labels):
        total = max(fights["damage"][index].sum(), 1e-9)
        row: dict[str, Any] = {"style": label, "won": float(fights["won"][index].mean())}
        row |= {name: float(fights[name][index].sum() / total) for name in (*SOURCES, *STATES)}
        row |= {name: float(fights[name][index].mean()) for name in PARTS}
        asked = label if label in row and label not in PARTS else None
        row["style_score"] = row[asked] if asked else None
        row["damage_per_fight"] = float(fights["damage"][index].mean())
        row["seconds"] = float(fights["seconds"][index].mean())
        rows.append(row)
    return rows


def _win_rows(fights: Mapping[str, np.ndarray], labels: Sequence[str], machines: Sequence[str]) -> list[dict[str, Any]]:
    return [
        {"style": label, **dict(zip(machines, fights["won"][index].mean(-1).tolist(), strict=True))}
        for index, label in enumerate(labels)
    ]


def _outcomes(fights: Mapping[str, np.ndarray], machines: Sequence[str]) -> list[dict[str, Any]]:
    return [
        {"machine": machine, **{name: int(fights[name][:, index].sum()) for name in OUTCOMES}}
        for index, machine in enumerate(machines)
    ]


def _sweep_rows(sweeps: Sequence[WeightSweep]) -> list[dict[str, Any]]:
    """Return the share of damage that counts for a weight, or units removed per fight for parts, over the weight."""
    rows = []
    for sweep in sweeps:
        for position, value in enumerate(sweep.values):
            done, damage = sweep.episodes[sweep.weight][position], sweep.episodes["damage"][position]
            share = done.mean() if sweep.weight in PARTS else done.sum() / max(damage.sum(), 1e-9)
            won = float(sweep.episodes["won"][position].mean())
            rows.append({"style": sweep.weight, "weight": float(value), "style_score": float(share), "won": won})
    return rows


def _correlations(sweep: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    found = {}
    for name in dict.fromkeys(row["style"] for row in sweep):
        points = rows_where(sweep, style=name)
        weights, scores = (np.array([row[key] for row in points]) for key in ("weight", "style_score"))
        found[name] = rank_correlation(weights, scores)
    return found


def _draw_damage(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the damage matrix with a column per requested style and a row per kind of damage (paper)."""
    kinds = [*SOURCES, *STATES]
    shares = np.array([[row[kind] for row in rows] for kind in kinds])
    labels = [f"{readable(row['style'])}\n{row['won']:.0%} won" for row in rows]
    title = "share of the damage by requested style (below the line: while the state was active)"
    draw_heat_map(path, shares, list(map(readable, kinds)), labels, ".2f", title, row_line=len(SOURCES), high=1.0)


def _draw_sweep(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the style score over the weight, with a panel per style."""
    names = list(dict.fromkeys(row["style"] for row in rows))
    columns = min(len(names), 5)
    count = -(-len(names) // columns)
    size = (2.6 * columns, 2.4 * count)
    with drawing(path, count, columns, size=size) as grid:
        for panel, name in zip(grid.flat, names, strict=False):
            points = rows_where(rows, style=name)
            weights, scores, won = ([point[key] for point in points] for key in ("weight", "style_score", "won"))
            panel.plot(weights, scores, marker="o", ms=4, label="score")
            panel.plot(weights, won, ls="--", marker="x", ms=4, label="won")
            panel.set(title=readable(name), xlabel="weight")
            panel.set_ylim(-0.05, None)
        for panel in list(grid.flat)[len(names) :]:
            panel.set_visible(False)
        grid[0, 0].legend(fontsize=7)


def _report(
    agent: LoadedPolicy,
    tables: Mapping[str, Sequence[Mapping[str, Any]]],
    summary: Mapping[str, Any],
    episodes: int,
    steps: int,
    seed: int,
) -> str:
    text = "# combat: requested and measured style\n\n"
    text += f"{policy_sentence(agent)}; {episodes} fights of at most {steps} "
    text += f"steps per style and machine, seed {seed}.\n\n![damage by style](damage.png)\n\n"
    scores = ["" if row["style_score"] is None else f"{row['style_score']:.2f}" for row in tables["damage"]]
    table = [{**row, "score": score} for row, score in zip(tables["damage"], scores, strict=True)]
    columns = {"style": "", "won": ".0%", "score": "", "damage_per_fight": ".0f", "seconds": ".0f"}
    text += markdown_table(table, columns | dict.fromkeys(PARTS, ".2f"), {"damage_per_fight": "HP", "seconds": "s"})
    text += "\nScore: share of the damage that counts for the requested style. Parts: units removed per fight.\n"
    titles = {"wins": "Wins by machine", "unseen": "Wins against machines and pairs that occur in no training"}
    for name, title in titles.items():
        columns = {column: "" if column == "style" else ".0%" for column in tables[name][0]}
        text += f"\n## {title}\n\n" + markdown_table(tables[name], columns)
    text += "\n## Outcomes\n\n" + markdown_table(tables["outcomes"], dict.fromkeys(tables["outcomes"][0], ""))
    text += "\n## Weight and score\n\n![score over weight](sweep.png)\n\nRank correlation: "
    return text + ", ".join(f"{name} {value:.2f}" for name, value in summary["rank_correlation"].items()) + ".\n"


def _switch_report(coached: CoachedFights, rows: Sequence[Mapping[str, Any]]) -> str:
    steps, sequences = coached.requests.shape
    period, ends = coached.period * coached.control_step, coached.outcomes()
    text = f"\n## Style switched every {period:g} s\n\n![damage, hits and health over time](timeline.png)\n\n"
    text += f"One sequence of fights, asked for every style in turn. {sequences} such sequences of "
    text += f"{steps * coached.control_step:g} s, the others with styles in random order: {ends['fights']} fights "
    text += f"ended, {ends['won']} of them won.\n\n"
    if rows:
        formats = {"style": "", "switches": "", "complied": ".0%", "median_seconds": ".1f", "share": ".0%"}
        text += markdown_table(rows, formats, {"median_seconds": "s"})
    return text + (
        "\nComplied: damage that counts for the style was done before the next switch. Median: seconds from the "
        "switch to the first of it (not complied: infinite). Share: of the damage between the switch and the next one. "
        "When a fight ends, the next one starts at once; the time to reach the machine is included.\n"
    )
