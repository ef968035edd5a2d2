"""`coachable render`: film an agent whose style is switched while it acts, or several styles side by side."""

import itertools
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from tqdm import tqdm

from coachable.domain import Domain
from coachable.evaluation.wording import measured_text, measures_by_parameter, readable, readable_number
from coachable.extras import how_to_install
from coachable.outputs import complete_file
from coachable.scene.look import DARK
from coachable.scene.renderer import SceneRenderer
from coachable.styles import Choice, StyleRangeWarning, StyleSpace, Weight
from coachable.training.rollout import Rollout
from coachable.training.weights import domain_of, load_policy

VIDEO_SUFFIXES = (".mp4", ".gif", ".webp", ".png")
_FPS = (1.0, 60.0)  # least and most
_WEBP_QUALITY = 50  # of 100
_MOST, _FEWEST = 3, 2  # measures in a caption, as many as fit, and in that of a narrow film
_NARROW = 480  # [px]
CAPTION = 44  # [px]
_SMALLEST_FONT, _LARGEST_FONT = 8, 15  # [px]
_MARKS = (((0, -4), (8, -4), (8, 4), (0, 4)), ((4, -4), (8, 4), (0, 4)))  # [px], a square and a triangle
_SMALLEST = (64, CAPTION + 16)  # [px]
_LARGEST = 4096  # [px]
_LONGEST = 3600.0  # [s]
_ROUNDING = 1e-6  # of a picture


def render(
    source: str | Path,
    out: Path,
    *,
    styles: Sequence[dict[str, Any]] | None = None,
    seconds_per_style: float = 4.0,
    size: tuple[int, int] = (640, 480),
    fps: float = 20.0,
    seed: int = 0,
    together: bool = False,
) -> Path:
    """Film one agent, with the requested and the measured style in the picture.

    Args:
        source: Checkpoint, run folder, weights file, or the name of a domain that ships with weights.
        out: File to write: `.mp4`, `.gif`, `.webp`, or `.png` for a sheet with one picture per style.
        styles: Requests by parameter name, in order; by default those of `default_tour`. Numbers outside the trained
            range are clamped, which the caption says.
        seconds_per_style: Time between switches, or length of a film of all styles together [s], above 0 and at most
            3600.
        size: Width and height of the picture of one style [px], at least 64 x 60 and at most 4096 x 4096; even for mp4.
        fps: Pictures per second, from 1 to 60. A domain with a scene is drawn between its control steps as well.
        seed: Seed of the initial state and of sampled actions.
        together: Whether to show all styles at once, side by side in rows of three, instead of one after the other.

    Returns:
        `out`.

    Raises:
        ValueError: If the suffix of `out` is none of the above, or a number lies outside its range.
        ImportError: For mp4 without PyAV; the message names the extra to install.
    """
    if out.suffix not in VIDEO_SUFFIXES:
        raise ValueError(f"cannot write {out.name}: expected a file ending in one of {VIDEO_SUFFIXES}")
    if not 0.0 < seconds_per_style <= _LONGEST:
        raise ValueError(f"seconds per style are {seconds_per_style}: expected more than 0, at most {_LONGEST:g}")
    if any(not low <= side <= _LARGEST for side, low in zip(size, _SMALLEST, strict=True)):
        smallest = "x".join(map(str, _SMALLEST))
        raise ValueError(f"the size is {size[0]}x{size[1]}: expected {smallest} to {_LARGEST}x{_LARGEST}")
    if not _FPS[0] <= fps <= _FPS[1]:
        raise ValueError(f"{fps} pictures per second: expected {_FPS[0]:g} to {_FPS[1]:g}")
    if out.suffix == ".mp4":
        if size[0] % 2 or size[1] % 2:
            raise ValueError(f"the size is {size[0]}x{size[1]}: mp4 needs an even width and height")
        _import_av()
    agent = load_policy(source)
    domain = domain_of(agent)
    requests = default_tour(domain, agent.space) if styles is None else list(styles)
    period = max(1, round(seconds_per_style / domain.control_step))
    sheet, side_by_side = out.suffix == ".png", together and out.suffix != ".png"
    steps = period if side_by_side else len(requests) * period
    fps = max(fps, 1.0 / (steps * domain.control_step))  # at least one picture

    def film(styles: Sequence[dict[str, Any]]) -> Iterator[np.ndarray]:
        rate = None if sheet else fps
        return _film(domain, agent.actor, agent.space, styles, period, size, seed, rate)

    frames = film(requests)
    if side_by_side:
        panels = [film([request]) for request in requests]
        frames = (tiled(row) for row in zip(*panels, strict=True))
    total = len(requests) if sheet else math.floor(steps * domain.control_step * fps + _ROUNDING)
    bar = tqdm(frames, total=total, desc="drawing", unit="frame", disable=None, leave=False)
    with complete_file(out) as unfinished:
        if sheet:
            Image.fromarray(tiled(list(bar))).save(unfinished)
        else:
            write_video(bar, unfinished, fps)
    return out


def default_tour(domain: Domain, space: StyleSpace) -> list[dict[str, Any]]:
    """Return the styles of a film for which no styles were requested.

    A space without weights has every option of each choice with low, middle and high set-points. A space with weights
    has the domain's evaluation grid.
    """
    if any(isinstance(p, Weight) for p in space.parameters):
        return domain.cells()
    choices = [p for p in space.parameters if isinstance(p, Choice)]
    others = [p for p in space.parameters if not isinstance(p, Choice)]
    levels = [{p.name: p.low + level * (p.high - p.low) for p in others} for level in (0.0, 0.5, 1.0)]
    options = itertools.product(*(p.options for p in choices))
    return [
        dict(zip((p.name for p in choices), chosen, strict=True)) | values for chosen in options for values in levels
    ]


def write_video(frames: Iterable[np.ndarray], out: Path, fps: float) -> None:
    """Write frames (height, width, 3) uint8, `fps` of them per second, as `.mp4` (H.264), `.gif` or `.webp`."""
    if out.suffix != ".mp4":
        images = [Image.fromarray(frame) for frame in frames]
        ends = np.round(np.arange(len(images) + 1) * 100 / fps) * 10  # [ms], in the hundredths of a second of a gif
        options: dict[str, Any] = {"quality": _WEBP_QUALITY} if out.suffix == ".webp" else {}
        durations = np.diff(ends).astype(int).tolist()
        images[0].save(out, save_all=True, append_images=images[1:], duration=durations, loop=0, **options)
        return
    av = _import_av()
    with av.open(str(out), "w") as container:
        rate = Fraction(fps).limit_denominator(1000)
        stream = container.add_stream("libx264", rate=rate, options={"preset": "veryfast", "crf": "23"})
        stream.pix_fmt = "yuv420p"
        for index, frame in enumerate(frames):
            if index == 0:
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def _film(
    domain: Domain,
    policy: Any,
    space: StyleSpace,
    requests: Sequence[dict[str, Any]],
    period: int,
    size: tuple[int, int],
    seed: int,
    fps: float | None,
) -> Iterator[np.ndarray]:
    """Yield the pictures of `period` steps of each request, with a short caption where they are narrow.

    Without `fps` there is one picture of each request, of its last step, so that the agent has had time to comply.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StyleRangeWarning)  # the caption mentions clamped values
        thetas = [space.make(**request) for request in requests]
    env = domain.styled_env(space, 1, seed=seed, num_threads=1, **domain.coached)
    renderer = domain.make_renderer(size[0], size[1] - CAPTION)
    rollout, failures, steps = Rollout(env, seed), 0, itertools.count()
    window = max(1, round(domain.window / domain.control_step))
    short = size[0] < _NARROW
    rollout.begin(thetas[0][None])
    try:
        for request, theta in zip(requests, thetas, strict=True):
            style = space.describe(theta)
            asked = asked_line(space, request, style)
            recent: list[dict[str, Tensor]] = []
            for step in range(1, period + 1):
                transition = rollout.step(policy, theta[None])
                recent = [*recent, domain.measures.step(transition)][-window:]
                last = [1.0] if step == period else []
                shares = last if fps is None else _shares(next(steps), domain.control_step * fps)
                measured = ""
                if shares:
                    measured = measured_line(domain, space, style, _summary(domain, recent), failures, short)
                if isinstance(renderer, SceneRenderer):
                    pictures = renderer.draw_way(env, 0, style, shares)
                else:
                    pictures = [renderer.draw(env)] * len(shares) if shares else []
                yield from (caption(picture, (asked, measured)) for picture in pictures)
                if transition["next", "done"].any():
                    failures += int(transition["next", "terminated"].sum())
                    rollout.begin(theta[None])
                    recent = []
    finally:
        renderer.close()
        env.close()


def _shares(step: int, pictures: float) -> list[float]:
    """Return where in a step pictures are due, as shares of it in (0, 1], if there are `pictures` of them per step."""
    first, last = (math.floor(number * pictures + _ROUNDING) for number in (step, step + 1))
    return [min(1.0, number / pictures - step) for number in range(first + 1, last + 1)]


def asked_line(space: StyleSpace, request: Mapping[str, Any], style: Mapping[str, float | str]) -> str:
    """Return the requested style for a caption, with the requested value of numbers that were clamped.

    Args:
        space: The agent's style space.
        request: Requested values by parameter name, at least those that were clamped.
        style: The style in force, by parameter name.
    """
    parts = []
    for name, value in style.items():
        if isinstance(value, str):
            parts.append(f"{name} {value}")
            continue
        wanted = float(request.get(name, value))
        clamped = abs(wanted - value) > 1e-6 * max(abs(wanted), abs(value))
        if value or clamped or not isinstance(space[name], Weight):
            note = f" (clamped from {readable_number(wanted)})" if clamped else ""
            parts.append(f"{name} {readable_number(value, space[name].unit)}{note}")
    return readable(f"requested: {', '.join(parts) or 'every weight 0'}")


def _summary(domain: Domain, recent: Sequence[Mapping[str, Tensor]]) -> dict[str, float]:
    """Summarise the measures of the last steps of one environment."""
    record = {name: torch.stack([row[name] for row in recent]) for name in recent[0]}
    measured = domain.measures.summarise(record, torch.ones(len(recent), 1, dtype=torch.bool))
    return {name: value.item() for name, value in measured.items()}


def measured_line(
    domain: Domain,
    space: StyleSpace,
    style: Mapping[str, Any],
    measured: Mapping[str, float],
    failures: int = 0,
    short: bool = False,
) -> str:
    """Return for a caption what belongs to the request, then published quantities that have a unit.

    Args:
        domain: The domain.
        space: The agent's style space.
        style: The style in force, by parameter name.
        measured: Measured values by name; NaN is left out.
        failures: Number of terminated episodes.
        short: Whether the film is narrow, so that only the most important values fit.
    """
    known = {name: value for name, value in measured.items() if not math.isnan(value)}
    owned = measures_by_parameter(space, known, domain.beside)
    asked = [name for name in space.names if style[name] or not isinstance(space[name], Weight)]
    columns = [name.removeprefix("measured_") for name in domain.columns]
    ranked = [*(m for name in asked for m in owned[name] if not m.endswith("_error"))]
    ranked += [name for name in columns if name in domain.units] or ([] if ranked else columns)
    names = [name for name in dict.fromkeys(ranked) if name in known] or list(known)
    fewest = max(_FEWEST, sum(bool(owned[name]) for name in asked))  # one of each that is asked for
    names = names[: min(fewest, _MOST) if short else _MOST]
    shown = ", ".join(f"{domain.words.name(name)} {measured_text(domain, space, name, known[name])}" for name in names)
    count = "" if not failures or short else f"; {failures} {'failure' if failures == 1 else 'failures'}"
    return f"measured: {shown or 'nothing yet'}{count}"


def caption(frame: np.ndarray, lines: tuple[str, str]) -> np.ndarray:
    """Add a line for the request and one for what was measured below a frame, each with the mark of its kind.

    Args:
        frame: Frame (height, width, 3) uint8.
        lines: The lines. Long lines are written smaller, so that they fit.

    Returns:
        Frame (height + `CAPTION`, width, 3) uint8.
    """
    image = Image.new("RGB", (frame.shape[1], CAPTION), DARK.panel)
    draw = ImageDraw.Draw(image)
    for line, middle, colour, mark in zip(lines, (13, 32), (DARK.requested, DARK.measured), _MARKS, strict=True):
        fonts = (ImageFont.load_default(size) for size in range(_LARGEST_FONT, _SMALLEST_FONT - 1, -1))
        font = next((f for f in fonts if draw.textlength(line, f) <= frame.shape[1] - 28), None)
        draw.polygon([(8 + x, middle + y) for x, y in mark], fill=colour)
        draw.text((22, middle), line, anchor="lm", font=font or ImageFont.load_default(_SMALLEST_FONT), fill=colour)
    return np.concatenate([frame, np.asarray(image)])


def tiled(frames: Sequence[np.ndarray], columns: int = 3) -> np.ndarray:
    """Arrange frames in one picture, in rows from left to right.

    Args:
        frames: Frames of one size (height, width, 3) uint8.
        columns: Frames per row.

    Returns:
        Picture (rows * height, columns * width, 3) uint8; unused places are black.
    """
    height, width = frames[0].shape[:2]
    columns = min(columns, len(frames))
    rows = -(-len(frames) // columns)
    sheet = np.zeros((rows * height, columns * width, 3), dtype=np.uint8)
    for index, frame in enumerate(frames):
        row, column = divmod(index, columns)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = frame
    return sheet


def _import_av() -> Any:
    try:
        import av
    except ImportError as error:
        raise ImportError(f"mp4 needs PyAV: {how_to_install('video')}, or choose a .gif or .png file") from error
    return av
