"""Everything that a worker imports, for a process that forks workers: they share the memory of what is loaded here."""

import gc

import coachable.cluster.worker  # noqa: F401

gc.collect()
gc.freeze()  # the collector of garbage would write to the shared pages, which copies them
