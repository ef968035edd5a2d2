"""Everything that a worker imports, for a process that forks workers: they share the memory of what is loaded here."""

import gc

import coachable.cluster.worker  # noqa: F401
from coachable.code_version import code_version

code_version()  # of the source that is loaded here, even if the files change later
gc.collect()
gc.freeze()  # otherwise the garbage collector would write to the shared pages, which would then be copied
