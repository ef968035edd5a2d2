"""Stratified replay with multi-tables and event tables (paper, Stratified Sampling)."""

from coachable.replay.event_tables import EventTableBuffer
from coachable.replay.n_step import NStep
from coachable.replay.routing import EventPredicate, KeyEvents, KeyRoute, PredicateEvents, Route, StyleEvents
from coachable.replay.stratified import StratifiedSampler
from coachable.replay.sum_tree import SumTree

__all__ = [
    "EventPredicate",
    "EventTableBuffer",
    "KeyEvents",
    "KeyRoute",
    "NStep",
    "PredicateEvents",
    "Route",
    "StratifiedSampler",
    "StyleEvents",
    "SumTree",
]
