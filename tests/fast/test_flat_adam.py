import copy

import pytest
import torch

from coachable.fast import flat_adam as adam
from coachable.fast.flat import FlatBuffers
from coachable.fast.flat_adam import FlatAdam
from coachable.fast.native import load_kernels

SHAPES = [(2, 70, 33), (1,), (5,), (90, 100), (17, 255)]
needs_compiler = pytest.mark.skipif(not load_kernels(), reason="no C compiler")


def parameters(seed):
    """Every other one lies off the alignment."""
    torch.manual_seed(seed)
    values = [torch.randn(shape) for shape in SHAPES]
    memory = [torch.empty(value.numel() + i % 2)[i % 2 :].view(value.shape) for i, value in enumerate(values)]
    return [torch.nn.Parameter(place.copy_(value)) for place, value in zip(memory, values, strict=True)]


def flat_adam(params, low=None, target=None, tau=0.1):
    flat = FlatBuffers(params[::-1], low, trained=True)  # the order may differ
    for parameter, grad in zip(params[::-1], flat.grads, strict=True):
        parameter.grad = grad
    return FlatAdam(params, flat, target, tau, lr=1e-2, eps=1e-7), flat


def fill(params, seed):
    torch.manual_seed(seed)
    for parameter in params:
        parameter.grad.copy_(torch.randn(parameter.shape))


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("low", [None, torch.bfloat16])
def test_steps_are_those_of_adam(low, compiled, monkeypatch):
    if not compiled:
        monkeypatch.setattr(adam, "load_kernels", dict)
    params, reference, target = parameters(0), parameters(0), parameters(1)[::-1]
    follows = FlatBuffers(target, low, trained=False)
    optimizer, flat = flat_adam(params, low, follows)
    theirs = torch.optim.Adam(reference, lr=1e-2, eps=1e-7)
    expected = [t.detach().clone() for t in target]
    for step in range(5):
        fill(params, step)
        for ours, other in zip(params, reference, strict=True):
            other.grad = ours.grad.clone()
        version = params[0]._version
        optimizer.step()
        theirs.step()
        assert params[0]._version > version  # autograd and other learners see the change
        torch._foreach_lerp_(expected, [p.detach() for p in reference[::-1]], 0.1)
    for got, want in ((params, reference), (target, expected)):
        torch.testing.assert_close([t.detach() for t in got], [t.detach() for t in want])
    for buffers in (flat, follows):
        rounded = [t.to(low) for t in buffers.tensors] if low else buffers.tensors
        torch.testing.assert_close(buffers.low, rounded, rtol=0, atol=0)
    for ours, other in zip(params, reference, strict=True):
        torch.testing.assert_close(optimizer.state[ours], theirs.state[other])


@needs_compiler
def test_everything_may_move_between_steps():
    """Parameters and moments that are shared with other processes go elsewhere, with everybody who uses them."""
    params, still = parameters(0), parameters(0)
    optimizer, _ = flat_adam(params, torch.bfloat16)
    reference, _ = flat_adam(still, torch.bfloat16)
    for step in range(3):
        for which in (params, still):
            fill(which, step)
        optimizer.step()
        reference.step()
        for parameter in params:
            state = optimizer.state[parameter]
            for tensor in (parameter.data, parameter.grad, *state.values()):
                tensor.share_memory_()
            state["exp_avg"] = state["exp_avg"].clone()
    for moved, expected in zip(params, still, strict=True):
        assert torch.equal(moved, expected)
        torch.testing.assert_close(optimizer.state[moved], reference.state[expected], rtol=0, atol=0)


def test_state_is_that_of_adam():
    """It moves to torch's class and back, and a restored optimiser goes on with the same bits."""
    params = parameters(0)
    optimizer, _ = flat_adam(params)
    fill(params, 0)
    optimizer.step()
    state = copy.deepcopy(optimizer.state_dict())
    plain = torch.optim.Adam(parameters(0), lr=1e-2, eps=1e-7, fused=True)
    plain.load_state_dict(state)
    again = [torch.nn.Parameter(p.detach().clone()) for p in params]
    restored, _ = flat_adam(again)
    restored.load_state_dict(plain.state_dict())
    for which in (params, again):
        fill(which, 1)
    optimizer.step()
    restored.step()
    for ours, other in zip(params, again, strict=True):
        assert torch.equal(ours, other)


@pytest.mark.parametrize("option", [{"weight_decay": 0.1}, {"maximize": True}, {"amsgrad": True}])
def test_other_options_of_adam_are_refused(option):
    optimizer, _ = flat_adam(parameters(0))
    optimizer.param_groups[0].update(option)
    with pytest.raises(ValueError, match=r"expected fast=off"):
        optimizer.step()
