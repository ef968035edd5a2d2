"""`coachable render`: film an agent whose style is switched while it acts, or several styles side by side."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from tqdm import tqdm

from coachable.domain import Domain
from coachable.evaluation.outputs import complete_file
from coachable.evaluation.rollouts import Rollout
from coachable.evaluation.wording import readable, readable_number
from coachable.extras import how_to_install
from coachable.styles import Choice, StyleRangeWarning, StyleSpace, Weight
from coachable.training.weights import domain_of, load_policy

VIDEO_SUFFIXES = (".mp4", ".gif", ".webp", ".png")
_IMAGE_FPS = 20  # of films that are not mp4
_WEBP_QUALITY = 50  # of 100
_MEASURES_IN_CAPTION, _MEASURES_IN_PANEL = 4, 2  # as many as fit
CAPTION = 44  # [px]
_SMALLEST_FONT = 8  # [px]
_SMALLEST = (64, CAPTION + 16)  # [px]
_LARGEST = 4096  # [px]
_LONGEST = 3600.0  # [s]


def render(
    source: str | Path,
    out: Path,
    *,
    styles: Sequence[dict[str, Any]] | None = None,
    seconds_per_style: float = 4.0,
    size: tuple[int, int] = (640, 480),
    seed: int = 0,
    together: bool = False,
    progress: bool = True,
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
        seed: Seed of the initial state and of sampled actions.
        together: Whether to show all styles at once, side by side in rows of three, instead of one after the other.
        progress: Whether to show a progress bar.

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
    if out.suffix == ".mp4":
        if size[0] % 2 or size[1] % 2:
            raise ValueError(f"the size is {size[0]}x{size[1]}: mp4 needs an even width and height")
        _import_av()
    agent = load_policy(source)
    domain = domain_of(agent)
    requests = default_tour(domain, agent.space) if styles is None else list(styles)
    period = max(1, round(seconds_per_style / domain.control_step))
    sheet = out.suffix == ".png"
    fps = round(1 / domain.control_step)
    # A sheet shows the last step of each style, so that the agent has had time to comply.
    every = period if sheet else 1 if out.suffix == ".mp4" else min(_stride(fps), period)

    def film(styles: Sequence[dict[str, Any]]) -> Iterator[np.ndarray]:
        panel = together and not sheet
        return _film(domain, agent.actor, agent.space, styles, period, size, seed, every=every, panel=panel)

    frames, total = film(requests), len(requests) * (period // every)
    if together and not sheet:
        panels = [film([request]) for request in requests]
        frames, total = (tiled(row) for row in zip(*panels, strict=True)), period // every
    bar = tqdm(frames, total=total, desc="drawing", unit="frame", disable=None if progress else True, leave=False)
    with complete_file(out) as unfinished:
        if sheet:
            Image.fromarray(tiled(list(bar))).save(unfinished)
        else:
            write_video(bar, unfinished, max(1, fps // every))
    return out


def default_tour(domain: Domain, space: StyleSpace) -> list[dict[str, Any]]:
    """Return every option of each choice with low, middle and high set-points, or the domain's grid for weights."""
    if any(isinstance(p, Weight) for p in space.parameters):
        return domain.cells()
    choices = [p for p in space.parameters if isinstance(p, Choice)]
    others = [p for p in space.parameters if not isinstance(p, Choice)]
    levels = [{p.name: p.low + level * (p.high - p.low) for p in others} for level in (0.0, 0.5, 1.0)]
    options = itertools.product(*(p.options for p in choices))
    return [
        dict(zip((p.name for p in choices), chosen, strict=True)) | values for chosen in options for values in levels
    ]


def write_video(frames: Iterable[np.ndarray], out: Path, fps: int) -> None:
    """Write frames (height, width, 3) uint8 as mp4 (H.264), gif or animated WebP.

    Args:
        frames: The frames.
        out: File to write, `.mp4`, `.gif` or `.webp`.
        fps: Frames per second; gif and WebP leave some out to have about 20.
    """
    if out.suffix != ".mp4":
        stride = _stride(fps)
        images = [Image.fromarray(frame) for frame in itertools.islice(frames, 0, None, stride)]
        options: dict[str, Any] = {"append_images": images[1:], "duration": 1000 * stride // fps, "loop": 0}
        options |= {"quality": _WEBP_QUALITY} if out.suffix == ".webp" else {}
        images[0].save(out, save_all=True, **options)
        return
    av = _import_av()
    with av.open(str(out), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"preset": "veryfast", "crf": "23"})
        stream.pix_fmt = "yuv420p"
        for index, frame in enumerate(frames):
            if index == 0:
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def _stride(fps: int) -> int:
    return max(1, fps // _IMAGE_FPS)


def _film(
    domain: Domain,
    policy: Any,
    space: StyleSpace,
    requests: Sequence[dict[str, Any]],
    period: int,
    size: tuple[int, int],
    seed: int,
    every: int,
    panel: bool = False,
) -> Iterator[np.ndarray]:
    """Yield every `every`-th frame of the `period` steps of each request, with a short caption for a panel."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StyleRangeWarning)  # the caption mentions clamped values
        thetas = [space.make(**request) for request in requests]
    env = domain.styled_env(space, 1, seed=seed, num_threads=1, **domain.coached)
    renderer = domain.make_renderer(size[0], size[1] - CAPTION)
    rollout, failures = Rollout(env, seed), 0
    rollout.begin(thetas[0][None])
    try:
        for request, theta in zip(requests, thetas, strict=True):
            asked = asked_line(space, request, theta)
            recent: list[dict[str, Tensor]] = []
            for step in range(1, period + 1):
                transition = rollout.step(policy, theta[None])
                recent.append(domain.measures.step(transition))
                if step % every == 0:
                    measured = _measured_line(domain, recent, failures, space.names if panel else ())
                    yield caption(renderer.draw(env), (asked, measured))
                if transition["next", "done"].any():
                    failures += int(transition["next", "terminated"].sum())
                    rollout.begin(theta[None])
    finally:
        renderer.close()
        env.close()


def asked_line(space: StyleSpace, request: Mapping[str, Any], theta: Tensor) -> str:
    """Return the requested style for a caption, with the requested value of numbers that were clamped.

    Args:
        space: The agent's style space.
        request: Values by parameter name; other parameters have their default.
        theta: The style (d,) that was made from the request.
    """
    parts = []
    for name, value in space.describe(theta).items():
        if isinstance(value, str):
            parts.append(f"{name} {value}")
            continue
        wanted = float(request.get(name, value))
        clamped = abs(wanted - value) > 1e-6 * max(abs(wanted), abs(value))
        if value or clamped or not isinstance(space[name], Weight):
            note = f" (clamped from {readable_number(wanted)})" if clamped else ""
            parts.append(f"{name} {readable_number(value)}{note}")
    return readable(f"asked: {', '.join(parts) or 'every weight 0'}")


def _measured_line(domain: Domain, recent: list[dict[str, Tensor]], failures: int, first: Sequence[str] = ()) -> str:
    """Return what was measured in the last two seconds; a short line if the names to begin with are given."""
    window = recent[-round(2.0 / domain.control_step) :]
    record = {name: torch.stack([row[name] for row in window]) for name in window[0]}
    measured = domain.measures.summarise(record, torch.ones(len(window), 1, dtype=torch.bool))
    wanted = [name.removeprefix("measured_") for name in domain.columns]
    published = {name: value for name, value in measured.items() if name in wanted} or measured
    names = [name for name, value in published.items() if not bool(value.isnan().any())]
    names = sorted(names, key=lambda name: name not in first)[: _MEASURES_IN_PANEL if first else _MEASURES_IN_CAPTION]
    shown = ", ".join(f"{name} {published[name].item():.2f}" for name in names)
    return f"last 2 s: {shown}{f'; failures {failures}' if failures or not first else ''}".replace("_", " ")


def caption(frame: np.ndarray, lines: tuple[str, str]) -> np.ndarray:
    """Add two lines of text below a frame.

    Args:
        frame: Frame (height, width, 3) uint8.
        lines: The lines; the first one is larger. Long lines are written smaller, so that they fit.

    Returns:
        Frame (height + `CAPTION`, width, 3) uint8.
    """
    image = Image.new("RGB", (frame.shape[1], CAPTION), (20, 20, 30))
    draw = ImageDraw.Draw(image)
    for line, top, largest, colour in zip(lines, (2, 24), (16, 12), ((255, 220, 120), (220, 220, 220)), strict=True):
        fonts = (ImageFont.load_default(size) for size in range(largest, _SMALLEST_FONT - 1, -1))
        font = next((f for f in fonts if draw.textlength(line, f) <= frame.shape[1] - 12), None)
        draw.text((8, top), line, font=font or ImageFont.load_default(_SMALLEST_FONT), fill=colour)
    return np.concatenate([frame, np.asarray(image)])


def tiled(frames: Sequence[np.ndarray], columns: int = 3) -> np.ndarray:
    """Return frames of one size (height, width, 3) uint8 as one picture, in rows of `columns`."""
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
