"""Training in stages, each of which starts from the actor and critics of the stage before, in one run folder."""

import gc
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from coachable.training.checkpoint import CheckpointError, CheckpointStore, check_unused, find_checkpoint, read_state
from coachable.training.hardware import share_threads
from coachable.training.trainer import Trainer

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


class Curriculum:
    """Training that runs one stage after the other.

    Stage i of the run is a run of its own in `stages/i_NAME`, with an empty replay buffer and new optimisers. Its
    checkpoints hold the settings of all stages, so that the run can be resumed in any of them. The replay buffer of a
    finished stage is removed from its checkpoint, because the next stage does not need it.

    Args:
        config: `stages` is the list of the stages' complete configurations in plain containers, each with its name
            under `stage`. With `resume`, `config["stage"]` is the stage of that checkpoint.
        build: Builds the training of one stage from its configuration.
        announce: Is called with the configuration and the training of each stage before the stage runs.

    Raises:
        CheckpointError: If the stages are not such a list, or the run's folder contains another run.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        build: Callable[[dict[str, Any]], Trainer],
        announce: Callable[[dict[str, Any], Trainer], None] = lambda config, train: None,
    ) -> None:
        self.run_dir = Path(config["run_dir"])
        self.stages = _checked_stages(config["stages"])
        self._build = build
        self._announce = announce
        self._init_from = config["init_from"]
        resume = config["resume"]
        if resume:
            self.number = self._number_of(config.get("stage"), resume)
            if _is_finished(resume, self.stages[self.number]) and self.number + 1 < len(self.stages):
                self.number, resume, self._init_from = self.number + 1, None, str(find_checkpoint(resume))
        else:
            check_unused(self.run_dir)
            self.number = 0
        for later in range(self.number + 1, len(self.stages)):
            check_unused(self.folder(later))
        finished = self.folder(self.number - 1).resolve() if self.number and self._init_from else None
        if finished is not None and Path(self._init_from).resolve().is_relative_to(finished):  # as at a stage's end
            CheckpointStore(finished / "checkpoints").remove_replay()
        # The rounding of sums depends on the learner's threads, so all stages and resumptions use the same. When a
        # later stage starts, this process itself would count as a busy core.
        free = asdict(share_threads(**self.stages[0]["threads"]))
        for stage in self.stages:
            stage["threads"] = {part: given or free[part] for part, given in stage["threads"].items()}
        self.train = self._start(resume)

    def run(self) -> dict[str, float]:
        """Run the remaining stages until the last one ends or a stop signal arrives.

        Returns:
            The latest value of every metric of the last stage that ran.

        Raises:
            CheckpointError: If a stage cannot start.
        """
        while True:
            latest = self.train.run()
            if self.train.stopped or self.number + 1 == len(self.stages):
                return latest
            if not _is_finished(str(self.folder(self.number)), self.stages[self.number]):
                raise CheckpointError(
                    f"the end of stage {self.stages[self.number]['stage']} was not saved, and the next stage starts "
                    f"from it. When there is space again, continue with resume={self.run_dir}"
                )
            finished = self.folder(self.number)
            CheckpointStore(finished / "checkpoints").remove_replay()
            self.number, self._init_from = self.number + 1, str(finished)
            # The next stage needs the memory of this one's replay buffer. When a SerialEnv is collected, TorchRL also
            # raises the number of threads, which must happen before the next stage sets it.
            del self.train
            gc.collect()
            try:
                self.train = self._start(None)
            except (ValueError, ImportError) as error:
                name = self.stages[self.number]["stage"]
                raise CheckpointError(f"stage {name} cannot start, those before it are kept: {error}") from error

    def folder(self, number: int) -> Path:
        """Return the folder of stage `number`, counted from 0; the folder's name counts from 1."""
        return self.run_dir / "stages" / f"{number + 1}_{self.stages[number]['stage']}"

    def _start(self, resume: str | None) -> Trainer:
        config = {
            **self.stages[self.number],
            "stages": self.stages,
            "run_dir": str(self.folder(self.number)),
            "resume": resume,
            "init_from": None if resume else self._init_from,
        }
        train = self._build(config)
        self._announce(config, train)
        return train

    def _number_of(self, name: Any, checkpoint: str) -> int:
        names = [stage["stage"] for stage in self.stages]
        if name not in names:
            raise CheckpointError(f"{checkpoint} names {name!r} as its stage: expected one of {', '.join(names)}")
        return names.index(name)


def _checked_stages(stages: Any) -> list[dict[str, Any]]:
    """Return copies of the stages, after checking their names, which become folders and may come from a checkpoint.

    Raises:
        CheckpointError: If a stage has no name of letters, digits, `_` and `-`, or names repeat.
    """
    if not isinstance(stages, list) or not all(isinstance(stage, dict) for stage in stages):
        raise CheckpointError("the configuration's stages are not usable: expected a list of settings")
    names = [stage.get("stage") for stage in stages]
    for name in names:
        if not isinstance(name, str) or not _NAME.fullmatch(name) or names.count(name) > 1:
            raise CheckpointError(
                f"a stage is called {name!r}: expected a name of letters, digits, _ and -, different for each stage"
            )
    return [dict(stage) for stage in stages]


def _is_finished(checkpoint: str, stage: Mapping[str, Any]) -> bool:
    loop = read_state(find_checkpoint(checkpoint)).get("loop")
    return isinstance(loop, dict) and int(loop.get("frames", 0)) >= stage["train"]["total_frames"]
