"""`coachable export web` for simulations that do not run in a browser: a page that plays recorded episodes."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor
from torchrl.envs import EnvBase

from coachable.domain import Domain
from coachable.evaluation.episode_records import record_episodes
from coachable.evaluation.style_grid import published, without_nan
from coachable.evaluation.wording import measures_by_parameter, readable, unit_of
from coachable.export.web.pinned_files import provide
from coachable.export.web.simulated_page import about, copy_page, finish_page
from coachable.outputs import complete_folder
from coachable.scene.frame import Frame, Stage
from coachable.scene.palette import css
from coachable.scene.recorded import encode_backdrop, encode_frames
from coachable.styles import Choice, StyleSpace, Weight
from coachable.training.weights import LoadedPolicy

MOST = 40
"""Largest number of recordings of a page."""

_NEEDED = "three"  # the package that draws
_FOLDER = "recordings"


@dataclass(frozen=True)
class Recording:
    """One recorded episode.

    Attributes:
        frames: What is to be seen at the start and after each step.
        backdrops: What does not move, as bytes, by `Frame.place`.
        measured: Summary of the domain's measures over all steps, with "survived" and "task_return", by name; NaN where
            there is no value.
        terminated: Whether the episode terminated.
    """

    frames: list[Frame]
    backdrops: dict[Hashable, bytes]
    measured: dict[str, float]
    terminated: bool


def export_recordings(agent: LoadedPolicy, domain: Domain, out: Path, assets: Path | None = None) -> int:
    """Write a page that plays one recorded episode of an agent in each style of a grid.

    Grid and length are the domain's, see `coachable.domain.Recorded`.

    Args:
        agent: The agent.
        domain: Its domain.
        out: Folder to write into; files of the same names are replaced.
        assets: Folder with the files of other projects, see `coachable.export.web.pinned_files.provide`.

    Returns:
        Size of all files of the page [byte].

    Raises:
        ValueError: If the domain has no scene, more than `MOST` styles, or names an unknown measure.
        OSError: If the files of other projects cannot be fetched, or writing fails.
    """
    if domain.make_stage is None:
        raise ValueError(
            f"the domain {domain.name} has neither a simulation for the browser nor a scene: expected one that "
            "declares make_web or make_stage"
        )
    cells = domain.recorded_cells()
    if not 0 < len(cells) <= MOST:
        raise ValueError(f"the domain {domain.name} has {len(cells)} styles to record: expected 1 to {MOST}")
    thetas = agent.space.make_all(cells)
    requests = [agent.space.describe(theta) | cell for theta, cell in zip(thetas, cells, strict=True)]
    steps = min(domain.episode_steps, max(1, round(domain.recorded.seconds / domain.control_step)))
    vendored = provide(assets, _NEEDED)
    backdrops: dict[bytes, str] = {}
    with complete_folder(out) as folder:
        recordings = record(agent, domain, requests, steps)
        columns = domain.recorded.columns or domain.columns or published(domain, recordings[0].measured, requests[0])
        shown = [_measure(domain, agent.space, *column) for column in columns.items()]
        if unknown := {measure["name"] for measure in shown} - recordings[0].measured.keys():
            raise ValueError(
                f"the domain {domain.name} shows {', '.join(sorted(unknown))}: expected some of "
                f"{', '.join(sorted(recordings[0].measured))}"
            )
        copy_page(folder, vendored)
        (folder / _FOLDER).mkdir()
        manifest = _manifest(agent, domain, requests)
        played = []
        for number, (recording, request) in enumerate(zip(recordings, requests, strict=True)):
            for content in recording.backdrops.values():
                backdrops.setdefault(content, f"{_FOLDER}/backdrop_{len(backdrops)}.bin")
            names = list(backdrops)
            places = {place: names.index(content) for place, content in recording.backdrops.items()}
            file = f"{_FOLDER}/{number}.bin"
            (folder / file).write_bytes(encode_frames(recording.frames, places))
            found = without_nan({measure["name"]: recording.measured[measure["name"]] for measure in shown})
            played.append({"file": file, "style": request, "terminated": recording.terminated, "measured": found})
        for content, file in backdrops.items():
            (folder / file).write_bytes(content)
        manifest |= {"backdrops": list(backdrops.values()), "measures": shown, "recordings": played}
        return finish_page(folder, manifest, [*backdrops.values(), *(entry["file"] for entry in played)], vendored)


def record(agent: LoadedPolicy, domain: Domain, requests: Sequence[Mapping[str, Any]], steps: int) -> list[Recording]:
    """Record one episode of at most `steps` steps in each style, all of them in one batch."""
    make_stage, alike = domain.make_stage, domain.recorded.alike
    assert make_stage is not None
    options = {**domain.coached, **(alike(len(requests)) if alike else {})}
    env = domain.styled_env(agent.space, len(requests), seed=0, **options)
    cameras = [_Camera(env, row, make_stage(), request) for row, request in enumerate(requests)]

    def see(alive: Tensor) -> None:
        for row in alive.nonzero()[:, 0].tolist():
            cameras[row].see()

    theta = agent.space.make_all(requests)
    taken = record_episodes(
        env, agent.actor, theta, domain.measures, steps=steps, seed=0, progress="recording", watch=see
    )
    summary = domain.measures.summarise(taken.measures, taken.alive)
    summary = {"survived": taken.survived.float(), "task_return": taken.task_return, **summary}
    return [
        Recording(camera.frames, camera.backdrops, {name: float(v[row]) for name, v in summary.items()}, bool(~stays))
        for row, (camera, stays) in enumerate(zip(cameras, taken.survived, strict=True))
    ]


class _Camera:
    """Frames of one row of a batch."""

    def __init__(self, env: EnvBase, row: int, stage: Stage, request: Mapping[str, Any]) -> None:
        self._env, self._row, self._stage, self._request = env, row, stage, request
        self.frames: list[Frame] = []
        self.backdrops: dict[Hashable, bytes] = {}

    def see(self) -> None:
        """Take a frame of the present state."""
        self.frames.append(self._stage.frame(self._env, self._row, self._request))
        place = self.frames[-1].place
        if place not in self.backdrops:
            self.backdrops[place] = encode_backdrop(self._stage.backdrop(self._env, self._row))


def _manifest(agent: LoadedPolicy, domain: Domain, requests: list[dict[str, Any]]) -> dict[str, Any]:
    assert domain.make_stage is not None
    stage, told = domain.make_stage(), domain.recorded
    values = {name: list(dict.fromkeys(request[name] for request in requests)) for name in agent.space.names}
    return {
        **about(agent),
        "kind": "recorded",
        "title": told.title or f"An agent that you coach: {readable(domain.name)}",
        "summary": told.summary,
        "parameters": [
            {
                "name": parameter.name,
                "text": domain.words.name(parameter.name),
                "kind": "choice" if isinstance(parameter, Choice) else "number",
                "weight": isinstance(parameter, Weight),
                "unit": parameter.unit,
                "help": parameter.help,
                "values": values[parameter.name] if isinstance(parameter, Choice) else sorted(values[parameter.name]),
            }
            for parameter in agent.space.parameters
        ],
        "opens": range(len(requests))[domain.recorded.opens],
        "terminated": domain.words.terminated,
        "control_step": domain.control_step,
        "viewpoint": vars(stage.viewpoint),
        "legend": [[css(colour), meaning] for colour, meaning in stage.legend],
    }


def _measure(domain: Domain, space: StyleSpace, column: str, form: str) -> dict[str, Any]:
    """Return what the page has to know of a published column."""
    name = column.removeprefix("measured_")
    groups = measures_by_parameter(space, [name], domain.beside)
    beside = next(parameter for parameter, measures in groups.items() if measures)
    unit = unit_of(domain, space, name)
    digits = int("".join(c for c in form.partition(".")[2] if c.isdigit()) or 3)
    return {
        "name": name,
        "parameter": beside,
        "text": "mean over the recording" if name == beside else domain.words.name(name),
        "unit": unit,
        "asked": bool(beside and unit) and unit == space[beside].unit,
        "share": form.endswith("%"),
        "digits": digits,
        "significant": form.endswith("g"),
    }
