"""Ranges of numbers, and that the library's classes refuse what lies outside of them."""

import math
import warnings
from fractions import Fraction

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from coachable.envs.humanoid import HumanoidEnv
from coachable.envs.racing import RacingEnv
from coachable.losses import CatRACLoss, QRSACLoss, RACLoss
from coachable.networks import make_critic, make_gaussian_actor
from coachable.ranges import Range
from coachable.replay import EventTableBuffer, KeyEvents
from coachable.replay.n_step import NStep
from coachable.training import Learner
from coachable.training.checkpoint import CheckpointStore
from coachable.training.hardware import share_threads
from coachable.training.throttle import Throttle
from coachable.training.train_settings import TrainSettings
from coachable.transforms import MirrorSymmetry
from tests.sac_problem import make_loss


@pytest.mark.parametrize(
    "range_, inside, outside",
    [
        (Range("[0, 1]"), [0, 1, 0.5, np.float32(0.1), Fraction(1, 3)], [-1e-9, 1.001, math.nan, math.inf, "1", True]),
        (Range("(0, 1]"), [1e-300, 1.0], [0.0, -0.0, 2, None]),
        (Range("(0, 1)"), [0.5], [0, 1]),
        (Range("[1, inf)", whole=True), [1, 10**30, 1e6, np.int64(3)], [0, 1.5, math.inf, math.nan, None]),
        (Range("(0, inf)", optional=True), [None, 1e-9], [0, math.inf, math.nan]),
        (Range("(-inf, inf)"), [-1e300, 0], [math.inf, -math.inf, math.nan, None, "a"]),
    ],
)
def test_what_a_range_holds(range_, inside, outside):
    assert all(range_.holds(value) for value in inside)
    assert not any(range_.holds(value) for value in outside)


@pytest.mark.parametrize(
    "range_, words",
    [
        (Range("[0, 1]"), "a number in [0, 1]"),
        (Range("(0, inf)", optional=True), "a number above 0, or None"),
        (Range("[1, inf)", whole=True), "a whole number of at least 1"),
        (Range("(-inf, inf)"), "a number that is finite"),
    ],
)
def test_a_range_in_words(range_, words):
    assert str(range_) == words


def _quantile_loss(**options):
    actor, critics = make_gaussian_actor(3, 1, None, (8,)), [make_critic(3, 1, None, (8,), num_outputs=4)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no target updater, which nothing here needs
        return QRSACLoss(actor, critics, num_qvalue_nets=1, num_quantiles=4, **options)


def _gamma(gamma):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _quantile_loss().make_value_estimator(gamma=gamma)


def _loss(kind, **options):
    actor, critics = make_gaussian_actor(3, 1, None, (8,)), [make_critic(3, 1, None, (8,))]
    return kind(actor, critics, num_qvalue_nets=1, **options)


def _tables(**options):
    sizes = {"capacity": 10, "event_capacity": 10, "event_horizon": 2, "event_share": 0.5, "num_envs": 1}
    return EventTableBuffer.for_events(KeyEvents(["a"]), **{**sizes, **options})


OUTSIDE = [
    *(("TrainSettings", lambda **kw: TrainSettings(**{"total_frames": 9, **kw}), name, value) for name, value in [
        ("total_frames", 0), ("batch_size", 0), ("batch_size", 1.5), ("warmup_frames", -1), ("utd_ratio", -0.1),
        ("utd_ratio", math.inf), ("throttle", 0.0), ("anneal", 1.5), ("anneal", math.nan), ("anneal_entropy", 0.0),
        ("eval_interval", -1), ("log_interval", -1.0), ("checkpoint_interval", math.nan),
    ]),
    *(("Learner", lambda **kw: Learner(make_loss(width=8), **kw), name, value) for name, value in [
        ("actor_lr", -1e-4), ("critic_lr", math.inf), ("alpha_lr", math.nan), ("adam_eps", 0.0), ("tau", 0.0),
        ("tau", 2), ("max_grad_norm", 0.0), ("max_grad_norm", -1.0),
    ]),
    *(("QRSACLoss", _quantile_loss, name, value) for name, value in [
        ("alpha", -0.1), ("alpha", math.inf), ("kappa", -1.0), ("kappa", math.nan),
    ]),
    ("RACLoss", lambda **kw: _loss(RACLoss, **kw), "entropy_samples", 0),
    ("CatRACLoss", lambda **kw: _loss(CatRACLoss, **kw), "num_atoms", 1),
    ("CatRACLoss", lambda **kw: _loss(CatRACLoss, **kw), "v_min", 1e9),
    *(("gamma of a loss", _gamma, "gamma", value) for value in [
        1.5, -0.1, math.nan,
    ]),
    *(("NStep", lambda **kw: NStep(**{"n_steps": 3, "gamma": 0.9, **kw}), name, value) for name, value in [
        ("n_steps", 0), ("n_steps", 1.5), ("gamma", 1.5), ("gamma", -0.1), ("gamma", math.nan),
    ]),
    *(("EventTableBuffer", _tables, name, value) for name, value in [
        ("capacity", 0), ("event_capacity", 0), ("event_horizon", 0), ("event_share", 1.2), ("event_share", 0.0),
        ("event_share", math.nan), ("num_envs", 0), ("gamma", 1.5), ("priority_alpha", -1.0),
        ("priority_beta", math.nan),
    ]),
    *(("MirrorSymmetry", lambda **kw: MirrorSymmetry({}, **kw), "probability", value) for value in [1.1, math.nan]),
    ("HumanoidEnv", HumanoidEnv, "episode_steps", 0),
    ("RacingEnv", RacingEnv, "episode_steps", 0),
    ("CheckpointStore", lambda **kw: CheckpointStore("unused", **kw), "keep", 0),
    ("share_threads", share_threads, "simulator", 0),
    ("Throttle", Throttle, "rate", 0.0),
    ("make_critic", lambda **kw: make_critic(3, 1, None, **kw), "widths", (8, 0)),
]  # fmt: skip


@pytest.mark.parametrize("what, make, name, value", OUTSIDE, ids=[f"{o[0]}-{o[2]}-{o[3]}" for o in OUTSIDE])
def test_the_librarys_classes_refuse_it_too(what, make, name, value):
    with pytest.raises(ValueError, match=rf"{name}|table_capacities|env-steps per second"):
        make(**{name: value})


def test_a_discount_of_nothing_is_a_discount():
    """Zero is false: it used to be taken for one that was not given, and rewards were summed undiscounted."""
    buffer = EventTableBuffer({"default": 10}, n_steps=3, gamma=0.0, num_envs=1)
    reward = torch.ones(4, 1)
    done = torch.zeros(4, 1, dtype=torch.bool)
    buffer.extend(TensorDict({"next": {"reward": reward, "done": done}}, [4]))
    assert (buffer[:]["next", "reward"] == 1.0).all()
