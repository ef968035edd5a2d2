"""The paper's figures and tables of fights, from one agent per training seed.

    python benchmarks/combat_paper.py grid AGENT...        damage matrix, wins, records, radars, parts removed
    python benchmarks/combat_paper.py pareto AGENT...      style score against wins as six weights fall
    python benchmarks/combat_paper.py pairs AGENT...       two weapons requested at once, in five mixtures (ours)
    python benchmarks/combat_paper.py elements AGENT...    use of ammunition and states under requests (ours)
    python benchmarks/combat_paper.py apex AGENT           timeline and film under four requests, and brittle phases
    python benchmarks/combat_paper.py requests AGENT       how rare composed requests were in training
    python benchmarks/combat_paper.py tables               machines, weapons, heads and rewards beside the paper's
    coachable explain AGENT                                SHAP and saliency over 100 trajectories

AGENT is what `coachable evaluate` takes. An agent gets the part of a figure that its styles and machines allow. The
paper fights 10 times per style, machine and site. A thousand fights run at a time, in one process and one thread.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import apex_fight
import numpy as np
import paper_figures
import paper_tables
import torch
from element_use import element_rows
from fight_queue import fight_grid
from reference_tables import reference_tables
from request_odds import odds_rows

from coachable.domain import Domain
from coachable.domains.combat.coached_fight import SOURCES, STATES, draw_timeline
from coachable.domains.combat.fights import (
    COMPOSED_ELEMENTS,
    COMPOSED_WEAPON,
    PAIRS,
    PARTS,
    composed_styles,
    style_label,
)
from coachable.domains.combat.styles import single_styles
from coachable.envs.combat.tables import MACHINES, UNSEEN_MACHINES
from coachable.evaluation.statistics import rank_correlation
from coachable.evaluation.style_grid import write_csv
from coachable.evaluation.video import write_video
from coachable.styles import StyleSpace
from coachable.training.weights import LoadedPolicy, domain_of, load_policy

PARETO = ("melee", "sunscourge", "icestorm_boltblaster", "frost", "plasma", "carjas_bane")  # ours; the paper names none
POINTS = 6  # weights of a curve
PAIRED = (
    ("ancestors_return", "carjas_bane"),
    ("corrosive_blastsling", "ancestors_return"),
    ("carjas_bane", "corrosive_blastsling"),
)  # all presets have these weapons
SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of the first weapon's largest weight; the second gets the rest of its own
COMPOSED = [(COMPOSED_WEAPON, element) for element in COMPOSED_ELEMENTS]

Agents = Mapping[str, LoadedPolicy]
Rows = list[dict[str, Any]]
Cells = list[dict[str, float]]


def load(sources: Sequence[str]) -> tuple[Domain, dict[str, LoadedPolicy]]:
    """The agents by name, which must be of the same styles and machines."""
    agents = {f"seed {number}": load_policy(source) for number, source in enumerate(sources)}
    first, *others = agents.values()
    for other in others:
        if other.space != first.space or other.config["env"] != first.config["env"]:
            raise SystemExit("the agents differ in styles or environment: give one agent per training seed")
    return domain_of(first), agents


def machines_of(agents: Agents) -> list[str]:
    return list(next(iter(agents.values())).config["env"].get("machines") or MACHINES)


def space_of(agents: Agents) -> StyleSpace:
    return next(iter(agents.values())).space


def fight_grids(
    domain: Domain, agents: Agents, cells: Cells, opponents: Sequence[tuple[str, ...]], fights: int, what: str
) -> list[dict[str, np.ndarray]]:
    """The results of `fight_grid`, one per agent."""
    return [
        fight_grid(domain, agent, cells, opponents, fights=fights, seed=seed, progress=f"{name}: {what}")
        for seed, (name, agent) in enumerate(agents.items())
    ]


def grid(domain: Domain, agents: Agents, out: Path, fights: int) -> None:
    """Fight in every style against every machine, the unseen ones and pairs."""
    space = space_of(agents)
    cells = single_styles(space) + composed_styles(space)
    labels = [style_label(cell) for cell in cells]
    machines = machines_of(agents)
    known = fight_grids(domain, agents, cells, [(name,) for name in machines], fights, "machines")
    unseen = fight_grids(domain, agents, cells, [(name,) for name in UNSEEN_MACHINES], fights, "unseen")
    twice = fight_grids(domain, agents, cells, [(name, name) for name in PAIRS], fights, "pairs")
    wins = paper_tables.win_rows(known, labels, machines)
    wins += paper_tables.win_rows(unseen, labels, list(UNSEEN_MACHINES))
    wins += paper_tables.win_rows(twice, labels, [f"two {name}" for name in PAIRS])
    tables: dict[str, Rows] = {
        "matrix": paper_tables.matrix_rows(known, labels),
        "obedience": paper_tables.obedience_rows(known, labels),
        "wins": wins,
        "records": paper_tables.record_rows(known, labels, machines),
        "radars": paper_tables.radar_rows(known, labels, list(agents)),
        "parts": paper_tables.part_rows(known, labels),
    }
    write_tables(tables, out)
    damage = [row for row in tables["matrix"] if row["requested"] not in PARTS]  # parts have a figure of their own
    paper_figures.draw_matrix(damage, out / "matrix.png")
    paper_figures.draw_wins(wins, out / "wins.png", len(machines))
    if tables["radars"]:
        paper_figures.draw_radars(tables["radars"], out / "radars.png")
    if tables["parts"]:
        paper_figures.draw_parts(tables["parts"], out / "parts.png")


def pareto(domain: Domain, agents: Agents, out: Path, fights: int) -> None:
    """Fight at weights from 0 to the maximum, against every machine."""
    space = space_of(agents)
    measured = [name for name in space.names if name in (*SOURCES, *STATES)]
    styles = [name for name in PARETO if name in measured]
    styles += [name for name in measured if name not in styles][: len(PARETO) - len(styles)]
    neutral = dict.fromkeys(space.names, 0.0)
    shares = np.linspace(0.0, 1.0, POINTS)
    cells = [neutral | {name: float(share * space[name].high)} for name in styles for share in shares]
    results = fight_grids(domain, agents, cells, [(name,) for name in machines_of(agents)], fights, "weights")
    rows: Rows = []
    for index, cell in enumerate(cells):
        style = styles[index // POINTS]
        shares = {"style_score": ((style,), ("damage",))}
        rows.append({"style": style, "weight": cell[style]} | paper_tables.share_columns(results, index, shares))
    write_tables({"pareto": rows}, out)
    paper_figures.draw_pareto(rows, out / "pareto.png")


def pairs(domain: Domain, agents: Agents, out: Path, fights: int) -> None:
    """Fight against every machine in which two weapons are requested at once."""
    space = space_of(agents)
    neutral = dict.fromkeys(space.names, 0.0)
    mixtures = [(*pair, share) for pair in PAIRED if set(pair) <= set(space.names) for share in SHARES]
    cells = [
        neutral | {first: share * float(space[first].high), second: (1.0 - share) * float(space[second].high)}
        for first, second, share in mixtures
    ]
    if not cells:
        raise SystemExit("the agents have no two of the weapons that are paired")
    results = fight_grids(domain, agents, cells, [(name,) for name in machines_of(agents)], fights, "mixtures")
    rows = paper_tables.mixture_rows(results, mixtures)
    write_tables({"pairs": rows}, out)
    paper_figures.draw_mixtures(rows, out / "pairs.png")
    for pair in dict.fromkeys((first, second) for first, second, _ in mixtures):
        of_pair = [row for row in rows if (row["first"], row["second"]) == pair]
        shares, measured = (np.array([row[name] for row in of_pair]) for name in ("requested", "share"))
        print(f"{' and '.join(pair)}: rank correlation {rank_correlation(shares, measured):.2f}")


def apex(domain: Domain, agents: Agents, out: Path, fights: int) -> None:
    """Fight under four requests, of which one that was won or came closest to it is drawn, and for frost."""
    agent = next(iter(agents.values()))
    names = apex_fight.requests_in_turn(agent.space.names)
    log, _ = apex_fight.log_fights(domain, agent, names, fights=fights, seed=0, draw=None)
    chosen = log.best()
    renderer = domain.make_renderer(640, 436)
    _, frames = apex_fight.log_fights(domain, agent, names, fights=fights, seed=0, draw=(renderer, chosen))
    renderer.close()
    timeline = log.timeline(chosen)
    tables: dict[str, Rows] = {"apex_timeline": timeline}
    if "frost" in agent.space.names:
        frost, _ = apex_fight.log_fights(domain, agent, ("frost",), fights=fights, seed=1, draw=None)
        tables["brittle"] = apex_fight.brittle_rows(frost)
    write_tables(tables, out)
    draw_timeline(timeline, out / "apex_timeline.png")
    write_video(frames, out / "apex.webp", round(1 / domain.control_step))
    print(f"{int(log.won.sum())} of {fights} fights under {', '.join(names)} won; number {chosen} is drawn")


def elements(domain: Domain, agents: Agents, out: Path, fights: int) -> None:
    """A minute under each request for an elemental state."""
    machines = machines_of(agents)
    rows: Rows = []
    for seed, (name, agent) in enumerate(agents.items()):
        found = element_rows(domain, agent, machines, fights=fights, seconds=60.0, seed=seed)
        rows += [{"agent": name} | row for row in found]
    write_tables({"elements": rows}, out)


def requests(_domain: Domain, agents: Agents, out: Path, _fights: int) -> None:
    space = space_of(agents)
    composed = [pair for pair in COMPOSED if set(pair) <= set(space.names)]
    write_tables({"requests": odds_rows(space, composed, draws=1_000_000)}, out)


def write_tables(tables: Mapping[str, Rows], out: Path) -> None:
    for name, rows in tables.items():
        if rows:
            write_csv(rows, out / f"{name}.csv")
            print(f"{out / name}.csv: {len(rows)} rows")
        else:
            print(f"{name}: nothing that this agent has")


FIGURES = {"grid": grid, "pareto": pareto, "pairs": pairs, "elements": elements, "apex": apex, "requests": requests}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figure", choices=[*FIGURES, "tables"])
    parser.add_argument("agents", nargs="*", metavar="AGENT", help="one per training seed")
    parser.add_argument("--fights", type=int, default=10, help="per style, machine and site; of apex, in all")
    parser.add_argument("--out", type=Path, default=Path("docs/results/combat/paper"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    if args.figure == "tables":
        write_tables(reference_tables(), args.out)
        return
    if not args.agents:
        parser.error(f"{args.figure} needs at least one agent")
    FIGURES[args.figure](*load(args.agents), args.out, args.fights)


if __name__ == "__main__":
    main()
