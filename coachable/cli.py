"""The `coachable` command. Each sub-command imports what it needs only when it runs."""

import argparse
import glob
import math
import runpy
import sys
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from coachable import __version__
from coachable.gl import RenderingError, choose_gl_backend

__all__ = ["main"]

_LARGEST = 2**31 - 1
_PICTURES = (".png", ".svg", ".pdf")
_SOURCE_HELP = "a run's folder, a checkpoint, a weights file, or a domain that ships with weights"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        arguments: without the program's name; `sys.argv` by default.

    Returns:
        The exit status: 0, 1 where a check failed, 2 for something that the user has to change, 130 after Ctrl-C.
    """
    options = _parser().parse_args(arguments)
    run: Callable[[argparse.Namespace], int] = options.run
    try:
        return run(options)
    except KeyboardInterrupt:
        print(f"coachable {options.command}: interrupted, nothing was written", file=sys.stderr)
        return 130
    except (ValueError, ImportError, OSError, RenderingError) as error:
        print(f"coachable {options.command}: {_sentence(error)}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        from coachable.training.checkpoint import CheckpointError

        if not isinstance(error, CheckpointError):
            raise
        print(f"coachable {options.command}: {error}", file=sys.stderr)
        return 2


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="coachable", description="Train one agent, coach it while it acts.")
    parser.add_argument("--version", action="version", version=f"coachable {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = commands.add_parser("train", help="train an agent with a recipe, as python recipes/RECIPE.py does")
    train.add_argument("recipe", choices=sorted(_recipes()), help="one of %(choices)s")
    train.add_argument("arguments", nargs=argparse.REMAINDER, help="KEY=VALUE ..., or --help for what there is")
    train.set_defaults(run=_train)

    evaluate = commands.add_parser("evaluate", help="measure every style of an agent: tables and a figure")
    evaluate.add_argument("source", help=_SOURCE_HELP)
    evaluate.add_argument("--out", type=Path, default=Path("evaluation"), help="folder (default: %(default)s)")
    evaluate.add_argument("--episodes", type=_at_least(1), default=20, help="per style (default: %(default)s)")
    evaluate.add_argument(
        "--switch-episodes", type=_at_least(1), default=60, help="with switching styles (default: %(default)s)"
    )
    evaluate.add_argument("--steps", type=_at_least(1), help="length of an episode (default: the domain's)")
    evaluate.add_argument("--seed", type=_at_least(0), default=0)
    evaluate.add_argument(
        "--threads", type=_at_least(1), dest="num_threads", help="physics threads (default: all free cores)"
    )
    evaluate.set_defaults(run=_evaluate)

    render = commands.add_parser("render", help="film an agent whose style is switched while it acts")
    render.add_argument("source", help=_SOURCE_HELP)
    render.add_argument("--out", type=Path, default=Path("coachable.mp4"), help=".mp4, .gif or .png (%(default)s)")
    render.add_argument(
        "--style",
        action="append",
        type=_style,
        dest="styles",
        metavar="NAME=VALUE,...",
        help="one request, NAME=VALUE,NAME=VALUE; repeat it to switch (default: a tour of the styles)",
    )
    render.add_argument(
        "--seconds", type=_seconds, default=4.0, dest="seconds_per_style", help="per style (%(default)s)"
    )
    render.add_argument("--size", type=_size, default=(640, 480), metavar="WIDTHxHEIGHT")
    render.add_argument("--seed", type=_at_least(0), default=0)
    render.set_defaults(run=_render)

    curves = commands.add_parser("curves", help="draw learning curves of runs, with intervals over seeds")
    curves.add_argument(
        "groups", nargs="+", type=_group, metavar="LABEL=PATTERN", help="runs by label, such as bf16='runs/bf16_*'"
    )
    curves.add_argument("--x", default="updates", help="metric of the horizontal axis (default: %(default)s)")
    curves.add_argument("--y", default="episode/return", help="metric to draw (default: %(default)s)")
    curves.add_argument(
        "--smooth", type=_at_least(1), default=5, help="rows of the moving average (default: %(default)s)"
    )
    curves.add_argument("--out", type=Path, default=Path("curves.png"), help="(default: %(default)s)")
    curves.set_defaults(run=_curves)

    weights = commands.add_parser("weights", help="write the small weights file of a checkpoint")
    weights.add_argument("source", help="a run's folder or a checkpoint")
    weights.add_argument("out", type=Path, help="the file, such as weights.pt")
    weights.set_defaults(run=_weights)

    report = commands.add_parser("report", help="everything that can be measured of an agent, on one page")
    report.add_argument("sources", nargs="+", metavar="source", help=f"{_SOURCE_HELP}; several: one per training seed")
    report.add_argument("--out", type=Path, default=Path("report"), help="folder (default: %(default)s)")
    report.add_argument("--seeds", type=_at_least(1), default=5, help="runs of a single agent (default: %(default)s)")
    report.add_argument("--episodes", type=_at_least(1), default=4, help="per run and style (default: %(default)s)")
    report.add_argument("--switch-episodes", type=_at_least(1), default=20, help="per run (default: %(default)s)")
    report.add_argument(
        "--sweep-points", type=_at_least(2), default=5, help="values of each weight (default: %(default)s)"
    )
    report.add_argument("--steps", type=_at_least(1), help="length of an episode (default: the domain's)")
    report.add_argument("--seed", type=_at_least(0), default=0)
    report.add_argument(
        "--threads", type=_at_least(1), dest="num_threads", help="physics threads (default: all free cores)"
    )
    report.set_defaults(run=_report)

    explain = commands.add_parser("explain", help="rank the inputs that the agent listens to, by SHAP and saliency")
    explain.add_argument("source", help=_SOURCE_HELP)
    explain.add_argument("--out", type=Path, default=Path("explanation"), help="folder (default: %(default)s)")
    explain.add_argument("--episodes", type=_at_least(2), default=100, help="trajectories (default: %(default)s)")
    explain.add_argument("--states", type=_at_least(1), default=16, help="of each trajectory (default: %(default)s)")
    explain.add_argument("--steps", type=_at_least(1), help="length of an episode (default: the domain's)")
    explain.add_argument("--seed", type=_at_least(0), default=0)
    explain.add_argument(
        "--threads", type=_at_least(1), dest="num_threads", help="physics threads (default: all free cores)"
    )
    explain.set_defaults(run=_explain)

    export = commands.add_parser("export", help="write the policy as one ONNX file, to run it without torch")
    export.add_argument("source", help=_SOURCE_HELP)
    export.add_argument("--out", type=Path, default=Path("policy.onnx"), help="(default: %(default)s)")
    export.set_defaults(run=_export)

    from coachable.coach.page.command import add_parser

    add_parser(commands, _SOURCE_HELP, _coach)

    doctor = commands.add_parser("doctor", help="check this installation and say what it can do")
    doctor.set_defaults(run=_doctor)
    return parser


def _recipes() -> dict[str, Path]:
    """The recipes of this installation: in the package, or beside it in a clone."""
    here = Path(__file__).resolve().parent
    folder = here / "recipes" if (here / "recipes").is_dir() else here.parent / "recipes"
    return {file.stem: folder / f"{file.stem}.py" for file in (folder / "configs").glob("*_*.yaml")}


def _train(options: argparse.Namespace) -> int:
    file = _recipes()[options.recipe]
    sys.path.insert(0, str(file.parent))  # as python does for a script
    sys.argv = [str(file), *options.arguments]
    runpy.run_path(str(file), run_name="__main__")
    return 0


def _evaluate(options: argparse.Namespace) -> int:
    from coachable.evaluation.evaluate import evaluate
    from coachable.evaluation.outputs import complete_folder

    with complete_folder(options.out) as options.out:
        text = evaluate(options.source, **_arguments(options, without=("source",)))
    print(text)
    return 0


def _render(options: argparse.Namespace) -> int:
    choose_gl_backend()  # before MuJoCo is imported
    from coachable.evaluation.video import render

    print(f"wrote {render(options.source, **_arguments(options, without=('source',)))}")
    return 0


def _curves(options: argparse.Namespace) -> int:
    from coachable.evaluation.curves import draw_learning_curves

    if options.out.suffix.lower() not in _PICTURES:
        raise ValueError(f"cannot draw {options.out.name}: expected a file ending in one of {', '.join(_PICTURES)}")
    last = draw_learning_curves(dict(options.groups), options.out, x=options.x, y=options.y, smooth=options.smooth)
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

    print(report(options.sources, **_arguments(options, without=("sources",))))
    return 0


def _explain(options: argparse.Namespace) -> int:
    from coachable.evaluation.explain import explain
    from coachable.evaluation.outputs import complete_folder

    with complete_folder(options.out) as options.out:
        text = explain(options.source, **_arguments(options, without=("source",)))
    print(text)
    return 0


def _export(options: argparse.Namespace) -> int:
    from coachable.export.onnx import export

    difference = export(options.source, options.out)
    print(f"wrote {options.out} ({options.out.stat().st_size / 1e6:.1f} MB), at most {difference:.1g} from torch")
    return 0


def _coach(options: argparse.Namespace) -> int:
    _require_agent(options.source)  # before the page's address is announced
    from coachable.coach.page.command import serve

    serve(say=lambda text: print(text, flush=True), **_arguments(options))
    return 0


def _doctor(_options: argparse.Namespace) -> int:
    from coachable.doctor import examine

    checks = examine()
    for check in checks:
        print(f"{check.verdict:<7} {check.name:<10} {check.finding}")
    return 1 if any(check.verdict == "problem" for check in checks) else 0


def _arguments(options: argparse.Namespace, without: Sequence[str] = ()) -> dict[str, Any]:
    return {name: value for name, value in vars(options).items() if name not in ("run", "command", *without)}


def _require_agent(source: str) -> None:
    """Refuse what cannot be an agent, without the seconds that it takes to load torch.

    Raises:
        ValueError: saying which agents there are.
    """
    shipped = Path(__file__).parent / "pretrained"
    if source and ((shipped / source / "weights.pt").is_file() or Path(source).is_dir()):
        return
    names = ", ".join(sorted(path.parent.name for path in shipped.glob("*/weights.pt")))
    if not source or not Path(source).exists():
        raise ValueError(f"there is no agent {source!r}: expected {_SOURCE_HELP} ({names})")
    if not zipfile.is_zipfile(source):
        raise ValueError(f"{source} is no weights file: expected {_SOURCE_HELP} ({names})")


def _at_least(lowest: int) -> Callable[[str], int]:
    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = lowest - 1
        if value < lowest:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least {lowest}")
        if value > _LARGEST:
            raise argparse.ArgumentTypeError(f"{text} is too large: expected at most {_LARGEST}")
        return value

    return number


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value <= 3600.0:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of seconds above 0 and up to 3600")
    return value


def _style(text: str) -> dict[str, Any]:
    style: dict[str, Any] = {}
    for part in text.split(","):
        name, equals, value = part.partition("=")
        if not equals:
            raise argparse.ArgumentTypeError(f"{part!r} is no NAME=VALUE")
        try:
            style[name.strip()] = float(value)
        except ValueError:
            style[name.strip()] = value.strip()
    return style


def _group(text: str) -> tuple[str, list[Path]]:
    label, equals, pattern = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text!r} is no LABEL=PATTERN")
    runs = [Path(run) for run in sorted(glob.glob(pattern)) if (Path(run) / "metrics.csv").is_file()]
    if not runs:
        raise argparse.ArgumentTypeError(f"no run with a metrics.csv matches {pattern!r}")
    return label, runs


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = map(int, text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no WIDTHxHEIGHT, such as 640x480") from None
    return width, height


if __name__ == "__main__":
    raise SystemExit(main())
