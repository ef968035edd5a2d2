import logging
import shutil
import subprocess

import pytest
import torch
import torch.nn.functional as F

from coachable.fast import native

kernels = native.load_kernels()
needs_compiler = pytest.mark.skipif(not kernels, reason="no C compiler")
DTYPES = {torch.bfloat16: {"rtol": 8e-3, "atol": 1e-3}, torch.float32: {"rtol": 1e-4, "atol": 1e-5}}


def slanted(tensor):
    """The same values one element behind an allocation's beginning, up to its end."""
    memory = torch.empty(tensor.numel() + 1, dtype=tensor.dtype)
    return memory[1:].view(tensor.shape).copy_(tensor)


def rounded(*shape, dtype=torch.bfloat16):
    return slanted(torch.randn(shape).to(dtype))


def normal(*shape):
    return rounded(*shape, dtype=torch.float32)


def ones(*shape):
    return slanted(torch.ones(shape))


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture
def fresh():
    native.load_kernels.cache_clear()
    yield
    native.load_kernels.cache_clear()


@needs_compiler
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("rows", [1, 3, 257])
@pytest.mark.parametrize("n", [1, 17, 63, 64, 200, 255, 512])
def test_layer_forward(n, rows, dtype):
    width, start, to = max(n // 2, 1), 3, n - max(n // 2, 1)
    z, skip = rounded(rows, n, dtype=dtype), rounded(rows, n + 3, dtype=dtype)
    bias, gamma, beta = (normal(n) for _ in range(3))
    out, mean, rstd, scratch = rounded(rows, n, dtype=dtype), ones(rows), ones(rows), ones(n)
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
@pytest.mark.parametrize(
    ("count", "rows"), [(5, None), (5, [4, 0, 4, 2]), (1, None), (3, [2]), (257, None), (257, [256, 0])]
)
@pytest.mark.parametrize("n", [1, 17, 63, 200, 255, 512])
def test_layer_backward(n, count, rows, dtype):
    z = rounded(count, n, dtype=dtype)
    bias, gamma, beta = (normal(n) for _ in range(3))
    index = None if rows is None else slanted(torch.tensor(rows))
    chosen = z if index is None else z[index]
    grad = rounded(*chosen.shape, dtype=dtype)
    u = (chosen.float() + bias).requires_grad_()
    scale, shift = gamma.clone().requires_grad_(), beta.clone().requires_grad_()
    F.relu(F.layer_norm(u, (n,), scale, shift)).backward(grad.float())

    every = z.float() + bias
    mean, rstd = slanted(every.mean(-1)), slanted((every.var(-1, unbiased=False) + 1e-5).rsqrt())
    dz, scratch = rounded(*chosen.shape, dtype=dtype), ones(2 * n)
    dgamma, dbeta, dbias = (ones(n) for _ in range(3))
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
@pytest.mark.parametrize("rows", [1, 3, 257])
@pytest.mark.parametrize("n", [1, 17, 63, 255, 512])
def test_small_head(n, rows, dtype):
    x, weight, bias, grad = rounded(rows, n, dtype=dtype), normal(3, n), normal(3), normal(rows, 3)
    y, dx, dweight, dbias, scratch = ones(rows, 3), rounded(rows, n, dtype=dtype), ones(3, n), ones(3), ones(n)
    address, functions = [t.data_ptr() for t in (x, weight, bias)], kernels[dtype]
    functions.head_forward(*address, rows, n, 3, y.data_ptr())
    torch.testing.assert_close(y, F.linear(x.float(), weight, bias), rtol=1e-4, atol=1e-4)
    last = [t.data_ptr() for t in (dx, dweight, dbias, scratch)]
    for add in (1, 0):
        functions.head_backward(grad.data_ptr(), *address[:2], rows, n, 3, 1, add, *last)
        torch.testing.assert_close(dx.float(), grad @ weight, **DTYPES[dtype])
        torch.testing.assert_close(dweight, add + grad.t() @ x.float(), rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(dbias, add + grad.sum(0), rtol=1e-4, atol=1e-4)


@pytest.fixture(params=DTYPES)
def dtype(request):
    if not kernels or kernels[request.param].products is None:
        pytest.skip(f"no products of {request.param} in vector registers")
    return request.param


@pytest.fixture
def products(dtype):
    return kernels[dtype].products


TOLERANCES = {torch.bfloat16: {"rtol": 1e-2, "atol": 1e-2}, torch.float32: {"rtol": 1e-4, "atol": 1e-4}}


@pytest.mark.parametrize(
    ("rows", "inner", "n"),
    [(1, 2, 1), (7, 33, 70), (13, 109, 128), (64, 128, 200), (1, 1, 17), (3, 17, 255), (257, 255, 1)],
)
def test_product_of_the_forward_pass(rows, inner, n, products, dtype):
    stride = inner + inner % 2
    x, weight, z, out = (rounded(*shape, dtype=dtype) for shape in ((rows, stride), (n, inner), (rows, n), (rows, n)))
    x[:, inner:] = 0
    (bias, gamma, beta), (mean, rstd) = (normal(n) for _ in range(3)), (ones(rows) for _ in range(2))
    width, scratch = min(inner, n), ones(n)
    first = [t.data_ptr() for t in (weight, z, bias, gamma, beta, x)]
    last = [t.data_ptr() for t in (out, mean, rstd, scratch)]
    products.dense_forward(inner, *first, stride, 0, 0, width, 1e-5, rows, n, *last)
    torch.testing.assert_close(z.float(), x[:, :inner].float() @ weight.float().t(), **TOLERANCES[dtype])
    expected = F.relu(F.layer_norm(z.float() + bias, (n,), gamma, beta))
    expected[:, :width] += x[:, :width].float()
    torch.testing.assert_close(out.float(), expected, **TOLERANCES[dtype])


def test_denormal_numbers_count_as_zero(products, dtype):
    """They take some processors over a hundred times as long as others."""
    x, weight, grad = rounded(8, 64, dtype=dtype), normal(40, 64), slanted(torch.full((8, 40), 1e-39))
    dx, dweight, dbias = rounded(8, 64, dtype=dtype), normal(40, 64), normal(40)
    last = [t.data_ptr() for t in (dx, dweight, dbias)]
    products.wide_head_backward(*[t.data_ptr() for t in (grad, x, weight)], 8, 64, 40, 1, 0, *last)
    assert not any(t.any() for t in (dx, dweight, dbias))
    assert (torch.tensor(1e-39) + 0) > 0, "the processor's mode is as before"


def test_products_leave_the_tiles_to_torch(products, dtype):
    """Where the processor has tiles, torch's products configure them too, some only once per thread."""
    rows, inner, n = 64, 128, 96
    dz, x, grad = rounded(rows, n, dtype=dtype), rounded(rows, inner, dtype=dtype), normal(n, inner)
    expected = dz.float().t() @ x.float()
    before = torch.mm(dz.t(), x)
    products.weight_gradient(dz.data_ptr(), n, x.data_ptr(), inner, inner, rows, 0, grad.data_ptr())
    torch.testing.assert_close(grad, expected, rtol=1e-4, atol=1e-3)
    assert torch.equal(torch.mm(dz.t(), x), before)


@pytest.mark.parametrize(
    ("rows", "inner", "n", "to"),
    [(1, 2, 1, 0), (7, 64, 71, 0), (13, 128, 109, 19), (64, 200, 128, 72), (3, 18, 17, 1), (257, 2, 255, 0)],
)
def test_products_of_the_backward_pass(rows, inner, n, to, products, dtype):
    """Gradient of some columns of the input, and of the weight."""
    shapes = (rows, inner), (inner, n), (rows, inner), (rows, n)
    dz, weight, grad, x = (rounded(*shape, dtype=dtype) for shape in shapes)
    width = min(inner - to, n)
    skip = F.pad(grad[:, to : to + width].float(), (0, n - width))
    expected = dz.float() @ weight.float() + skip
    for start in (0, n // 3):
        below = rounded(rows, n - start, dtype=dtype)
        place = weight[:, start:].data_ptr(), n, n - start, grad.data_ptr(), -start, to, width, below.data_ptr()
        products.dense_backward(dz.data_ptr(), rows, inner, *place)
        torch.testing.assert_close(below.float(), expected[:, start:], **TOLERANCES[dtype])
    into = ones(inner, n)
    for add in (1, 0):
        products.weight_gradient(dz.data_ptr(), inner, x.data_ptr(), n, n, rows, add, into.data_ptr())
        torch.testing.assert_close(into, add + dz.float().t() @ x.float(), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("rows", "n", "outputs"),
    [(1, 1, 5), (7, 70, 13), (33, 512, 42), (13, 128, 255), (3, 17, 17), (257, 255, 5), (257, 1, 255)],
)
def test_head_of_many_outputs(rows, n, outputs, products, dtype):
    x, weight, bias, grad = rounded(rows, n, dtype=dtype), normal(outputs, n), normal(outputs), normal(rows, outputs)
    y, dx, dweight, dbias = ones(rows, outputs), rounded(rows, n, dtype=dtype), ones(outputs, n), ones(outputs)
    address, last = [t.data_ptr() for t in (x, weight, bias)], [t.data_ptr() for t in (dx, dweight, dbias)]
    products.wide_head_forward(*address, rows, n, outputs, y.data_ptr())
    torch.testing.assert_close(y, F.linear(x.float(), weight, bias), rtol=1e-4, atol=1e-4)
    for trained, add in ((0, 0), (1, 1), (1, 0)):
        products.wide_head_backward(grad.data_ptr(), *address[:2], rows, n, outputs, trained, add, *last)
        torch.testing.assert_close(dx.float(), grad @ weight, **DTYPES[dtype])
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


@pytest.mark.parametrize("script", ["printf '\\374' >&2; exit 1", "{cc} -shared -o $out -x c /dev/null"])
@needs_compiler
def test_a_compiler_that_is_none_is_reported_and_survived(script, fresh, monkeypatch, tmp_path, caplog):
    """One that prints what is no text, and one whose library has none of the functions."""
    compiler = tmp_path / "cc"
    take_out = 'while [ "$1" != -o ]; do shift; done; out=$2\n'
    compiler.write_text(f"#!/bin/sh\n{take_out}{script.format(cc=shutil.which('cc') or shutil.which('gcc'))}\n")
    compiler.chmod(0o700)
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with caplog.at_level(logging.WARNING):
        assert native.load_kernels() == {}
    assert "updates run without" in caplog.text


def cached(folder):
    return sorted(folder.glob("coachable/kernels-*.so"))


@pytest.fixture
def builds(fresh, monkeypatch, tmp_path):
    """A small library in place of the kernels, a cache in `tmp_path`, and a list of what was built and loaded."""
    small = tmp_path / "small.c"
    small.write_text("int answer(void) { return 42; }")
    built = []
    build = native._build

    def record(compiler, library):
        built.append(library)
        return build(compiler, library)

    monkeypatch.setattr(native, "_SOURCE", small)
    monkeypatch.setattr(native, "_FLAGS", ("-shared", "-fPIC"))
    monkeypatch.setattr(native, "_build", record)
    monkeypatch.setattr(native, "_bind", lambda library: {torch.float32: library.answer()})
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("COACHABLE_NATIVE", raising=False)

    def load():
        native.load_kernels.cache_clear()
        return native.load_kernels()[torch.float32]

    return built, load


PLANTED = "int answer(void) { return 666; }"


def plant(library):
    """Another library under the name of ours."""
    source = library.with_suffix(".c")
    source.write_text(PLANTED)
    library.unlink(missing_ok=True)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)


@needs_compiler
def test_libraries_are_kept_where_only_the_user_can_write(builds, tmp_path):
    built, load = builds
    assert load() == 42 and load() == 42
    assert len(built) == 1
    (library,) = cached(tmp_path)
    assert library.parent.stat().st_mode & 0o777 == 0o700
    assert library.stat().st_mode & 0o077 == 0


@needs_compiler
@pytest.mark.parametrize("weakness", ["folder for all", "folder for the group", "folder of another", "link"])
def test_a_cache_that_others_can_write_to_is_left_alone(weakness, builds, tmp_path, monkeypatch, caplog):
    built, load = builds
    assert load() == 42
    (library,) = cached(tmp_path)
    plant(library)
    folder = library.parent
    if weakness == "link":
        folder.rename(tmp_path / "theirs")
        folder.symlink_to(tmp_path / "theirs")
    elif weakness == "folder of another":
        monkeypatch.setattr(native.os, "geteuid", lambda: folder.stat().st_uid + 1)
    else:
        folder.chmod(0o777 if weakness == "folder for all" else 0o770)
    assert load() == 42
    assert len(built) == 2
    assert built[1].parent.parent != folder and not built[1].exists()
    assert f"{folder} belongs to somebody else or others can write to it" in caplog.text


@needs_compiler
@pytest.mark.parametrize("weakness", ["writable", "link"])
def test_a_library_that_others_can_write_to_is_built_again(weakness, builds, tmp_path):
    built, load = builds
    assert load() == 42
    (library,) = cached(tmp_path)
    plant(library)
    if weakness == "link":
        library.rename(tmp_path / "planted.so")
        library.symlink_to(tmp_path / "planted.so")
    else:
        library.chmod(0o777)
    assert load() == 42
    assert len(built) == 2
    assert library.stat().st_mode & 0o077 == 0 and not library.is_symlink()


@needs_compiler
def test_without_a_cache_the_kernels_are_built_elsewhere(builds, tmp_path, monkeypatch):
    built, load = builds
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert load() == 42
    assert not built[0].parent.exists()


def test_kernels_can_be_switched_off(fresh, monkeypatch):
    monkeypatch.setenv("COACHABLE_NATIVE", "0")
    assert native.load_kernels() == {}
