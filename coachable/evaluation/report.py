"""`coachable report`: all measurements of an agent on one page, with intervals over seeds."""

import csv
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from tqdm import tqdm

from coachable import __version__
from coachable.domain import Domain
from coachable.evaluation.episode_records import RolloutOptions
from coachable.evaluation.evaluation_settings import EvaluationSettings
from coachable.evaluation.report_figures import draw_metrics, draw_requests, draw_switches, draw_tradeoffs
from coachable.evaluation.report_page import Page, paragraph, picture, shown, table
from coachable.evaluation.runs import Run, StyleTable, estimate, evaluate_run, flat_row, response_rows, sweep_estimate
from coachable.evaluation.style_grid import acting, training_counts, write_csv
from coachable.evaluation.wording import counted, heading_of, readable
from coachable.outputs import complete_folder
from coachable.styles import Setpoint, StyleSpace
from coachable.training.weights import LoadedPolicy, domain_of, load_policy, widths_of

_LONGEST_TABLE = 100  # rows; longer ones stay in their files


def report(sources: Sequence[str | Path], out: Path, **settings: Any) -> str:
    """Evaluate an agent, or several trained with different seeds, and write the report.

    Args:
        sources: Checkpoints, run folders, weights files, or names of domains that ship with weights.
        out: Folder for `report.html`, its figures (PNG) and tables (CSV), created if missing.
        **settings: Keyword arguments of `write_report`.

    Returns:
        A short summary as text.

    Raises:
        ValueError: If the agents belong to different domains or have different styles.
    """
    agents = [load_policy(source) for source in sources]
    first = agents[0]
    for agent, source in zip(agents, sources, strict=True):
        domains = agent.metadata["domain"], first.metadata["domain"]
        same = domains[0] == domains[1] and widths_of(agent) == widths_of(first)
        if not same or not first.space.encodes_like(agent.space):
            differences = " ".join(first.space.difference(agent.space)) or "they differ in their observations"
            if domains[0] != domains[1]:
                differences = f"the one belongs to {domains[0]}, the other to {domains[1]}"
            raise ValueError(f"{source} cannot share a report with {sources[0]}: {differences}")
    domain = domain_of(first)
    return write_report(domain, dict(zip(map(str, sources), agents, strict=True)), out, **settings)


def write_report(
    domain: Domain,
    agents: Mapping[str, LoadedPolicy],
    out: Path,
    *,
    seeds: int = 5,
    episodes: int = 4,
    switch_episodes: int = 20,
    sweep_points: int = 5,
    **options: Unpack[RolloutOptions],
) -> str:
    """Evaluate the agents and write `report.html` with its figures and tables.

    A *run* is one complete evaluation. A single agent is evaluated with several seeds of the initial states, several
    agents once each. Values are interquartile means over the mean values of the runs; intervals are from a stratified
    bootstrap over the runs.

    Args:
        domain: Domain in which the agents act.
        agents: Policies by name, all of the same style space.
        out: Folder to write into, created if missing.
        seeds: Number of runs of a single agent.
        episodes: Number of episodes per run and style, and per run and value of a weight.
        switch_episodes: Number of episodes per run in which the style switches.
        sweep_points: Number of values of each weight.
        **options: See `RolloutOptions`; the seed is that of the first run, and later runs count up from it.

    Returns:
        A short summary as text.

    Raises:
        ValueError: If there are no runs.
    """
    seed, steps, progress = options.get("seed", 0), options.get("steps"), options.get("progress", True)
    if len(agents) == 1:
        (only,) = agents.values()
        planned = [(f"seed {seed + i}", only, seed + i) for i in range(seeds)]
    else:
        planned = [(name, agent, seed) for name, agent in agents.items()]
    if not planned:
        raise ValueError(f"seeds must be at least 1, got {seeds}")
    with complete_folder(out) as folder:
        counts = {"episodes": episodes, "switch_episodes": switch_episodes, "sweep_points": sweep_points}
        bar = tqdm(planned, desc="evaluating", unit="run", disable=None if progress else True)
        asked: dict[str, Any] = {**options, **counts}
        runs = [evaluate_run(label, domain, agent, **asked | {"seed": number}) for label, agent, number in bar]
        agent = next(iter(agents.values()))
        styles = StyleTable(runs, agent.space)
        formats = _formats(styles, domain)
        titles = _titles(domain, agent.space, styles, formats)
        page = Page(f"{domain.name}: requested and measured style", _lead(agents, runs, episodes))
        sections = _Sections(page, domain, agent, runs, styles, formats, titles, folder)
        sections.add_styles()
        sections.add_requests()
        sections.add_switches(switch_episodes)
        sections.add_tradeoffs()
        if domain.evaluation is not None:
            settings = EvaluationSettings(episodes, switch_episodes, sweeps=runs[0].sweeps, **options)
            sections.add_own(settings)
        command = f"coachable report {shlex.join(agents)} --seed {seed} --episodes {episodes}"
        command += f" --switch-episodes {switch_episodes} --sweep-points {sweep_points}"
        command += f" --seeds {seeds}" if len(agents) == 1 else ""
        command += f" --steps {steps}" if steps else ""
        html = page.text(f"coachable {__version__}; made by: {command}")
        (folder / "report.html").write_text(html, encoding="utf-8")
    return _text(styles, runs, formats, out)


def _formats(styles: StyleTable, domain: Domain) -> dict[str, str]:
    """Return the format of each metric to show: of the domain's published columns, or else of all metrics."""
    declared = {column.removeprefix("measured_"): form for column, form in domain.columns.items()}
    published = {name: form for name, form in declared.items() if name in styles.scores}
    return published or {name: ".0%" if name == "survived" else ".3g" for name in styles.scores}


def _titles(domain: Domain, space: StyleSpace, styles: StyleTable, formats: Mapping[str, str]) -> dict[str, str]:
    """Return headings with units of metrics, by their names and by their columns."""
    names = {name: formats.get(name, "") for name in styles.scores}
    own = {name: heading_of(domain, space, name, form) for name, form in names.items()}
    return own | {c: heading_of(domain, space, c, form) for n, form in names.items() if (c := styles.column(n)) != n}


def _lead(agents: Mapping[str, LoadedPolicy], runs: Sequence[Run], episodes: int) -> str:
    (name, agent), *others = agents.items()
    counts = training_counts(agent)
    trained = f", trained for {counts}" if counts else ""
    subject = "Several agents" if others else f"{acting(agent)} of {name}{trained}"
    grid = runs[0].grid
    return (
        f"{subject}. {counted(len(runs), 'run')} ({', '.join(run.label for run in runs)}) of "
        f"{counted(episodes, 'episode')} in each of {counted(len(grid.cells), 'style')}, up to {grid.steps} steps "
        "each. Values are interquartile means over the runs, each run counting with the mean of its episodes; in "
        "brackets 95 % intervals, by stratified bootstrap over runs. An interquartile mean leaves out the lowest and "
        "the highest quarter of the values; of fewer than four it is the plain mean. For shares it describes a "
        "typical style rather than the average, so the summary also gives the plain mean."
    )


@dataclass(frozen=True)
class _Sections:
    """What the sections of a report are made of, and the page to which they are added."""

    page: Page
    domain: Domain
    agent: LoadedPolicy
    runs: Sequence[Run]
    styles: StyleTable
    formats: Mapping[str, str]
    titles: Mapping[str, str]
    out: Path

    def add_styles(self) -> None:
        """Add the tables and the figure of the metrics in every style."""
        metrics = list(self.formats)
        by_column = {self.styles.column(name): form for name, form in self.formats.items()}
        summary, rows = self.styles.summary(metrics), self.styles.rows(metrics)
        write_csv([flat_row(row) for row in summary], self.out / "summary.csv")
        write_csv([flat_row(row) for row in self.styles.rows(list(self.styles.scores))], self.out / "styles.csv")
        free = [name for name in metrics if name not in self.styles.cells[0]] or metrics
        draw_metrics(self.styles, self.agent.space, free, by_column, self.out / "styles.png", self.titles)
        self.page.section("Summary", table(summary, by_column, titles=self.titles))
        figure = picture(self.out / "styles.png", "metrics per style, with intervals")
        self.page.section("Every style", figure, table(rows, by_column, colour=True, titles=self.titles))

    def add_requests(self) -> None:
        """Add measured over requested values of the set-points, if any are measured."""
        setpoints = [p.name for p in self.agent.space.parameters if isinstance(p, Setpoint)]
        requested = [name for name in setpoints if name in self.styles.cells[0]]
        measured = [name for name in requested if not np.isnan(self.styles.scores.get(name, np.nan)).all()]
        if not measured:
            return
        draw_requests(self.styles, self.agent.space, measured, self.out / "requests.png")
        parts = [picture(self.out / "requests.png", "requested against measured values")]
        rows = response_rows(self.runs, self.agent.space)
        if rows:
            write_csv([flat_row(row) for row in rows], self.out / "requests.csv")
            parts.append(paragraph("Slope and rank correlation of the measured over the requested value; 1 is ideal."))
            parts.append(table(rows, {"slope": ".2f", "rank_correlation": ".2f", "mean_error": ".3f"}))
        self.page.section("Requested and measured", *parts)

    def add_switches(self, episodes: int) -> None:
        """Add how fast the agent complies after switches, in `episodes` episodes per run, if there are any."""
        tests = [run.switching for run in self.runs]
        switches = sum(test.switches for test in tests)
        if not switches:  # the episodes are too short for one, or compliance cannot be judged
            return
        period = tests[0].period * self.domain.control_step
        draw_switches(self.runs, period, self.out / "switches.png")
        row: dict[str, Any] = {
            "complied": estimate([test.complied for test in tests]),
            "median_seconds": estimate([test.median_seconds for test in tests]),
            **{name: estimate([test.metrics[name] for test in tests]) for name in tests[0].metrics},
        }
        write_csv([flat_row(row | {"switches": switches})], self.out / "switches.csv")
        self.page.section(
            "Styles that change while the agent acts",
            paragraph(
                f"{counted(episodes, 'episode')} per run, another style every {period:g} s, "
                f"{switches} {'switch' if switches == 1 else 'switches'}. "
                "Complied: the agent did what was asked before the next switch."
            ),
            picture(self.out / "switches.png", "share of switches complied with over time"),
            table([row], {**self.formats, "complied": ".0%", "median_seconds": ".2f"}, titles=self.titles),
        )

    def add_tradeoffs(self) -> None:
        """Add task success over the amount of style along each weight, if there are weights."""
        if not self.runs[0].sweeps:
            return
        measured = [name for name in self.formats if name in self.runs[0].sweeps[0].episodes]
        success = next((name for name in measured if name not in self.agent.space), "survived")
        draw_tradeoffs(self.runs, success, self.formats.get(success, ""), self.out / "tradeoffs.png", self.titles)
        rows = [
            {"weight": sweeps[0].weight, "value": float(value), "style": sweep_estimate(sweeps, sweeps[0].score, i)}
            | {name: sweep_estimate(sweeps, name, i) for name in sweeps[0].episodes}
            for sweeps in zip(*(run.sweeps for run in self.runs), strict=True)
            for i, value in enumerate(sweeps[0].values)
        ]
        write_csv([flat_row(row) for row in rows], self.out / "tradeoffs.csv")
        kept = ("weight", "value", "style", *(name for name in self.formats if name in rows[0]))
        self.page.section(
            "What a style costs",
            paragraph(
                "Each weight from neutral to its maximum, the other parameters at their defaults. Style is what the "
                "domain measures under the weight's name, or else what the weight rewards per step, at weight 1; task "
                f"success is {readable(success)}."
            ),
            picture(self.out / "tradeoffs.png", "task success against style score along each weight"),
            table([{name: row[name] for name in kept} for row in rows], self.formats, titles=self.titles),
        )

    def add_own(self, settings: EvaluationSettings) -> None:
        """Add the tables and figures that the domain's own evaluation writes for the first run."""
        assert self.domain.evaluation is not None
        folder = self.out / self.domain.name
        folder.mkdir(exist_ok=True)
        self.domain.evaluation(self.domain, self.agent, folder, settings)
        source = [paragraph(f"Measured in {self.runs[0].label} only.")] if len(self.runs) > 1 else []
        for file in sorted(folder.glob("*.csv")):
            with file.open(newline="", encoding="utf-8") as lines:
                rows = [{name: _number(value) for name, value in row.items()} for row in csv.DictReader(lines)]
            figure = file.with_suffix(".png")
            parts = [*source, *([picture(figure, f"{readable(file.stem)}, a figure")] if figure.is_file() else [])]
            columns = {name: [value for row in rows if isinstance(value := row[name], float)] for name in rows[0]}
            largest = {name: max(filter(math.isfinite, values), default=0.0) for name, values in columns.items()}
            large = [name for name, value in largest.items() if value >= 1000]
            parts.append(
                table(rows, dict.fromkeys(large, ".0f"))
                if len(rows) <= _LONGEST_TABLE
                else paragraph(f"{len(rows)} rows: {file.relative_to(self.out)}")
            )
            self.page.section(readable(file.stem).capitalize(), *parts)


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _text(styles: StyleTable, runs: Sequence[Run], formats: Mapping[str, str], out: Path) -> str:
    lines = []
    for row, form in zip(styles.summary(list(formats)), formats.values(), strict=True):
        extremes = "; ".join(f"{t} {shown(row[t], form)} at {row[f'{t} at']}" for t in ("lowest", "highest"))
        lines.append(f"{readable(row['metric'])}: {shown(row['all styles'], form)}; {extremes}")
    if any(run.switching.switches for run in runs):
        complied = estimate([run.switching.complied for run in runs])
        lines.append(f"switches complied with: {shown(complied, '.0%')}")
    return "\n".join([*lines, f"wrote {out / 'report.html'}"])
