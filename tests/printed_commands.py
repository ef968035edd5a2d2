"""Run the commands that README.md and docs/ print, each as a user would, in a copy of the repository.

python -m tests.printed_commands                     all that take less than a minute
python -m tests.printed_commands --list              what is run, and why the others are not

A command fails if its exit status is not 0 or it does not end within ten minutes. A page of `coachable coach` is
started, has to answer with HTTP 200, and is stopped.
"""

import argparse
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from tests.test_docs import PAGES, ROOT, printed_commands

SECONDS = 600.0  # after which a command counts as hung; processors differ by a factor of four

# Which commands are not run, and why; the first pattern that is found decides.
NOT_RUN = {
    r"^\S+ -m (venv|pip) |^pip ": "installs packages, which .ci/run does",
    r"pytest": "the tests, which .ci/run runs, and benchmarks",
    r"^coachable (coach|curves|evaluate|explain|export|report|train RECIPE|verify)$": "the name of a command",
    r"collector=ray": "needs the extra [cluster], and most of them a cluster",
    r"preset=smoke|--help": "",  # is run
    r"my_circuit": "needs a circuit of the reader's",
    r"runs/": "needs a training of minutes to hours, or is one",
    r"^python recipes/": "a training of minutes to hours",
    r"^python benchmarks/": "a benchmark of minutes to hours",
    r"tests\.(random_kills|mutation)": "takes a quarter of an hour or more",
    r"^coachable (evaluate|report) ": "evaluates for minutes",
    r"^coachable export web": "fetches the page's files from npm",
    r"http\.server": "serves until it is stopped",
    r"domains\.racing\.frontier": "evaluates for minutes",
    r"^coachable render (humanoid$|.* --together)": "draws a film for a minute or more",
}


def reason_not_to_run(command: str) -> str:
    """Return why a command is not run; empty if it is."""
    return next((reason for pattern, reason in NOT_RUN.items() if re.search(pattern, command)), "")


def documented_commands() -> list[str]:
    """Return every command of README.md and docs/ once, in the order in which they are printed."""
    pages = [page for page in PAGES if page.name != "CONTRIBUTING.md"]
    return list(dict.fromkeys(shlex.join(command) for page in pages for command in printed_commands(page)))


def run(command: str, folder: Path, environment: dict[str, str]) -> str:
    """Run a command.

    Returns:
        What is wrong and the command's output; empty if it works.
    """
    log = folder.with_suffix(".log")
    with log.open("w") as output:
        child = subprocess.Popen(
            shlex.split(command),
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        if command.startswith("coachable coach "):
            mistake = _page_mistake(child, log)
        else:
            status = child.wait(SECONDS)
            mistake = f"exit status {status}" if status else ""
    except subprocess.TimeoutExpired:
        mistake = f"takes more than {SECONDS:.0f} s"
    finally:
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
    return f"{mistake}\n{log.read_text()[-4000:]}" if mistake else ""


def _page_mistake(child: subprocess.Popen[bytes], log: Path) -> str:
    """Wait for the address that a page prints, and ask it for the page."""
    end = time.monotonic() + SECONDS
    while time.monotonic() < end and child.poll() is None:
        if address := re.search(r"https?://[\w.]+:\d+", log.read_text()):
            with urllib.request.urlopen(address[0], timeout=10) as answer:
                return "" if answer.status == 200 else f"{address[0]} answers {answer.status}"
        time.sleep(0.2)
    return "prints no address of a page"


def main() -> None:
    """Run the commands, or list them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="say which commands are run, and why the others are not")
    listed = parser.parse_args().list
    commands = {command: reason_not_to_run(command) for command in documented_commands()}
    if listed:
        for command, reason in commands.items():
            print(f"{command}\n    {reason or 'is run'}")
        return
    failed = 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "copy"
        shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(".*", "__pycache__", "runs", "shared", "outputs"))
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        environment = {**os.environ, "PATH": path, "PYTHONPATH": str(folder)}
        for command in (command for command, reason in commands.items() if not reason):
            start = time.monotonic()
            mistake = run(command, folder, environment)
            failed += bool(mistake)
            print(
                f"{time.monotonic() - start:5.1f} s  {command}{'  FAILED: ' + mistake if mistake else ''}", flush=True
            )
    print(f"{sum(map(bool, commands.values()))} other commands are not run; --list names them, each with the reason")
    sys.exit(f"{failed} commands failed" if failed else 0)


if __name__ == "__main__":
    main()
