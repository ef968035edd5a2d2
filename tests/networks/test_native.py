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


@needs_compiler
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [63, 512])
def test_small_head(n, dtype):
    torch.manual_seed(0)
    x, weight, bias, grad = torch.randn(5, n).to(dtype), torch.randn(3, n), torch.randn(3), torch.randn(5, 3)
    y, dx, dweight, dbias, scratch = torch.empty(5, 3), torch.empty_like(x), *map(torch.ones, ((3, n), 3, n))
    address, functions = [t.data_ptr() for t in (x, weight, bias)], kernels[dtype]
    functions.head_forward(*address, 5, n, 3, y.data_ptr())
    torch.testing.assert_close(y, F.linear(x.float(), weight, bias), rtol=1e-4, atol=1e-4)
    last = [t.data_ptr() for t in (dx, dweight, dbias, scratch)]
    for add in (1, 0):
        functions.head_backward(grad.data_ptr(), *address[:2], 5, n, 3, 1, add, *last)
        torch.testing.assert_close(dx.float(), grad @ weight, **DTYPES[dtype])
        torch.testing.assert_close(dweight, add + grad.t() @ x.float(), rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(dbias, add + grad.sum(0), rtol=1e-4, atol=1e-4)


products = kernels[torch.bfloat16].products if kernels else None
needs_products = pytest.mark.skipif(products is None, reason="no bfloat16 products in vector registers")


def rounded(*shape):
    return torch.randn(shape).to(torch.bfloat16)


@needs_products
@pytest.mark.parametrize(("rows", "inner", "n"), [(1, 2, 1), (7, 33, 70), (13, 109, 128), (64, 128, 200)])
def test_product_of_the_forward_pass(rows, inner, n):
    torch.manual_seed(0)
    stride = inner + inner % 2
    x, weight, z, out = (
        torch.zeros(rows, stride).to(torch.bfloat16),
        rounded(n, inner),
        rounded(rows, n),
        rounded(rows, n),
    )
    x[:, :inner] = rounded(rows, inner)
    (bias, gamma, beta), (mean, rstd) = torch.randn(3, n), torch.empty(2, rows)
    width, scratch = min(inner, n), torch.empty(n)
    first = [t.data_ptr() for t in (weight, z, bias, gamma, beta, x)]
    last = [t.data_ptr() for t in (out, mean, rstd, scratch)]
    products.dense_forward(inner, *first, stride, 0, 0, width, 1e-5, rows, n, *last)
    torch.testing.assert_close(z.float(), x[:, :inner].float() @ weight.float().t(), rtol=1e-2, atol=1e-2)
    expected = F.relu(F.layer_norm(z.float() + bias, (n,), gamma, beta))
    expected[:, :width] += x[:, :width].float()
    torch.testing.assert_close(out.float(), expected, rtol=1e-2, atol=1e-2)


@needs_products
@pytest.mark.parametrize(
    ("rows", "inner", "n", "to"), [(1, 2, 1, 0), (7, 64, 71, 0), (13, 128, 109, 19), (64, 200, 128, 72)]
)
def test_products_of_the_backward_pass(rows, inner, n, to):
    """Gradient of some columns of the input, and of the weight."""
    torch.manual_seed(0)
    dz, weight, grad, x = rounded(rows, inner), rounded(inner, n), rounded(rows, inner), rounded(rows, n)
    width = min(inner - to, n)
    skip = F.pad(grad[:, to : to + width].float(), (0, n - width))
    expected = dz.float() @ weight.float() + skip
    for start in (0, n // 3):
        below = rounded(rows, n - start)
        place = weight[:, start:].data_ptr(), n, n - start, grad.data_ptr(), -start, to, width, below.data_ptr()
        products.dense_backward(dz.data_ptr(), rows, inner, *place)
        torch.testing.assert_close(below.float(), expected[:, start:], rtol=1e-2, atol=1e-2)
    into = torch.ones(inner, n)
    for add in (1, 0):
        products.weight_gradient(dz.data_ptr(), inner, x.data_ptr(), n, n, rows, add, into.data_ptr())
        torch.testing.assert_close(into, add + dz.float().t() @ x.float(), rtol=1e-3, atol=1e-3)


@needs_products
@pytest.mark.parametrize(("rows", "n", "outputs"), [(1, 1, 5), (7, 70, 13), (33, 512, 42), (13, 128, 255)])
def test_head_of_many_outputs(rows, n, outputs):
    torch.manual_seed(0)
    x, weight, bias, grad = (
        rounded(rows, n),
        torch.randn(outputs, n),
        torch.randn(outputs),
        torch.randn(rows, outputs),
    )
    y, dx, dweight, dbias = torch.empty(rows, outputs), torch.empty_like(x), torch.ones(outputs, n), torch.ones(outputs)
    address, last = [t.data_ptr() for t in (x, weight, bias)], [t.data_ptr() for t in (dx, dweight, dbias)]
    products.wide_head_forward(*address, rows, n, outputs, y.data_ptr())
    torch.testing.assert_close(y, F.linear(x.float(), weight, bias), rtol=1e-4, atol=1e-4)
    for trained, add in ((0, 0), (1, 1), (1, 0)):
        products.wide_head_backward(grad.data_ptr(), *address[:2], rows, n, outputs, trained, add, *last)
        torch.testing.assert_close(dx.float(), grad @ weight, **DTYPES[torch.bfloat16])
        before = add if trained else 1  # the ones from before
        torch.testing.assert_close(dweight, before + trained * grad.t() @ x.float(), rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(dbias, before + trained * grad.sum(0), rtol=1e-4, atol=1e-4)


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
