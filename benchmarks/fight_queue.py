"""Any number of fights in one batch of environments: where a fight ends, the next one of the list begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from coachable.domains.combat.coached_fight import SOURCES
from coachable.domains.combat.metrics import CombatMeasures
from coachable.envs.combat.env import COMPONENTS_KEY
from coachable.envs.combat.rewards import COMPONENT_SLICES, style_counts
from coachable.envs.combat.tables import SITES
from coachable.training.rollout import Rollout

if TYPE_CHECKING:
    from coachable.domain import Domain
    from coachable.training.weights import LoadedPolicy

__all__ = ["damage_by_source_and_state", "fight_grid", "run_fights", "source_damage"]

_REFILL = 10  # steps between the starts of new fights, because a reset of one fight costs as much as one of all
_SOURCE_COUNTS = style_counts(SOURCES)  # (8, 44)


def damage_by_source_and_state(components: Tensor) -> Tensor:
    """Return the damage by source while each elemental state was active, (N, 8, 7) [HP].

    A step's damage in a state is divided among the sources in proportion to their damage in the step, because the
    components do not pair them. That is exact unless two sources hit within the same 0.2 s and the state changes in
    between.

    Args:
        components: Raw components of a step (N, 44).
    """
    sources = source_damage(components)
    state = components[:, COMPONENT_SLICES["state_damage"]]
    total = sources.sum(-1).clamp(min=1e-9)
    return sources.unsqueeze(-1) * (state / total.unsqueeze(-1)).unsqueeze(-2)


def source_damage(components: Tensor) -> Tensor:
    """Return the damage of a step by source, (N, 8) in the order of `SOURCES` [HP]."""
    return components @ _SOURCE_COUNTS.T.to(components.device)


def run_fights(
    domain: Domain,
    agent: LoadedPolicy,
    theta: Tensor,
    opponents: Sequence[tuple[str, ...]],
    sites: Sequence[str],
    *,
    seed: int,
    batch: int = 1024,
    progress: str | None = None,
) -> dict[str, np.ndarray]:
    """Run fights until each one has ended.

    Args:
        domain: Domain combat, as the agent was trained in.
        agent: Policy, which acts in its own way: it samples its actions.
        theta: Style of each fight (F, m).
        opponents: Types of the one or two machines of each fight, the same number in all fights.
        sites: Site of each fight.
        seed: Seed of fights and actions.
        batch: Largest number of simultaneous fights.
        progress: Label of the progress bar, or None for no bar.

    Returns:
        Measures of `CombatMeasures` summed over each fight (F,), with `timeout` and `seconds`, and `by_state`, the
        damage by source and state (F, 8, 7) [HP].

    Raises:
        ValueError: If there are no fights, or the lengths differ.
    """
    count = len(theta)
    if not count or len(opponents) != count or len(sites) != count:
        raise ValueError(
            f"{count} styles, {len(opponents)} opponents and {len(sites)} sites: expected one of each per fight"
        )
    size = min(batch, count)
    env = domain.styled_env(agent.space, size, seed=seed, num_enemies=len(opponents[0]))
    simulation: Any = env.base_env
    measures = domain.measures
    assert isinstance(measures, CombatMeasures)
    fight = torch.arange(size)  # number of the fight in each row
    waiting, running = size, torch.ones(size, dtype=torch.bool)
    simulation.assign([opponents[i] for i in fight.tolist()], [sites[i] for i in fight.tolist()])
    rollout = Rollout(env, seed)
    rollout.begin(theta[fight])
    sums: dict[str, Tensor] = {}
    with tqdm(total=count, desc=progress, disable=True if progress is None else None, leave=False) as bar:
        step = 0
        while running.any():
            transition = rollout.step(agent.actor, theta[fight])
            values = measures.step(transition) | {"seconds": torch.full((size,), domain.control_step)}
            values["by_state"] = damage_by_source_and_state(transition.get(("next", COMPONENTS_KEY)))
            done = transition.get(("next", "done"))[:, 0] & running
            lost = torch.maximum(values["died"], values["out_of_bounds"])
            values["timeout"] = (done & (values["won"] == 0) & (lost == 0)).float()
            rows = fight[running]
            for name, value in values.items():
                if name not in sums:
                    sums[name] = torch.zeros((count, *value.shape[1:]), dtype=torch.float64)
                sums[name][rows] += value[running].double()
            bar.update(int(done.sum()))
            running &= ~done
            step += 1
            fresh = (~running).nonzero()[:, 0][: count - waiting]
            if len(fresh) and (step % _REFILL == 0 or not running.any()):
                fight[fresh] = torch.arange(waiting, waiting + len(fresh))
                waiting += len(fresh)
                simulation.assign([opponents[i] for i in fight.tolist()], [sites[i] for i in fight.tolist()])
                begun = torch.zeros(size, dtype=torch.bool)
                begun[fresh] = True
                rollout.begin_rows(begun)
                running |= begun
    env.close()
    return {name: value.numpy() for name, value in sums.items()}


def fight_grid(
    domain: Domain,
    agent: LoadedPolicy,
    cells: Sequence[Mapping[str, float]],
    opponents: Sequence[tuple[str, ...]],
    *,
    fights: int,
    **options: Any,
) -> dict[str, np.ndarray]:
    """Run fights in every style against every opponent at every site (paper).

    Args:
        domain: See `run_fights`.
        agent: See `run_fights`.
        cells: Styles.
        opponents: Types of the one or two machines of each opponent.
        fights: Number of fights per style, opponent and site.
        **options: Seed and further keyword arguments of `run_fights`.

    Returns:
        Results of `run_fights`, (styles, opponents, sites * fights, ...).
    """
    theta = agent.space.make_all(cells)
    grid = list(product(range(len(cells)), opponents, SITES, range(fights)))
    rows, faced, places = zip(*((i, machines, site) for i, machines, site, _ in grid), strict=True)
    found = run_fights(domain, agent, theta[list(rows)], faced, places, **options)
    shape = (len(cells), len(opponents), len(SITES) * fights)
    return {name: value.reshape(*shape, *value.shape[1:]) for name, value in found.items()}
