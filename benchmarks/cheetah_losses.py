"""Learning curves of the cheetah and how its speed follows the set-point, for each loss, over seeds.

python benchmarks/cheetah_losses.py                 trains what is missing in runs/cheetah_losses, then draws
python benchmarks/cheetah_losses.py --losses sac qr_sac --seeds 0 1
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import torch
from matplotlib import pyplot as plt
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from trainings import RECIPES, train

sys.path.insert(0, str(RECIPES))

from cheetah_speed import cheetah_env, cheetah_space, cheetah_style_reward

from coachable.evaluation.curves import draw_learning_curves
from coachable.evaluation.statistics import bootstrap_interval
from coachable.evaluation.style_grid import write_csv
from coachable.keys import STYLE, STYLE_FEATURES
from coachable.training.weights import load_policy
from coachable.transforms import coachable_env

SPEEDS = torch.linspace(0.0, 3.0, 13)
STEPS, SETTLED = 200, 50  # [env-steps] of an episode, and before its speed counts


@torch.no_grad()
def response(run_dir: Path) -> np.ndarray:
    """Mean realised speed at each requested one, (13,) [m/s], deterministic policy."""
    actor = load_policy(run_dir).actor
    space = cheetah_space()
    env = coachable_env(cheetah_env(len(SPEEDS), seed=123), space, cheetah_style_reward(space), seed=0)
    theta = SPEEDS.unsqueeze(-1)
    current, realised = env.reset(TensorDict({STYLE: theta}, [len(SPEEDS)])), []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(STEPS):
            transition = env.step(actor(current.set(STYLE, theta)))
            realised.append(transition["next", STYLE_FEATURES][:, 0])
            current = step_mdp(transition)
    return torch.stack(realised[SETTLED:]).mean(0).numpy()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--losses", nargs="+", default=["sac", "qr_sac", "cat_rac"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--runs", type=Path, default=Path("runs/cheetah_losses"))
    parser.add_argument("--out", type=Path, default=Path("docs/results/cheetah"))
    parser.add_argument("overrides", nargs="*", help="KEY=VALUE for the recipe")
    args = parser.parse_args()
    torch.set_num_threads(1)
    runs = {loss: [args.runs / f"{loss}_{seed}" for seed in args.seeds] for loss in args.losses}
    for seed in args.seeds:  # one seed of every loss first: an interrupted comparison is a fair one
        for loss in args.losses:
            train("cheetah_speed", args.runs / f"{loss}_{seed}", [f"loss={loss}", f"seed={seed}", *args.overrides])

    args.out.mkdir(parents=True, exist_ok=True)
    draw_learning_curves(runs, args.out / "curves.png", x="frames", y="eval/return", smooth=1)
    figure, axes = plt.subplots(figsize=(5, 4.5))
    wanted, rows, summary = SPEEDS.numpy(), [], {}
    axes.plot(wanted, wanted, color="0.6", linestyle="--", label="as requested")
    for loss, folders in runs.items():
        realised = np.stack([response(folder) for folder in folders])
        low, high = np.stack([bootstrap_interval(column) for column in realised.T], -1)
        (line,) = axes.plot(wanted, realised.mean(0), marker="o", markersize=3, label=loss)
        axes.fill_between(wanted, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
        errors = np.abs(realised - wanted).mean(-1)
        slopes = [float(np.polyfit(wanted, one, 1)[0]) for one in realised]
        summary[loss] = {"mean_error": errors.tolist(), "slope": slopes, "seeds": args.seeds}
        for seed, one in zip(args.seeds, realised, strict=True):
            rows += [
                {"loss": loss, "seed": seed, "requested": w, "realised": r} for w, r in zip(wanted, one, strict=True)
            ]
    axes.set(xlabel="requested speed [m/s]", ylabel="realised speed [m/s]")
    axes.legend(frameon=False)
    figure.savefig(args.out / "response.png", dpi=120, bbox_inches="tight")
    write_csv(rows, args.out / "response.csv")
    (args.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    for loss, values in summary.items():
        print(f"{loss}: mean error {np.mean(values['mean_error']):.2f} m/s, slope {np.mean(values['slope']):.2f}")


if __name__ == "__main__":
    main()
