import pytest
import torch

from coachable.fast import fused, native
from coachable.fast.ensemble import make_plan
from coachable.fast.flat import FlatBuffers
from coachable.fast.passes import active_rows
from coachable.fast.workspace import Workspace
from coachable.networks.residual import ResidualMLP

SHAPES = {
    "equal": (70, (64, 64, 64)),
    "padded": (40, (96, 64, 32)),
    "narrowing": (200, (96, 64, 32)),
    "beginning": (40, (64, 80, 64)),
    "wide_head": (40, (64, 64)),
    "odd": (37, (63, 40)),
}
KERNELS = bool(native.load_kernels())


@pytest.fixture(params=[False, pytest.param(True, marks=pytest.mark.skipif(not KERNELS, reason="no cc"))])
def compiled(request, monkeypatch):
    """Whether the passes use the compiled kernels."""
    if not request.param:
        monkeypatch.setattr(fused, "load_kernels", dict)
    return request.param


def build(kind, members, low=None, trained=True):
    """Networks, their stacked parameters by name, buffers and plan."""
    in_features, widths = SHAPES[kind]
    torch.manual_seed(0)
    out = 12 if kind == "wide_head" else 3
    nets = [ResidualMLP(in_features, out, widths) for _ in range(max(members, 1))]
    for net in nets:
        for p in net.parameters():  # generic values also for biases and layer norms
            torch.nn.init.normal_(p, std=0.3) if p.ndim == 1 else None
    names = [name for name, _ in nets[0].named_parameters()]
    columns = zip(*(net.parameters() for net in nets), strict=True)
    tensors = [torch.stack([p.detach() for p in c]) if members else c[0].detach() for c in columns]
    buffers = FlatBuffers(tensors, low, trained)
    buffers.refresh()
    grads = buffers.grads or [None] * len(tensors)
    triples = dict(zip(names, zip(buffers.tensors, buffers.low, grads, strict=True), strict=True))
    return nets, buffers, make_plan(nets[0], "", triples, members, trained)


def plan_of(in_features, width, low, passes_of_torch):
    """Buffers and plan of an ensemble of two whose parameters all lie off the alignment."""
    torch.manual_seed(0)
    network = ResidualMLP(in_features, 3, (width, width, width + 1))
    tensors = {}
    for name, parameter in network.named_parameters():
        memory = torch.empty(2 * parameter.numel() + 1)
        tensors[name] = memory[1:].view(2, *parameter.shape).normal_(std=0.3)
    buffers = FlatBuffers(list(tensors.values()), low, True)
    buffers.refresh()
    triples = dict(zip(tensors, zip(buffers.tensors, buffers.low, buffers.grads, strict=True), strict=True))
    plan = make_plan(network, "", triples, 2, True)
    if passes_of_torch:
        plan._kernel_threads = 0
    return buffers, plan


def inputs_of(kind, rows=40, **options):
    width = SHAPES[kind][0]
    return [torch.randn(rows, width - 7), torch.randn(rows, 7, **options)]


@pytest.mark.parametrize("members", [0, 2])
@pytest.mark.parametrize("kind", SHAPES)
def test_forward_and_all_gradients_equal_autograd(kind, members, compiled):
    nets, buffers, plan = build(kind, members)
    x, y = inputs_of(kind, requires_grad=True)
    y_reference = y.detach().clone().requires_grad_()
    out = fused.residual_network(plan, [x, y])
    stacked = torch.stack([net(torch.cat((x, y_reference), -1)) for net in nets])
    expected = stacked if members else stacked[0]
    torch.testing.assert_close(out, expected)
    weights = torch.randn_like(expected)
    (out * weights).sum().backward()
    (expected * weights).sum().backward()
    torch.testing.assert_close(y.grad, y_reference.grad, rtol=1e-4, atol=1e-5)
    references = zip(*(net.parameters() for net in nets), strict=True)
    for got, parts in zip(buffers.grads, references, strict=True):
        want = torch.stack([p.grad for p in parts]) if members else parts[0].grad
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("members", [0, 2])
@pytest.mark.parametrize("kind", SHAPES)
def test_bfloat16_is_close_to_float32(kind, members, compiled):
    _, exact, plan = build(kind, members)
    _, rounded, low_plan = build(kind, members, torch.bfloat16)
    assert isinstance(low_plan.acquire([1], 4, False), Workspace) is compiled
    x, y = inputs_of(kind, requires_grad=True)
    z = y.detach().clone().requires_grad_()
    out, low = fused.residual_network(plan, [x, y]), fused.residual_network(low_plan, [x, z])
    assert torch.cosine_similarity(out.flatten(), low.flatten().float(), dim=0) > 0.999
    weights = torch.randn_like(out)
    (out * weights).sum().backward()
    (low * weights.to(low.dtype)).sum().backward()
    for got, want in [(z.grad, y.grad), *zip(rounded.grads, exact.grads, strict=True)]:
        assert torch.cosine_similarity(got.flatten(), want.flatten(), dim=0) > 0.985  # masks of rectifiers flip


@pytest.mark.parametrize("kind", SHAPES)
def test_products_of_torch_and_of_our_own_agree(kind, monkeypatch):
    """With two threads the products are torch's."""
    torch.set_num_threads(1)
    results = []
    for threads in (1, 2):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        _, buffers, plan = build(kind, 2, torch.bfloat16)
        torch.manual_seed(1)
        x, y = inputs_of(kind, requires_grad=True)
        fused.residual_network(plan, [x, y]).float().square().sum().backward()
        results.append([y.grad, *buffers.grads])
    for got, want in zip(*results, strict=True):
        assert torch.cosine_similarity(got.flatten(), want.flatten(), dim=0) > 0.99


@pytest.mark.skipif(not KERNELS, reason="no cc")
@pytest.mark.parametrize("low", [None, torch.bfloat16])
@pytest.mark.parametrize("rows", [1, 3, 257])
@pytest.mark.parametrize(("in_features", "width"), [(2, 1), (17, 17), (255, 17), (18, 255)])
def test_odd_sizes_give_what_torch_gives(in_features, width, rows, low):
    results = []
    for passes_of_torch in (True, False):
        buffers, plan = plan_of(in_features, width, low, passes_of_torch)
        torch.manual_seed(1)
        x, y = torch.randn(rows, in_features - 1), torch.randn(rows, 1, requires_grad=True)
        out = fused.residual_network(plan, [x, y])
        (out * torch.randn_like(out)).sum().backward()
        results.append([out, y.grad, *buffers.grads])
    tolerance = 1e-4 if low is None else 0.2  # masks of rectifiers flip
    for want, got in zip(*results, strict=True):
        assert (got - want).norm() <= tolerance * (want.norm() + 1.0)


@pytest.mark.parametrize("low", [None, torch.bfloat16])
def test_second_backward_pass_adds(low):
    _, buffers, plan = build("equal", 2, low)
    inputs = inputs_of("equal")
    one, two = (fused.residual_network(plan, inputs) for _ in range(2))
    one.sum().backward()
    single = buffers.grad.clone()
    two.sum().backward()
    torch.testing.assert_close(buffers.grad, 2 * single)
    plan.begin()
    fused.residual_network(plan, inputs).sum().backward()
    torch.testing.assert_close(buffers.grad, single)


def test_gradients_are_zero_without_a_backward_pass():
    _, buffers, plan = build("equal", 0)
    fused.residual_network(plan, inputs_of("equal")).sum().backward()
    plan.begin()
    plan.finish()
    assert not buffers.grad.any()


@pytest.mark.parametrize("low", [None, torch.bfloat16])
def test_frozen_critics_pass_the_gradient_of_the_smaller_one(low):
    """The backward pass only works on the rows with a gradient; the result is that of all rows."""
    nets, _, plan = build("equal", 2, low, trained=False)
    x, action = inputs_of("equal", 256, requires_grad=True)
    reference = action.detach().clone().requires_grad_()
    out = fused.residual_network(plan, [x, action])
    smaller = out.min(0)
    smaller.values.sum().backward()
    expected = torch.stack([net(torch.cat((x, reference), -1)) for net in nets])
    expected.gather(0, smaller.indices[None]).sum().backward()  # rounding may swap near ties
    if low is None:
        torch.testing.assert_close(action.grad, reference.grad, rtol=1e-4, atol=1e-5)
    assert torch.cosine_similarity(action.grad.flatten(), reference.grad.flatten(), dim=0) > 0.999


def test_rows_without_gradient_are_found():
    grad = torch.zeros(100, 2)
    grad[[3, 50, 51], [0, 1, 0]] = 1.0
    assert active_rows(grad, 1).tolist() == [3, 50, 51]
    rows = active_rows(grad, 0)
    assert len(rows) == 32
    assert {3, 50, 51} <= set(rows.tolist())
    assert len(set(rows.tolist())) == 32
    assert active_rows(torch.ones(100, 2), 0) is None
    assert len(active_rows(torch.zeros(100, 2), 0)) == 0


def test_nothing_is_kept_without_gradients():
    _, _, plan = build("equal", 2)
    with torch.no_grad():
        assert not fused.residual_network(plan, inputs_of("equal")).requires_grad
    _, _, frozen = build("equal", 2, trained=False)
    assert not fused.residual_network(frozen, inputs_of("equal")).requires_grad


def test_leading_dimensions():
    nets, _, plan = build("equal", 2)
    x = torch.randn(4, 5, 70)
    torch.testing.assert_close(fused.residual_network(plan, [x]), torch.stack([net(x) for net in nets]))


@pytest.mark.parametrize("low", [None, torch.bfloat16])
def test_not_a_number_shows(low):
    """Either in the output or, where a rectifier hides it, in the gradients."""
    _, buffers, plan = build("equal", 0, low)
    x, y = inputs_of("equal")
    x[3, 2] = float("nan")
    out = fused.residual_network(plan, [x, y])
    assert out[3].isnan().all()
    assert not out[:3].isnan().any()
    plan.members[0].parameters[0][0, 0] = float("nan")
    buffers.refresh()
    x[3, 2] = 0.0
    fused.residual_network(plan, [x, y]).sum().backward()
    assert buffers.grad.isnan().any()


@pytest.mark.skipif(not KERNELS, reason="no cc")
def test_memory_is_kept_for_a_few_batch_sizes_only():
    _, _, plan = build("equal", 2)
    for rows in range(1, 10):
        fused.residual_network(plan, inputs_of("equal", rows)).sum().backward()
    assert len(plan._spaces) == fused._SIZES
    assert all(len(free) == 1 for free in plan._spaces.values())
    (first,) = plan._spaces[1, 9, True, 63, 7]
    out = fused.residual_network(plan, inputs_of("equal", 9))
    assert plan._spaces[1, 9, True, 63, 7] == []
    out.sum().backward()
    assert plan._spaces[1, 9, True, 63, 7] == [first]
