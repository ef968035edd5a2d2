"""`RolloutWorker` in a process of its own, which shares memory with the other workers of its group."""

import contextlib
import ctypes
import multiprocessing
import os
import pickle
import signal
import sys
from multiprocessing.connection import Connection
from multiprocessing.reduction import recv_handle, send_handle
from typing import Any

from coachable.cluster.worker import Batch, RolloutWorker, WorkerSettings

_PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>


class ProcessDiedError(Exception):
    """The process of a worker has ended."""


class ForkedWorker:
    """Process with a `RolloutWorker`, forked from one in which torch and TorchRL are loaded.

    Such a process starts in a fraction of a second and has only those pages of memory for itself to which it writes.
    Methods and their errors are those of `RolloutWorker`. All raise `ProcessDiedError` if the process has ended.
    """

    def __init__(self) -> None:
        context: Any = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["coachable.cluster.preloaded"])
        # The program of this process is Ray's; a child would import it although it does not need Ray.
        vars(sys.modules["__main__"]).pop("__file__", None)
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def start(self, task: bytes, settings: WorkerSettings) -> tuple[int, str]:
        """Make the environments and the collector; see `RolloutWorker.start`."""
        return self._call("start", task, settings)

    def load(self, version: int, file: int) -> None:
        """Load weights from the descriptor of a file; see `RolloutWorker.load`."""
        self._call("load", version, file=file)

    def collect(self, random: bool) -> Batch:
        """Collect a batch; see `RolloutWorker.collect`."""
        return self._call("collect", random)

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()

    def _call(self, method: str, *arguments: Any, file: int | None = None) -> Any:
        try:
            self._connection.send((method, arguments, file is not None))
            if file is not None:
                send_handle(self._connection, file, self._process.pid)
            answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise ProcessDiedError("its process died") from error
        if isinstance(answer, BaseException):
            raise answer
        return answer


def _serve(connection: Connection) -> None:
    """Answer the calls of `ForkedWorker` until it has gone."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # the process that forks ends with the actor
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the learner
    worker = RolloutWorker()
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            method, arguments, has_file = connection.recv()
            file = [recv_handle(connection)] if has_file else []
            try:
                answer = getattr(worker, method)(*arguments, *file)
            except Exception as error:
                answer = _portable(error)
            finally:
                for descriptor in file:
                    os.close(descriptor)
            connection.send(answer)


def _portable(error: Exception) -> Exception:
    """Return an error that the actor can unpickle, which may lack the modules and `__main__` of the environment."""
    with contextlib.suppress(Exception):
        if type(error).__module__.partition(".")[0] in ("builtins", "coachable"):
            pickle.loads(pickle.dumps(error))
            return error
    return RuntimeError(f"{type(error).__name__}: {error}")
