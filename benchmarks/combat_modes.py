"""Fights with sampled, most likely and sharpened actions, which show whether fighters have to sample.

    python benchmarks/combat_modes.py combat combat_middle --fights 10

Every way of acting fights the same machines, sites and styles. The second table is about the fights with sampled
actions: how probable evading (square, with the right thumb on the buttons) and eating (up, with the left one) are, and
how often they are the most likely action.
"""

import argparse
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domain import Domain
from coachable.domains.combat.fights import PARTS
from coachable.domains.combat.styles import single_styles
from coachable.envs.combat import constants as c
from coachable.envs.combat.gamepad import HEADS
from coachable.envs.combat.state import BERRY, DODGE
from coachable.envs.combat.tables import SITES
from coachable.envs.combat.traits import MACHINE_NAMES
from coachable.evaluation.statistics import wilson_interval
from coachable.evaluation.style_grid import markdown_table
from coachable.training.rollout import Rollout
from coachable.training.weights import LoadedPolicy, domain_of, load_policy

SIZES = [len(values) for values in HEADS.values()]
RARE = ("face", "dpad", "left_mode", "right_mode")  # heads of evading and eating
# Exponent of the probabilities by head, None for the most likely value; and whether the sticks are sampled.
WAYS: dict[str, tuple[Callable[[str], float | None], bool]] = {
    "sampled": (lambda head: 1.0, True),
    "most likely": (lambda head: None, False),
    "buttons sampled, sticks not": (lambda head: 1.0, False),
    "sticks sampled, buttons not": (lambda head: None, True),
    "sampled at temperature 0.5": (lambda head: 2.0, False),
    "thumbs and their buttons sampled": (lambda head: 1.0 if head in RARE else None, False),
}


class Player:
    """Actor that acts in one of `WAYS`, from the outputs of a policy."""

    def __init__(self, actor: Any, way: str) -> None:
        self.actor = actor
        self.exponent, self.noisy = WAYS[way]

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        found = self.actor(tensordict)
        parts = []
        for head, probs in zip(HEADS, found["probs"].split(SIZES, -1), strict=True):
            exponent = self.exponent(head)
            chosen = probs.argmax(-1) if exponent is None else torch.multinomial(probs.pow(exponent), 1)[:, 0]
            parts.append(torch.nn.functional.one_hot(chosen, probs.shape[-1]).float())
        noise = torch.randn_like(found["loc"]) * found["scale"] if self.noisy else 0.0
        return found.set("action", torch.cat([*parts, torch.tanh(found["loc"] + noise)], -1))


def damage_taken(before: Tensor, after: Tensor, eaten: Tensor) -> Tensor:
    """Return the damage in a step, from the health before and after it and the berries eaten, (N,) each [HP].

    A berry restores no more than the health that is missing.
    """
    restored = eaten * (c.PLAYER_HP - before).clamp(max=c.BERRY_HP)
    return (before - after + restored).clamp(min=0.0)


def fight(domain: Domain, agent: LoadedPolicy, way: str, fights: int) -> dict[str, np.ndarray]:
    """Return sums over each fight: outcome, damage taken, evasions, berries, and how probable the policy makes them."""
    cells, machines = single_styles(agent.space), agent.config["env"]["machines"] or MACHINE_NAMES
    rows = list(product(cells, machines, range(fights)))
    theta = agent.space.make_all(cell for cell, _, _ in rows)
    env = domain.styled_env(agent.space, len(rows), seed=0)
    simulation: Any = env.base_env
    simulation.assign([machine for _, machine, _ in rows], [SITES[number % 3] for _, _, number in rows])
    rollout, player = Rollout(env, 0), Player(agent.actor, way)
    rollout.begin(theta)
    alive = torch.ones(len(rows), dtype=torch.bool)
    sums: dict[str, Tensor] = {}
    while alive.any():
        before = simulation.state
        hp, berries, evading = before.hp.clone(), before.berries.clone(), before.timers[DODGE].clone()
        could_eat = (before.hp < c.PLAYER_HP) & (before.berries > 0) & (before.timers[BERRY] <= 0)
        transition = rollout.step(player, theta)
        state, measured = simulation.state, domain.measures.step(transition)
        eaten = (berries - state.berries).clamp(min=0.0)
        face, dpad, _, _, left, right = transition["probs"].split(SIZES, -1)
        square, up = HEADS["face"].index("square"), HEADS["dpad"].index("up")
        values = {
            "won": measured["won"],
            "damage": measured["damage"],
            "requested": measured["requested_damage"].nan_to_num(),
            "taken": damage_taken(hp, state.hp, eaten),
            "evasions": ((state.timers[DODGE] > 0) & (state.timers[DODGE] > evading)).float(),
            "berries": eaten,
            "seconds": torch.full_like(hp, domain.control_step),
            "evade_p": face[:, square] * right[:, 0],
            "evade_top": ((face.argmax(-1) == square) & (right.argmax(-1) == 0)).float(),
            "eat_p": dpad[:, up] * left[:, 0] * could_eat,
            "eat_top": ((dpad.argmax(-1) == up) & (left.argmax(-1) == 0) & could_eat).float(),
        }
        for name, value in values.items():
            sums[name] = sums.get(name, torch.zeros(len(rows))) + torch.where(alive, value, 0.0)
        alive = alive & ~transition.get(("next", "done"))[:, 0]
    env.close()
    asked = torch.tensor(
        [any(weight > 0 and name not in PARTS for name, weight in cell.items()) for cell, _, _ in rows]
    )
    return {name: value.numpy() for name, value in sums.items()} | {"asked": asked.numpy()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agents", nargs="+", metavar="AGENT")
    parser.add_argument("--fights", type=int, default=10, help="per style and machine")
    args = parser.parse_args()
    torch.set_num_threads(1)
    formats = {"agent": "", "way": "", "fights": "", "won": ".1%", "interval": "", "score": ".3f", "taken": ".0f"}
    formats |= dict.fromkeys(("evasions", "berries"), ".2f") | {"seconds": ".1f"}
    for source in args.agents:
        agent = load_policy(source)
        domain = domain_of(agent)
        rows, beliefs = [], []
        for way in WAYS:
            sums = fight(domain, agent, way, args.fights)
            low, high = wilson_interval(int(sums["won"].sum()), len(sums["won"]))
            asked = sums["asked"]
            score = sums["requested"][asked].sum() / max(sums["damage"][asked].sum(), 1e-9)
            row = {"agent": source, "way": way, "fights": len(asked), "interval": f"{low:.1%} to {high:.1%}"}
            means = {name: float(sums[name].mean()) for name in formats if name in sums}
            rows.append(row | means | {"score": float(score)})
            if way == "sampled":
                beliefs.append(
                    {"agent": source} | {k: float(v.mean()) for k, v in sums.items() if k[-2:] in ("_p", "op")}
                )
        print(markdown_table(rows, formats), flush=True)
        print(markdown_table(beliefs, {"agent": ""} | dict.fromkeys(list(beliefs[0])[1:], ".2f")), flush=True)


if __name__ == "__main__":
    main()
