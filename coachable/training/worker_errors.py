"""Errors of worker processes; TorchRL reports only their exit status to the training process."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any

from torchrl.collectors import Collector

_LENGTH = 1000  # characters of a message, short enough that messages of workers do not mix
_ANSWER = 0.5  # [s] after which a worker that has not taken new weights may have ended
_GRACE = 3.0  # [s] between a worker's message and its end, longer than the workers need to take new weights


class WorkerError(RuntimeError):
    """A worker process ended with an error of the environment or the policy."""


@dataclass(eq=False)
class ReportingCollector:
    """Constructor of a worker's collector, which sends the error that ends a rollout to the training process.

    Args:
        sender: End of the pipe to which all workers send.
        prepare: Called with the collector before its first rollout.
    """

    sender: Connection
    prepare: Callable[[Collector], None]

    def __call__(self, *args: Any, **options: Any) -> Collector:
        """Make a collector whose errors are sent; arguments are those of `Collector`."""
        collector = Collector(*args, **options)
        self.prepare(collector)
        rollout = collector.rollout

        def reporting() -> Any:
            try:
                return rollout()
            except Exception as error:
                self.sender.send(f"{type(error).__name__}: {error}"[:_LENGTH])
                time.sleep(_GRACE)
                raise  # ends the process, which prints the traceback

        collector.rollout = reporting
        return collector


def check_workers(collector: Any) -> None:
    """Raise the error with which a worker process of a collector from `make_collector` ends, if there is one.

    Raises:
        WorkerError: If a worker sent an error or ended without one.
    """
    receiver = vars(collector).get("worker_errors")  # TorchRL would ask the workers for an attribute that is missing
    if receiver is None:
        return
    if receiver.poll():
        raise WorkerError(f"a worker process raised {receiver.recv().rstrip('.')}.")
    for process in collector.procs:
        if not process._closed and not process.is_alive():
            raise WorkerError(f"a worker process ended with exit status {process.exitcode}.")


def update_workers(collector: Any) -> None:
    """Send the policy's weights to all workers.

    TorchRL waits forever for the answer of a worker that has ended, and therefore waits in a thread of its own here.

    Raises:
        WorkerError: If a worker sent an error or ended without one, also while the weights were being sent.
    """
    check_workers(collector)
    failures: list[Exception] = []

    def send() -> None:
        try:
            collector.update_policy_weights_()
        except Exception as error:
            failures.append(error)

    sending = Thread(target=send, daemon=True)
    sending.start()
    while sending.is_alive():
        sending.join(_ANSWER)
        if sending.is_alive():
            check_workers(collector)
    if failures:
        raise failures[0]


@contextmanager
def worker_errors(collector: Any) -> Iterator[None]:
    """Replace an error that follows from the end of a worker process by the error with which that process ended.

    Raises:
        WorkerError: If a worker sent an error or ended without one.
    """
    try:
        yield
    except WorkerError:
        raise
    except Exception:
        check_workers(collector)
        raise
