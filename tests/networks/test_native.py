import logging

import pytest
import torch
import torch.nn.functional as F

from coachable.networks import native

kernels = native.load_kernels()
needs_compiler = pytest.mark.skipif(not kernels, reason="no C compiler")
DTYPES = {torch.bfloat16: {"rtol": 8e-3, "atol": 1e-3}, torch.float32: {"rtol": 1e-4, "atol": 1e-5}}


@pytest.fixture
def fresh():
    native.load_kernels.cache_clear()
    yield
    native.load_kernels.cache_clear()


@needs_compiler
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 63, 64, 200, 512])
def test_layer_forward(n, dtype):
    torch.manual_seed(0)
    rows, width, start, to = 5, max(n // 2, 1), 3, n - max(n // 2, 1)
    z, skip = torch.randn(rows, n).to(dtype), torch.randn(rows, n + 3).to(dtype)
    bias, gamma, beta = torch.randn(3, n)
    out, mean, rstd, scratch = torch.empty_like(z), torch.empty(rows), torch.empty(rows), torch.empty(n)
    addresses = [t.data_ptr() for t in (z, bias, gamma, beta, skip)]
    kernels[dtype].layer_forward(
        *addresses, n + 3, start, to, width, 1e-5, rows, n, *[t.data_ptr() for t in (out, mean, rstd, scratch)]
    )
    u = z.float() + bias
    expected = F.relu(F.layer_norm(u, (n,), gamma, beta))
    expected[:, to : to + width] += skip[:, start : start + width].float()
    torch.testing.assert_close(out.float(), expected, **DTYPES[dtype])
    torch.testing.assert_close(mean, u.mean(-1))
    torch.testing.assert_close(rstd, (u.var(-1, unbiased=False) + 1e-5).rsqrt())


@needs_compiler
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("rows", [None, [4, 0, 4, 2]])
@pytest.mark.parametrize("n", [63, 200, 512])
def test_layer_backward(n, rows, dtype):
    torch.manual_seed(0)
    z = torch.randn(5, n).to(dtype)
    bias, gamma, beta = torch.randn(3, n)
    index = None if rows is None else torch.tensor(rows)
    chosen = z if index is None else z[index]
    grad = torch.randn_like(chosen)
    u = (chosen.float() + bias).requires_grad_()
    scale, shift = gamma.clone().requires_grad_(), beta.clone().requires_grad_()
    F.relu(F.layer_norm(u, (n,), scale, shift)).backward(grad.float())

    every = z.float() + bias
    mean, rstd = every.mean(-1), (every.var(-1, unbiased=False) + 1e-5).rsqrt()
    dz, dgamma, dbeta, dbias, scratch = torch.empty_like(chosen), *torch.ones(3, n), torch.empty(2 * n)
    first = [t.data_ptr() for t in (grad, z, bias, gamma, beta, mean, rstd)]
    last = [t.data_ptr() for t in (dz, dgamma, dbeta, dbias, scratch)]
    for trained, add in ((0, 0), (1, 1), (1, 0)):
        address = None if index is None else index.data_ptr()
        kernels[dtype].layer_backward(*first, address, len(chosen), trained, add, n, *last)
        torch.testing.assert_close(dz.float(), u.grad, **DTYPES[dtype])
        offset = 1.0 if add or not trained else 0.0  # the ones from before
        for got, want in ((dgamma, scale.grad), (dbeta, shift.grad), (dbias, u.grad.sum(0))):
            torch.testing.assert_close(got, offset + want if trained else torch.ones(n), rtol=1e-4, atol=1e-4)


def test_without_a_compiler_there_are_no_kernels(fresh, monkeypatch, caplog):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("COACHABLE_NATIVE", raising=False)
    with caplog.at_level(logging.INFO):
        assert native.load_kernels() == {}
    assert "no C compiler" in caplog.text


@needs_compiler
def test_a_failing_build_is_reported_and_survived(fresh, monkeypatch, tmp_path, caplog):
    broken = tmp_path / "broken.c"
    broken.write_text("this is not C")
    monkeypatch.setattr(native, "_SOURCE", broken)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with caplog.at_level(logging.WARNING):
        assert native.load_kernels() == {}
    assert "building broken.c" in caplog.text


def test_kernels_can_be_switched_off(fresh, monkeypatch):
    monkeypatch.setenv("COACHABLE_NATIVE", "0")
    assert native.load_kernels() == {}
