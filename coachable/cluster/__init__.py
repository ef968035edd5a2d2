"""Collection on Ray: workers on many machines that may die, one learner in the driver."""

from coachable.cluster.collector import ClusterCollector
from coachable.cluster.connection import ClusterError

__all__ = ["ClusterCollector", "ClusterError"]
