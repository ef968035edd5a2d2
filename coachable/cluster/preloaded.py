"""Everything that a worker imports, for a process that forks workers: they share the memory of what is loaded here."""

import gc

import coachable.cluster.worker  # noqa: F401
from coachable.code_version import code_version

code_version()  # of the source that has been loaded here, whatever becomes of the files
gc.collect()
gc.freeze()  # the collector of garbage would write to the shared pages, which copies them
