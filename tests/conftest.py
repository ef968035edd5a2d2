"""Fixtures that several test folders share."""

import gc
import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

# Imported inside the fixtures: a test that needs none of this should not pay for it.

# Read when torch is imported. Sums are rounded as the number of threads says. TorchRL raises it, up to what it was at
# first, whenever a `SerialEnv` is closed, and one of an earlier test may be collected in the middle of a training.
os.environ.setdefault("OMP_NUM_THREADS", "1")

if os.environ.get("COACHABLE_SANITIZE") == "1":  # see CONTRIBUTING.md
    from coachable.fast import native

    native._FLAGS += ("-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", "-g")


gc.disable()  # until everything is imported


def pytest_collection_finish() -> None:
    """Spare the garbage collector what was imported, and racing environments the same speeds again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(7_000, 10, 10)  # a tenth as often: tests leave little behind
    gc.enable()
    for name in ("env", "race.driver"):
        module = sys.modules.get(f"coachable.envs.racing.{name}")
        if module is not None:
            module.speed_profiles = _remembering(module.speed_profiles)


def _remembering(speed_profiles: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that computes the speeds of each car on each line once."""
    known: dict[Any, Any] = {}

    def remember(envelope: Any, curvatures: Any, spacings: Any) -> Any:
        key = (repr(envelope), *(np.asarray(line).tobytes() for line in (*curvatures, *spacings)))
        if key not in known:
            known[key] = speed_profiles(envelope, curvatures, spacings)
        return [speeds.copy() for speeds in known[key]]

    return remember


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_the_disk() -> Iterator[None]:
    """What is flushed survives the end of a process; only a power cut, which no test causes, would undo it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture
def echo_space() -> Any:
    """One set-point: the action that is wanted."""
    from tests.echo import echo_space

    return echo_space()


@pytest.fixture
def make_echo_env() -> Callable[..., Any]:
    """Makes a `StyleEchoEnv` with its style transforms: `make_echo_env(seed, num_envs=4)`."""
    from tests.echo import make_echo_env

    return make_echo_env


@pytest.fixture(scope="session")
def short_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a short training without a recipe, of a domain that is not registered. Do not write to it."""
    from tests.echo import make_train

    folder = tmp_path_factory.mktemp("short") / "run"
    make_train(folder, total_frames=80).run()
    return folder


@pytest.fixture
def make_train(tmp_path: Path) -> Callable[..., Any]:
    """Makes a small training in `tmp_path / "run"` or a given folder: `make_train(total_frames=400, width=16)`."""
    from tests.echo import make_train

    def make(run_dir: Path = tmp_path / "run", **settings: Any) -> Any:
        return partial(make_train, run_dir)(**settings)

    return make
