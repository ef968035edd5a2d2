"""Several threads share an update: the same numbers as with one, and torch's own threads rest meanwhile."""

import threading

import pytest
import torch

from coachable.fast import fused, native
from coachable.fast.crew import crew, crew_size, share_out
from coachable.fast.native import KERNEL_THREADS
from tests.fast.test_fused import SHAPES, build, inputs_of
from tests.sac_problem import cat_rac, make_batch, make_learner, make_loss, qr_sac

pytestmark = pytest.mark.skipif(not native.load_kernels(), reason="no cc")


@pytest.fixture
def two_threads():
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(1)


@pytest.mark.parametrize("low", [None, torch.bfloat16])
@pytest.mark.parametrize("members", [0, 1, 2, 3])
@pytest.mark.parametrize("kind", SHAPES)
def test_passes_give_the_same_numbers(kind, members, low, two_threads):
    results = []
    for largest in (1, 2):
        _, buffers, plan = build(kind, members, low)
        torch.manual_seed(1)
        x, y = inputs_of(kind, 150, requires_grad=True)
        with crew(largest):
            assert crew_size() == largest
            for _ in range(2):  # the second backward pass adds
                out = fused.residual_network(plan, [x, y])
                out.float().square().mean().backward()
        results.append([out.detach().float(), y.grad, *buffers.grads])
    for got, want in zip(*results, strict=True):
        if low is None:
            torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-5)
        assert torch.cosine_similarity(got.flatten(), want.flatten(), dim=0) > 0.99


def test_frozen_critics_pass_the_gradient_of_the_smaller_one(two_threads):
    results = []
    for largest in (1, 2):
        _, _, plan = build("equal", 2, trained=False)
        torch.manual_seed(1)
        x, y = inputs_of("equal", 150, requires_grad=True)
        with crew(largest):
            fused.residual_network(plan, [x, y]).min(0).values.sum().backward()
        results.append(y.grad)
    torch.testing.assert_close(*results, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("loss", [make_loss, qr_sac, cat_rac])
def test_updates_end_where_those_of_one_thread_end(loss):
    ends = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        torch.manual_seed(0)
        learner = make_learner(loss(), True, precision="fp32")
        for seed in range(4):
            torch.manual_seed(seed)
            learner.update(make_batch(80, seed=seed))
        assert torch.get_num_threads() == threads
        ends.append(learner.state_dict())
    torch.set_num_threads(1)
    one, two = ends
    assert one["updates"] == two["updates"]
    for name, expected in one["loss_module"].items():
        if "network" in name:  # rounding may turn Adam's first steps, which are signs, around
            assert ((two["loss_module"][name] - expected).abs() > 2e-4).float().mean() < 0.01, name
    for name, state in one["optimizers"].items():
        for index, moments in state["state"].items():
            assert moments["step"] == two["optimizers"][name]["state"][index]["step"] == 4


def test_calls_run_side_by_side(two_threads):
    both = threading.Barrier(2, timeout=20)
    with crew(4):
        share_out([both.wait, both.wait])  # one after the other would wait for ever
    ran = []
    share_out([lambda: ran.append(threading.current_thread())] * 3)
    assert set(ran) == {threading.current_thread()}


@pytest.mark.parametrize("place", [0, 1])
def test_an_error_on_any_thread_is_raised_and_ends_the_crew(place, two_threads):
    done = threading.Event()

    def fail():
        raise RuntimeError("kernel")

    calls = [done.set, done.set]
    calls[place] = fail
    with pytest.raises(RuntimeError, match="kernel"), crew(2):
        share_out(calls)
    assert done.is_set() and crew_size() == 1 and torch.get_num_threads() == 2


def test_torch_uses_one_thread_meanwhile(two_threads):
    seen = []
    with crew(2):
        share_out([lambda: seen.append(torch.get_num_threads())] * 2)
        with crew(2):  # inside another one: the same
            assert crew_size() == 2
        assert crew_size() == 2
    assert seen == [1, 1] and torch.get_num_threads() == 2
    with crew(1):
        assert crew_size() == 1 and torch.get_num_threads() == 2


@pytest.mark.parametrize("build, size", [(make_loss, KERNEL_THREADS), (cat_rac, 1)])
def test_beside_many_threads_only_direct_gradients_share_the_kernels(build, size):
    """The other losses use torch's operations then."""
    learner = make_learner(build(), True)
    if learner.backend._direct is None and size > 1:
        pytest.skip("no C compiler, or no vector instructions")
    before = torch.get_num_threads()
    torch.set_num_threads(2 * KERNEL_THREADS)
    try:
        with learner.backend.working():
            assert crew_size() == size
        learner.update(make_batch(256))
    finally:
        torch.set_num_threads(before)
