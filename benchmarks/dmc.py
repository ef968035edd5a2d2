"""Return against training time and environment steps: our learner beside other libraries, on plain tasks without style.

    python benchmarks/dmc.py --out runs/dmc --peers /path/to/peers-venv/bin/python
    python benchmarks/dmc.py --out runs/dmc --tasks humanoid-walk --contestants coachable --device cuda

Contestants train one after the other on the same cores, each in a process of its own (`dmc_workers.py`). At every
minute of training the deterministic policy is evaluated in two episodes; the clock stands still meanwhile. The clock
includes the construction of the environments and all compilation after the imports.

A finished training in `--out` is not repeated; an unfinished one starts anew. `--out` gets `results.csv`, `results.md`
and `results.png`. Published curves, where there are any, stand beside the curves over environment steps.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from contest import HERE, thread_settings
from dmc_workers import CONTESTANTS

from coachable.evaluation.figures import MARKERS, drawing
from coachable.evaluation.style_grid import write_csv

MINUTES = {"walker-walk": 30.0, "walker-run": 30.0, "quadruped-walk": 30.0, "humanoid-walk": 90.0}
STEP_MARKS = (100_000, 200_000, 300_000, 500_000, 1_000_000, 2_000_000, 4_000_000)
COLUMNS: tuple[str, ...] = ("task", "contestant", "seed", "minutes", "env_steps", "updates", "return")

# Mean return at thousands of environment steps, counted as here: two for each decision of the policy. FlashSAC and XQC:
# arXiv 2604.04539; SimbaV2, MR.Q and TD-MPC2: arXiv 2502.15280.
PUBLISHED = {
    "humanoid-walk": {
        "FlashSAC": {100: 122, 200: 419, 300: 564, 500: 870, 1000: 940},
        "XQC": {100: 23, 200: 165, 300: 354, 500: 502, 1000: 713},
        "SimbaV2": {100: 2, 200: 79, 300: 243, 500: 462, 1000: 652},
        "MR.Q": {100: 2, 200: 20, 300: 194, 500: 385, 1000: 662},
        "TD-MPC2": {100: 1, 200: 2, 300: 3, 500: 278, 1000: 628},
    },
    "dog-walk": {
        "FlashSAC": {100: 244, 300: 680, 500: 897},
        "XQC": {100: 207, 300: 788, 500: 908},
        "SimbaV2": {100: 207, 300: 641, 500: 863},
        "MR.Q": {100: 81, 300: 433, 500: 736},
        "TD-MPC2": {100: 35, 300: 370, 500: 483},
    },
}

Rows = list[dict[str, float]]


def read_rows(path: Path) -> Rows:
    """Return the evaluations of a training, without a line that was cut off."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return rows


def train(out: Path, task: str, name: str, seed: int, minutes: float, args: argparse.Namespace) -> None:
    """Run a training, unless `out` holds its last evaluation; a contestant that fails is named and left out."""
    path = out / f"{task}_{name}_{seed}.jsonl"
    rows = read_rows(path)
    if rows and rows[-1]["minutes"] >= minutes:
        return
    job = {"contestant": name, "task": task, "seed": seed, "minutes": minutes, "path": str(path.resolve())}
    job |= {"threads": args.threads, "clock": args.clock, "device": args.device}
    if name == "coachable":
        job["settings"] = dict(args.settings)
    python = sys.executable if name == "coachable" else args.peers
    command = [python, str(HERE / "dmc_workers.py"), json.dumps(job)]
    env = os.environ | thread_settings(args.threads) | {"MUJOCO_GL": "disable"}
    print(f"{task}, {name}, seed {seed}: {minutes:g} minutes", file=sys.stderr)
    done = subprocess.run(command, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        path.unlink(missing_ok=True)
        print(f"{name} is left out: {' '.join((done.stderr or '').strip().splitlines()[-1:])}", file=sys.stderr)


def collect(out: Path) -> dict[str, dict[str, dict[int, Rows]]]:
    """Return the evaluations in `out` by task, contestant and seed."""
    found: dict[str, dict[str, dict[int, Rows]]] = {}
    for path in sorted(out.glob("*.jsonl")):
        task, name, seed = path.stem.rsplit("_", 2)
        if rows := read_rows(path):
            found.setdefault(task, {}).setdefault(name, {})[int(seed)] = rows
    return found


def median_at(seeds: dict[int, Rows], column: str, mark: float) -> float | None:
    """Return the median over seeds of the return at a mark, None where a training did not come so far.

    The return is interpolated between evaluations, so that it depends on two or four episodes.
    """
    # Evaluations happen a little after the minute.
    if any(not rows[0][column] / 1.05 <= mark <= rows[-1][column] for rows in seeds.values()):
        return None
    each = [np.interp(mark, [row[column] for row in rows], [row["return"] for row in rows]) for rows in seeds.values()]
    return float(np.median(each))


def table(header: str, marks: Sequence[str], lines: dict[str, list[float | None]]) -> list[str]:
    """Return a markdown table, without the columns that are empty."""
    filled = [i for i in range(len(marks)) if any(values[i] is not None for values in lines.values())]
    if not filled:
        return []
    text = [f"| {header} | " + " | ".join(marks[i] for i in filled) + " |", "|---" * (1 + len(filled)) + "|"]
    for name, values in lines.items():
        cells = ["" if (value := values[i]) is None else f"{value:.0f}" for i in filled]
        text.append(f"| {name} | " + " | ".join(cells) + " |")
    return [*text, ""]


def tables(results: dict[str, dict[str, dict[int, Rows]]]) -> str:
    """Return the returns of every task at marks of time and of environment steps."""
    lines = []
    for task, contestants in results.items():
        end = max(rows[-1]["minutes"] for seeds in contestants.values() for rows in seeds.values())
        step = 10 if end >= 10 else 1
        minutes = np.arange(step, end + step, step)
        by_time = {
            f"{name} ({len(seeds)})": [median_at(seeds, "minutes", mark) for mark in minutes]
            for name, seeds in contestants.items()
        }
        by_steps = {
            name: [median_at(seeds, "env_steps", mark) for mark in STEP_MARKS] for name, seeds in contestants.items()
        }
        by_steps |= {
            f"{name} (published)": [curve.get(mark // 1000) for mark in STEP_MARKS]
            for name, curve in PUBLISHED.get(task, {}).items()
        }
        lines += [f"**{task}**: median return over the seeds (their number).", ""]
        lines += table("minutes", [f"{mark:g}" for mark in minutes], by_time)
        lines += table("thousand env-steps", [f"{mark // 1000:,}" for mark in STEP_MARKS], by_steps)
    return "\n".join(lines)


def draw(results: dict[str, dict[str, dict[int, Rows]]], path: Path) -> None:
    """Draw a column per task: return against minutes above, against environment steps below; one line per seed."""
    names = sorted({name for contestants in results.values() for name in contestants})
    with drawing(path, 2, len(results), size=(4.2 * len(results), 6.4)) as panels:
        for column, (task, contestants) in enumerate(results.items()):
            for name, seeds in contestants.items():
                style = {"color": f"C{names.index(name)}", "marker": MARKERS[names.index(name)], "markevery": 0.2}
                for i, rows in enumerate(seeds.values()):
                    label = None if i else name
                    returns = [row["return"] for row in rows]
                    panels[0, column].plot([row["minutes"] for row in rows], returns, label=label, **style)
                    panels[1, column].plot([row["env_steps"] / 1e3 for row in rows], returns, label=label, **style)
            for i, (name, curve) in enumerate(PUBLISHED.get(task, {}).items()):
                shade = str(0.2 + 0.12 * i)
                panels[1, column].plot(list(curve), list(curve.values()), ":", color=shade, label=f"{name} (published)")
            panels[0, column].set(title=task, xlabel="minutes of training", ylabel="return", ylim=(0, 1000))
            panels[1, column].set(xlabel="thousand env-steps", ylabel="return", ylim=(0, 1000), xscale="log")
            for panel in panels[:, column]:
                panel.legend(fontsize=7)


def write_results(out: Path) -> str:
    """Write `results.csv`, `results.md` and `results.png` from the trainings in `out`; return the tables."""
    results = collect(out)
    if not results:
        return "no contestant could be trained"
    every = [
        dict.fromkeys(COLUMNS, "") | {"task": task, "contestant": name, "seed": seed, **row}
        for task, contestants in results.items()
        for name, seeds in contestants.items()
        for seed, rows in seeds.items()
        for row in rows
    ]
    write_csv(every, out / "results.csv")
    text = tables(results)
    (out / "results.md").write_text(text, encoding="utf-8")
    draw(results, out / "results.png")
    return text


def setting(text: str) -> tuple[str, object]:
    """Return KEY=VALUE of the command line, the value read as JSON."""
    key, value = text.split("=", 1)
    return key, json.loads(value)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the results, one for each choice of settings"
    )
    parser.add_argument("--tasks", nargs="+", default=list(MINUTES), metavar="DOMAIN-TASK")
    parser.add_argument("--contestants", nargs="+", choices=list(CONTESTANTS), default=list(CONTESTANTS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument(
        "--minutes",
        type=float,
        help=f"of each training; default: {', '.join(f'{task} {m:g}' for task, m in MINUTES.items())}, others 90",
    )
    parser.add_argument("--threads", type=int, default=2, help="cores of each contestant")
    parser.add_argument("--clock", choices=["wall", "cpu"], default="wall", help="cpu: processor time of all threads")
    parser.add_argument("--device", default="cpu", help="of our learner; the peers stay on the CPU")
    parser.add_argument("--peers", default=sys.executable, help="interpreter of the peers' environment")
    parser.add_argument("--settings", type=setting, nargs="*", default=[], metavar="KEY=VALUE", help="of our learner")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    for seed in args.seeds:  # the first seed of everything is there before the second begins
        for task in args.tasks:
            for name in args.contestants:
                train(args.out, task, name, seed, args.minutes or MINUTES.get(task, 90.0), args)
                write_results(args.out)
    print(write_results(args.out))


if __name__ == "__main__":
    main()
