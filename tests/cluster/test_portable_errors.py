"""Errors of forked workers, on their way to a process that does not have the environment's code."""

import pickle

import pytest

from coachable.cluster.forked_worker import _portable


class FileError(OSError):
    """Defined where the environment is."""


def test_an_error_of_the_environment_is_told_and_does_not_end_the_worker():
    class LevelError(Exception):  # as one of `__main__`: cloudpickle can send it, a connection cannot
        pass

    for error in (LevelError("no level"), FileError("no level")):
        sent = pickle.loads(pickle.dumps(_portable(error)))
        assert type(sent) is RuntimeError
        assert str(sent) == f"{type(error).__name__}: no level"
    with pytest.raises(ZeroDivisionError, match="no length"):
        raise pickle.loads(pickle.dumps(_portable(ZeroDivisionError("no length"))))
