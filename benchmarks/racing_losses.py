"""QR-SAC beside SAC on the racing task: task return of the deterministic policy over updates, several seeds.

    python benchmarks/racing_losses.py                  trains what is missing in runs/racing_losses, then draws
    python benchmarks/racing_losses.py --losses qr_sac sac --seeds 0 1 2 --frames 700000

Family "resources", preset `cpu`; styles and conditions as in training, the same for every evaluation. Writes losses.png
and losses.csv.
"""

import argparse
from pathlib import Path

import numpy as np
from trainings import train

from coachable.evaluation.curves import draw_learning_curves, read_metric
from coachable.evaluation.statistics import interquartile_mean, stratified_interval
from coachable.evaluation.style_grid import write_csv

METRIC = "eval/task_return"
EVALUATIONS = 7


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--losses", nargs="+", default=["qr_sac", "sac"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--frames", type=int, default=700_000, help="env-steps of each (default: %(default)s)")
    parser.add_argument("--runs", type=Path, default=Path("runs/racing_losses"))
    parser.add_argument("--out", type=Path, default=Path("docs/results/racing"))
    parser.add_argument("overrides", nargs="*", help="KEY=VALUE for the recipe")
    args = parser.parse_args()
    runs = {loss: [args.runs / f"{loss}_{seed}" for seed in args.seeds] for loss in args.losses}
    settings = [f"train.total_frames={args.frames}", f"train.eval_interval={args.frames // EVALUATIONS}"]
    settings += ["checkpoint.replay=false", "checkpoint.keep=1"]
    for index, seed in enumerate(args.seeds):  # one seed of every loss first: an interrupted comparison is a fair one
        for loss in args.losses:
            train("racing_qr_sac", runs[loss][index], [f"loss={loss}", f"seed={seed}", *settings, *args.overrides])
    args.out.mkdir(parents=True, exist_ok=True)
    draw_learning_curves(runs, args.out / "losses.png", x="updates", y=METRIC, smooth=1)
    rows = []
    for loss, folders in runs.items():
        final = np.array([[read_metric(folder, "frames", METRIC)[1][-1]] for folder in folders])
        low, high = stratified_interval(final)
        row = {"loss": loss, "seeds": len(folders), "iqm": float(interquartile_mean(final[:, 0]))}
        each = {f"seed_{seed}": float(value) for seed, value in zip(args.seeds, final[:, 0], strict=True)}
        rows.append({**row, "low": low, "high": high, **each})
    write_csv(rows, args.out / "losses.csv")
    for row in rows:
        print(f"{row['loss']}: {row['iqm']:.0f} ({row['low']:.0f} to {row['high']:.0f}), {row['seeds']} seeds")


if __name__ == "__main__":
    main()
