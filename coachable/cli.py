"""The `coachable` command; each sub-command imports its modules only when it runs."""

import argparse
import glob
import runpy
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from coachable import __version__
from coachable.code_version import RECIPES
from coachable.gl import RenderingError, choose_gl_backend
from coachable.shipped import SOURCE_HELP, require_agent

_LARGEST = 2**31 - 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Arguments without the program's name; `sys.argv` by default.

    Returns:
        The exit status: 0 for success, 1 if a check failed, 2 for an error that you can fix, 130 after Ctrl-C.
    """
    parser = _parser()
    options, further = parser.parse_known_args(arguments)
    if further and options.command not in ("coach", "evaluate", "export"):
        parser.error(f"unrecognized arguments: {' '.join(further)}")
    if further:
        from coachable.coach.page.command import read_env_options

        options.env_options = read_env_options(parser, further)
    run: Callable[[argparse.Namespace], int] = options.run
    try:
        return run(options)
    except KeyboardInterrupt:
        left = "complete checkpoints are kept" if options.command == "train" else "nothing was written"
        print(f"coachable {options.command}: interrupted, {left}", file=sys.stderr)
        return 130
    except (ValueError, ImportError, OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and not isinstance(error, RenderingError):
            from coachable.files import CheckpointError

            if not isinstance(error, CheckpointError):
                raise
        print(f"coachable {options.command}: {_sentence(error)}", file=sys.stderr)
        return 2


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _parser() -> argparse.ArgumentParser:
    from coachable.coach.page.command import ENV_OPTIONS, add_parser

    parser = argparse.ArgumentParser(prog="coachable", description="Train one agent, coach it while it acts.")
    parser.add_argument("--version", action="version", version=f"coachable {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(
        name: str, run: Callable[[argparse.Namespace], int], text: str, source: str = ""
    ) -> argparse.ArgumentParser:
        parser = commands.add_parser(name, help=text)
        parser.set_defaults(run=run)
        if source:
            parser.add_argument("source", help=source)
        return parser

    train = command("train", _train, "train an agent with a recipe, as python recipes/RECIPE.py does")
    train.add_argument("recipe", choices=sorted(_recipes()), help="one of %(choices)s")
    train.add_argument(
        "arguments", nargs=argparse.REMAINDER, help="KEY=VALUE ... seeds=0,1,2, or --help for all of them"
    )

    evaluate = command("evaluate", _evaluate, "measure every style of an agent: tables and a figure")
    text = f"{SOURCE_HELP}; several: one per training seed, with a table of all of them"
    evaluate.add_argument("sources", nargs="+", metavar="source", help=text)
    _add_out(evaluate, "evaluation", "folder")
    _add_number(evaluate, "--episodes", 20, "per style")
    _add_number(evaluate, "--switch-episodes", 60, "with switching styles, 0 for none", lowest=0)
    _add_rollout(evaluate)
    evaluate.epilog = ENV_OPTIONS

    render = command("render", _render, "film an agent whose style is switched while it acts", SOURCE_HELP)
    _add_out(render, "coachable.mp4", ".mp4, .gif, .webp or .png")
    text = "one request, NAME=VALUE,NAME=VALUE; repeat it to switch (default: a tour of the styles)"
    render.add_argument("--style", action="append", type=_style, dest="styles", metavar="NAME=VALUE,...", help=text)
    text = "per style (%(default)s)"
    render.add_argument("--seconds", type=float, default=4.0, dest="seconds_per_style", help=text)
    text = "of the picture of one style (default: 640x480)"
    render.add_argument("--size", type=_size, default=(640, 480), metavar="WIDTHxHEIGHT", help=text)
    text = "pictures per second (%(default)s)"
    render.add_argument("--fps", type=float, default=20.0, help=text)
    render.add_argument("--together", action="store_true", help="show all styles at once, side by side")
    render.add_argument("--seed", type=_at_least(0), default=0)

    curves = command("curves", _curves, "draw learning curves of runs, with intervals over seeds")
    text = "runs by label, such as bf16='runs/bf16_*'"
    curves.add_argument("groups", nargs="+", type=_group, metavar="LABEL=PATTERN", help=text)
    curves.add_argument(
        "--x", default="updates", help="updates, frames, minutes or another metric (default: %(default)s)"
    )
    curves.add_argument("--y", default="episode/return", help="metric to draw (default: %(default)s)")
    _add_number(curves, "--smooth", 5, "rows of the moving average")
    _add_out(curves, "curves.png")

    source = "a run's folder or a checkpoint"
    weights = command("weights", _weights, "write the small weights file of a checkpoint", source)
    weights.add_argument("out", type=Path, help="the file, such as weights.pt")

    report = command("report", _report, "write all measurements of an agent on one page")
    text = f"{SOURCE_HELP}; several: one per training seed"
    report.add_argument("sources", nargs="+", metavar="source", help=text)
    _add_out(report, "report", "folder")
    _add_number(report, "--seeds", 5, "runs of a single agent")
    _add_number(report, "--episodes", 4, "per run and style")
    _add_number(report, "--switch-episodes", 20, "per run")
    _add_number(report, "--sweep-points", 5, "values of each weight", lowest=2)
    _add_rollout(report)

    explain = command("explain", _explain, "rank the inputs of an agent, by SHAP and saliency", SOURCE_HELP)
    _add_out(explain, "explanation", "folder")
    _add_number(explain, "--episodes", 100, "trajectories", lowest=2)
    _add_number(explain, "--states", 16, "of each trajectory")
    _add_rollout(explain)

    export = command("export", _export, "write a policy as one ONNX file, or a page on which the agent acts")
    text = "onnx: one file, to run the policy without torch; web: a page for the visitor's browser"
    export.add_argument("format", choices=("onnx", "web"), help=text)
    export.add_argument("source", help=SOURCE_HELP)
    export.add_argument("--out", type=Path, help="(default: the file policy.onnx, or the folder site)")
    text = "of a page: folder with the files of other projects, like node_modules (default: npm fetches them)"
    export.add_argument("--assets", type=Path, metavar="FOLDER", help=text)
    export.epilog = f"{ENV_OPTIONS} They apply to pages only."

    verify = command("verify", _verify, "check an exported model, and an environment, against the model's contract")
    verify.add_argument("file", type=Path, help="a file of coachable export")
    text = "whose environment is compared with the recording (default: the model's own, if it is installed)"
    verify.add_argument("--domain", metavar="NAME", help=text)

    add_parser(commands, SOURCE_HELP, _coach)

    command("doctor", _doctor, "check this installation")
    return parser


def _add_out(parser: argparse.ArgumentParser, default: str, what: str = "") -> None:
    parser.add_argument("--out", type=Path, default=Path(default), help=f"{what} (default: %(default)s)".strip())


def _add_number(parser: argparse.ArgumentParser, flag: str, default: int, what: str, lowest: int = 1) -> None:
    parser.add_argument(flag, type=_at_least(lowest), default=default, help=f"{what} (default: %(default)s)")


def _add_rollout(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `coachable.evaluation.episode_records.RolloutOptions`."""
    parser.add_argument("--steps", type=_at_least(1), help="length of an episode (default: the domain's)")
    parser.add_argument("--seed", type=_at_least(0), default=0)
    text = "physics threads (default: all free cores)"
    parser.add_argument("--threads", type=_at_least(1), dest="num_threads", help=text)


def _recipes() -> dict[str, Path]:
    """Return the recipes by name, from the installed package or from the folder beside it in a clone."""
    names = (file.stem for file in Path(RECIPES, "configs").glob("*_*.yaml"))
    return {name: Path(RECIPES, f"{name}.py") for name in names}


def _train(options: argparse.Namespace) -> int:
    file = _recipes()[options.recipe]
    if many := [argument for argument in options.arguments if argument.startswith("seeds=")]:
        return _train_seeds(file, [argument for argument in options.arguments if argument not in many], many[-1])
    sys.path.insert(0, str(file.parent))  # as python does for a script
    sys.argv = [str(file), *options.arguments]
    runpy.run_path(str(file), run_name="__main__")
    return 0


def _train_seeds(file: Path, arguments: list[str], seeds: str) -> int:
    from coachable.evaluation.many_seeds import parse_seeds, seed_table, train_seeds

    if flags := [argument for argument in arguments if argument.startswith("-")]:
        raise ValueError(f"{seeds} with {flags[0]}: expected KEY=VALUE only")
    given = [argument.partition("=") for argument in arguments]
    for key in ("seed", "resume", "stage"):
        if any(name == key for name, _, _ in given):
            raise ValueError(f"{seeds} with {key}=...: expected one of them; the same command continues all seeds")
    folders = [value for name, _, value in given if name == "run_dir"]
    folder = Path(folders[-1] if folders else f"runs/{file.stem}/seeds_{time.strftime('%Y-%m-%d_%H-%M-%S')}")
    arguments = [argument for argument in arguments if not argument.startswith("run_dir=")]
    chosen = parse_seeds(seeds.partition("=")[2])
    print(f"Writing to {folder}; {shlex.quote(f'run_dir={folder}')} continues what Ctrl-C interrupts", flush=True)
    failed = train_seeds(file, arguments, chosen, folder)
    print(seed_table(folder, chosen, failed), end="")
    return 1 if failed else 0


def _evaluate(options: argparse.Namespace) -> int:
    from coachable.evaluation.many_agents import evaluate_agents

    return _measure(evaluate_agents, options)


def _explain(options: argparse.Namespace) -> int:
    from coachable.evaluation.explain import explain

    return _measure(explain, options)


def _measure(measure: Callable[..., str], options: argparse.Namespace) -> int:
    """Write the results of a measurement into a folder that appears when they are complete, and print its text."""
    from coachable.outputs import complete_folder

    with complete_folder(options.out) as options.out:
        text = measure(**_arguments(options))
    print(text)
    return 0


def _render(options: argparse.Namespace) -> int:
    choose_gl_backend()  # before MuJoCo is imported
    from coachable.evaluation.video import render

    print(f"wrote {render(**_arguments(options))}")
    return 0


def _curves(options: argparse.Namespace) -> int:
    from coachable.evaluation.curves import draw_learning_curves

    groups: dict[str, list[Path]] = {}
    for label, runs in options.groups:
        groups.setdefault(label, []).extend(runs)
    last = draw_learning_curves(groups, options.out, x=options.x, y=options.y, smooth=options.smooth)
    for label, value in last.items():
        print(f"{label}: {options.y} {value:.4g} at the end")
    print(f"wrote {options.out}")
    return 0


def _weights(options: argparse.Namespace) -> int:
    from coachable.training.weights import export_weights

    file = export_weights(options.source, options.out)
    print(f"wrote {file} ({file.stat().st_size / 1e6:.1f} MB)")
    return 0


def _report(options: argparse.Namespace) -> int:
    from coachable.evaluation.report import report

    print(report(**_arguments(options)))
    return 0


def _export(options: argparse.Namespace) -> int:
    env_options: dict[str, str] = getattr(options, "env_options", {})
    if options.format == "web":
        from coachable.evaluation.recorded_page import export_recordings
        from coachable.export.web.simulated_page import export_page
        from coachable.training.weights import domain_of, load_policy

        out, agent = options.out or Path("site"), load_policy(options.source)
        domain = domain_of(agent)
        domain = domain.with_options(domain.read_options(env_options))
        write = export_recordings if domain.make_web is None else export_page
        size = write(agent, domain, out, options.assets)
        print(f"wrote {out} ({size / 1e6:.1f} MB); see it with: python3 -m http.server --directory {out}")
        return 0
    if of_pages := [*(["assets"] if options.assets else []), *env_options]:
        raise ValueError(f"--{of_pages[0]} is for pages: expected coachable export web {options.source}")
    from coachable.export.onnx import export

    out = options.out or Path("policy.onnx")
    difference = export(options.source, out)
    print(f"wrote {out} ({out.stat().st_size / 1e6:.1f} MB), at most {difference:.1g} from torch")
    return 0


def _verify(options: argparse.Namespace) -> int:
    from coachable.export.verify import verify

    verdict = verify(**_arguments(options))
    for sentence in verdict.checked:
        print(sentence)
    for sentence in verdict.problems:
        print(sentence, file=sys.stderr)
    return 1 if verdict.problems else 0


def _coach(options: argparse.Namespace) -> int:
    require_agent(options.source)  # before torch is imported
    from coachable.coach.page.command import serve

    serve(say=lambda text: print(text, flush=True), **_arguments(options))
    return 0


def _doctor(_options: argparse.Namespace) -> int:
    from coachable.doctor import examine

    checks = examine()
    for check in checks:
        print(f"{check.verdict:<7} {check.name:<10} {check.finding}")
    return 1 if any(check.verdict == "problem" for check in checks) else 0


def _arguments(options: argparse.Namespace) -> dict[str, Any]:
    return {name: value for name, value in vars(options).items() if name not in ("run", "command")}


def _at_least(lowest: int) -> Callable[[str], int]:
    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = lowest - 1
        if value < lowest:
            raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number of at least {lowest}")
        if value > _LARGEST:
            raise argparse.ArgumentTypeError(f"{text} is too large: expected at most {_LARGEST}")
        return value

    return number


def _style(text: str) -> dict[str, str]:
    style: dict[str, str] = {}
    for part in text.split(","):
        name, equals, value = part.partition("=")
        if not equals:
            raise argparse.ArgumentTypeError(f"{part!r}: expected NAME=VALUE")
        if name.strip() in style:
            raise argparse.ArgumentTypeError(f"{text!r} gives {name.strip()} twice")
        style[name.strip()] = value.strip()
    return style


def _group(text: str) -> tuple[str, list[Path]]:
    label, equals, pattern = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text!r}: expected LABEL=PATTERN")
    from coachable.evaluation.curves import metrics_files

    runs = [Path(run) for run in sorted(glob.glob(pattern)) if metrics_files(Path(run))]
    if not runs:
        raise argparse.ArgumentTypeError(f"no run with a metrics.csv matches {pattern!r}")
    return label, runs


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = map(int, text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: expected WIDTHxHEIGHT, such as 640x480") from None
    return width, height


if __name__ == "__main__":
    raise SystemExit(main())
