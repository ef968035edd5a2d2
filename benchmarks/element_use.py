"""Use of ammunition and of elemental states under requests for the states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from coachable.domains.combat.coached_fight import STATES
from coachable.envs.combat.env import COMPONENTS_KEY
from coachable.envs.combat.player import element_of
from coachable.envs.combat.rewards import COMPONENT_SLICES, NUM_COMPONENTS, style_weights
from coachable.envs.combat.tables import ELEMENTS, SITES, STYLES
from coachable.envs.combat.traits import AMMO_SLOTS, ammo_table
from coachable.training.rollout import Rollout

if TYPE_CHECKING:
    from coachable.domain import Domain
    from coachable.training.weights import LoadedPolicy

__all__ = ["element_rows"]

_TERMS = {"damage": "state_damage", "selection": "ammo_change", "build_up": "buildup"}


@torch.no_grad()
def element_rows(
    domain: Domain, agent: LoadedPolicy, machines: Sequence[str], *, fights: int, seconds: float, seed: int
) -> list[dict[str, Any]]:
    """Request each element alone and at its maximum; a fight against one machine that ends is followed by another.

    Args:
        domain: Domain combat, as the agent was trained in.
        agent: Policy.
        machines: Types of the machines.
        fights: Number of simultaneous fights per element, machine and site.
        seconds: Duration [s].
        seed: Seed of fights and actions.

    Returns:
        One row per element of the agent: the share of time with its ammunition selected (`ammunition`), the same under
        the other requests (`ammunition_otherwise`), the share of time in which the machine is in its state (`state`,
        `state_otherwise`), how often the state begins per minute (`begins`), the share of the damage in the state
        (`share`), and the style reward per second by term.
    """
    names = [name for name in STATES if name in agent.space.names]
    fight = [(name, machine, site) for name in names for machine in machines for site in SITES for _ in range(fights)]
    if not fight:
        return []
    theta = agent.space.make_all({name: agent.space[name].high} for name, _, _ in fight)
    env = domain.styled_env(agent.space, len(fight), seed=seed, num_enemies=1)
    simulation: Any = env.base_env
    simulation.assign([(machine,) for _, machine, _ in fight], [site for _, _, site in fight])
    rollout = Rollout(env, seed)
    rollout.begin(theta)
    ammo = ammo_table(torch.device("cpu"))
    steps = max(1, round(seconds / domain.control_step))
    selected, active, begun = (torch.zeros(len(fight), len(ELEMENTS)) for _ in range(3))
    components = torch.zeros(len(fight), NUM_COMPONENTS)
    for _ in range(steps):
        before = simulation.state.state_timer[:, 0].T > 0
        transition = rollout.step(agent.actor, theta)
        components += transition.get(("next", COMPONENTS_KEY))
        state = simulation.state
        during = state.state_timer[:, 0].T > 0
        selected += element_of(state.weapon * AMMO_SLOTS + state.section, ammo).T
        active += during
        begun += during & ~before
        done = transition.get(("next", "done"))[:, 0]
        if done.any():
            rollout.begin_rows(done)
    env.close()
    weights = style_weights(agent.config["env"].get("reward_scale", "sim"))

    def otherwise(values: torch.Tensor) -> float | None:
        return float(values[~own, element].mean()) / steps if len(names) > 1 else None

    rows = []
    for name in names:
        element, own = ELEMENTS.index(name), torch.tensor([asked == name for asked, _, _ in fight])
        style = weights[STYLES.index(name)] * agent.space[name].high
        terms = {
            f"{term}_per_second": float((components[own] * style)[:, COMPONENT_SLICES[part]].sum(-1).mean()) / seconds
            for term, part in _TERMS.items()
        }
        damage = components[own, COMPONENT_SLICES["damage"]].sum().clamp(min=1e-9)
        rows.append(
            {
                "requested": name,
                "ammunition": float(selected[own, element].mean()) / steps,
                "ammunition_otherwise": otherwise(selected),
                "state": float(active[own, element].mean()) / steps,
                "state_otherwise": otherwise(active),
                "begins": float(begun[own, element].mean()) / seconds * 60.0,
                "share": float(components[own][:, COMPONENT_SLICES["state_damage"]][:, element].sum() / damage),
            }
            | terms
        )
    return rows
