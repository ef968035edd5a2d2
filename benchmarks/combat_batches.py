"""Share of a training's batches that belongs to each style, and the size of returns, by preset.

    python benchmarks/combat_batches.py small middle full_cpu

Rows that can teach a style are those of its own event table under its own label: stored with it, or relabelled with it.
Returns are those of scripted players, one for each source of damage but traps, against the preset's machines,
under styles as training draws them. They are discounted sums of rewards until the end of a fight.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))

from combat_bots import BOTS
from recipe_config import compose_config
from recipe_target import Target

from coachable.domains.combat import combat_style_reward, combat_style_space
from coachable.envs.combat.env import CombatEnv
from coachable.envs.combat.tables import MACHINES
from coachable.evaluation.style_grid import markdown_table
from coachable.styles import StyleSpace

DRAWS = 200_000
PLAYERS = ("Frost Bolts", "Light Arrow", "Acid Bomb", "Advanced Frost Hunter Arrow", "Advanced Explosive Spike")
PLAYERS += ("Acid Shredder", "Spear")  # one per source of damage
KINDS = ("neutral", "one weight", "several weights")


def styles_of(config: dict[str, Any]) -> tuple[StyleSpace, torch.Tensor]:
    """The space with the training's distribution, and draws from it (DRAWS, m)."""
    space = combat_style_space(config["env"]["styles"], config["env"]["reward_scale"])
    space = space.with_sampler(Target(config["sampler"]).build(space))
    return space, space.sample((DRAWS,), torch.Generator().manual_seed(0))


def name_of(config: dict[str, Any]) -> str:
    return " ".join(filter(None, (config["preset"], config["stage"])))


def batch_row(config: dict[str, Any]) -> dict[str, Any]:
    """Labels, tables and updates of a preset, in numbers per style."""
    space, theta = styles_of(config)
    alone = (theta != 0).sum(-1) == 1
    label = float(((theta[:, 0] != 0) & alone).float().mean())  # of style 0 alone; all are alike
    train, labels = config["train"], config["impersonation"]["n"]
    tables = space.dim + config["env"]["kill_event"]
    table = train["batch_size"] * config["event_share"] / tables
    # Of the admitted fights, those with this style alone. The others have all weights, or any style.
    several = float(((theta != 0).sum(-1) > 1).float().mean())
    own = table * label / (1.0 if config["events"].get("every_style") else label + several)
    asked = min(labels, int(config["impersonation"]["own_table"]))  # labels that ask for the table's event
    relabelled = table * (asked + (labels - asked) * label)
    updates = train["total_frames"] * train["utd_ratio"]
    return {
        "preset": name_of(config),
        "styles": space.dim,
        "machines": len(config["env"]["machines"] or MACHINES),
        "label_share": label,
        "rows_of_label": train["batch_size"] * (labels + 1) * label,
        "table_rows": table,
        "teaching_rows": own + relabelled,
        "updates": round(updates),
        "teaching_rows_in_all": (own + relabelled) * updates,
    }


def fight(config: dict[str, Any], fights: int, steps: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Task rewards (T, N), style features (T, N, m) and whether steps belong to the fight (T, N), of all players."""
    machines = [name for name in config["env"]["machines"] or MACHINES for _ in range(fights)]
    options = {name: config["env"][name] for name in ("styles", "reward_scale", "assist")}
    rows = machines * len(PLAYERS)
    env = CombatEnv(len(rows), seed=0, episode_steps=steps, traps=0, **options)
    env.assign(rows, ["Ice-lake"] * len(rows))
    env.reset()
    generator = torch.Generator().manual_seed(0)
    row = torch.arange(len(rows))
    alive = torch.ones(len(rows), dtype=torch.bool)
    task, features, lives = [], [], []
    for _ in range(steps):
        actions = torch.stack([BOTS[name].act(env, generator) for name in PLAYERS])
        after = env._step(TensorDict({"action": actions[row // len(machines), row]}, [len(rows)]))
        task.append(after["task_reward"][:, 0] * alive)
        features.append(after["style_features"] * alive[:, None])
        lives.append(alive)
        alive = alive & ~after["done"][:, 0]
        if not alive.any():
            break
    return torch.stack(task), torch.stack(features), torch.stack(lives)


def discounted(rewards: torch.Tensor, gamma: float) -> torch.Tensor:
    """Discounted sums from each step on, along the first dimension."""
    total, sums = torch.zeros_like(rewards[0]), []
    for reward in rewards.flip(0):
        total = reward + gamma * total
        sums.append(total)
    return torch.stack(sums).flip(0)


def return_rows(config: dict[str, Any], fights: int, steps: int) -> list[dict[str, Any]]:
    """Size of the returns by the kind of label, over all scripted players."""
    space, theta = styles_of(config)
    reward = combat_style_reward(space)
    gamma, support = config["gamma"], config["critic_support"]
    count = (theta != 0).sum(-1)
    chosen = {"neutral": count == 0, "one weight": count == 1, "several weights": count > 1}
    generator = torch.Generator().manual_seed(0)
    task, features, alive = fight(config, fights, steps)
    base, gains = discounted(task, gamma)[alive], discounted(features, gamma)[alive]
    rows = []
    for kind in KINDS:
        pool = theta[chosen[kind]]
        drawn = pool[torch.randint(len(pool), (len(base),), generator=generator)]
        values = base + reward(gains, drawn)[:, 0]
        clipped = (values > support["v_max"]) | (values < support["v_min"])
        row = {"preset": name_of(config), "labels": kind, "share": float(chosen[kind].float().mean())}
        row |= {"mean": float(values.mean()), "spread": float(values.std())}
        row |= {"99 %": float(np.percentile(values.numpy(), 99)), "clipped": float(clipped.float().mean())}
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("presets", nargs="+")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="changes of every preset")
    parser.add_argument("--fights", type=int, default=2, help="per machine and scripted player; 0 for no returns")
    parser.add_argument("--steps", type=int, default=250, help="largest length of a fight")
    args = parser.parse_args()
    torch.set_num_threads(1)
    configs: list[dict[str, Any]] = []
    for preset in args.presets:
        config = compose_config("combat_cat_rac", [f"preset={preset}", *args.set])
        configs += config["stages"] or [config]
    formats = {"preset": "", "styles": "", "machines": "", "label_share": ".1%", "rows_of_label": ".0f"}
    formats |= {"table_rows": ".1f", "teaching_rows": ".1f", "updates": ",d", "teaching_rows_in_all": ",.0f"}
    print(markdown_table([batch_row(config) for config in configs], formats))
    formats = {"preset": "", "labels": "", "share": ".0%", "mean": ".0f", "spread": ".0f", "99 %": ".0f"}
    for config in configs if args.fights else ():
        print(markdown_table(return_rows(config, args.fights, args.steps), formats | {"clipped": ".1%"}), flush=True)


if __name__ == "__main__":
    main()
