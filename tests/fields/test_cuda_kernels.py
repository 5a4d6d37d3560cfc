"""The GPU's kernels, compiled by a C++ compiler and run one thread after the other, against plain torch in float64."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.fields import kernels
from pipeline.fields.encodings import HashEncoding
from pipeline.fields.geometry import GridSdf
from pipeline.maths import cuda_kernels, sdf, sh, tracing

SHIM = """
#include <algorithm>
#include <cmath>
#define __global__
#define __device__ static
using std::max;
using std::min;
struct Index { int x; };
static Index threadIdx{0}, blockIdx{0}, blockDim{1};
static float atomicAdd(float* place, float value) { return *place += value; }
extern "C" void begin(int thread, int block, int threads) {
    threadIdx.x = thread;
    blockIdx.x = block;
    blockDim.x = threads;
}
#include "%s"
"""
COMPILER = shutil.which("c++")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    if COMPILER is None:
        pytest.skip("no C++ compiler: the GPU's kernels can't be compiled for this processor")
    folder = tmp_path_factory.mktemp("cuda")
    (folder / "shim.cpp").write_text(SHIM % cuda_kernels.SOURCE)
    command = [
        COMPILER,
        "-O1",
        "-std=c++17",
        "-Wall",
        "-Werror",
        "-shared",
        "-fPIC",
        "-o",
        str(folder / "lib.so"),
        str(folder / "shim.cpp"),
    ]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return ctypes.CDLL(str(folder / "lib.so"))


def plain(value: Tensor | int | float) -> object:
    if isinstance(value, Tensor):
        assert value.is_contiguous()
        return ctypes.c_void_p(value.data_ptr())
    return ctypes.c_int(value) if isinstance(value, int) else ctypes.c_double(value)


@pytest.fixture
def gpu(library: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Tensors on the CPU go through the GPU's kernels; the names of those that ran."""
    ran: list[str] = []

    def launch(name: str, count: int, *arguments: Tensor | int | float) -> None:
        ran.append(name)
        grid = -(-count // cuda_kernels.THREADS)
        for n in range(grid * cuda_kernels.THREADS):  # threads beyond the last element as well
            library.begin(n % cuda_kernels.THREADS, n // cuda_kernels.THREADS, cuda_kernels.THREADS)
            getattr(library, name)(ctypes.c_int(count), *(plain(a) for a in arguments))

    monkeypatch.setattr(cuda_kernels, "launch", launch)
    monkeypatch.setattr(cuda_kernels, "usable", lambda *tensors: all(x.dtype == torch.float32 for x in tensors))
    monkeypatch.setattr(kernels, "nb", None)
    yield ran


def ball(radius: float = 0.5, nodes: int = 24) -> GridSdf:
    """A grid whose coefficients are the distance to a sphere, with some noise."""
    cell = 2 / nodes
    at = torch.stack(torch.meshgrid(*3 * [torch.arange(nodes) * cell - 1], indexing="ij"), -1)
    noise = torch.from_numpy(np.random.default_rng(0).normal(0, 0.01, (nodes,) * 3))
    return GridSdf(at.norm(dim=-1) - radius + noise, torch.tensor([-1.0, -1.0, -1.0]), cell)


def points(count: int, reach: float = 1.3) -> Tensor:
    """Positions in and around the grid's box."""
    return torch.from_numpy(np.random.default_rng(1).uniform(-reach, reach, (count, 3)).astype(np.float32))


def test_the_spline_and_its_gradient(gpu: list[str]) -> None:
    grid, x = ball(), points(150)
    s, g = grid(x)
    true_s, true_g = sdf.spline_sdf(grid.values.detach().double(), x.double(), grid.lo.double(), grid.cell)
    assert gpu == ["spline_forward"]
    torch.testing.assert_close(s.double(), true_s, atol=2e-6, rtol=1e-5)
    torch.testing.assert_close(g.double(), true_g, atol=3e-5, rtol=1e-4)


def test_the_gradient_of_the_coefficients(gpu: list[str]) -> None:
    grid, x = ball(), points(150)
    s, g = grid(x)
    (s.sin().sum() + g.square().sum()).backward()
    values = grid.values.detach().double().requires_grad_(True)
    true_s, true_g = sdf.spline_sdf(values, x.double(), grid.lo.double(), grid.cell)
    (true_s.sin().sum() + true_g.square().sum()).backward()
    assert "spline_backward" in gpu and values.grad is not None
    torch.testing.assert_close(grid.sink.double(), values.grad, atol=2e-3, rtol=1e-4)
    assert float(values.grad.abs().max()) > 10


def test_rays_meet_the_surface_where_plain_torch_finds_it(gpu: list[str]) -> None:
    grid = ball()
    random = np.random.default_rng(2)
    o = torch.from_numpy(random.normal(0, 1, (300, 3)).astype(np.float32))
    o = 2 * o / o.norm(dim=-1, keepdim=True)
    d = torch.from_numpy(random.uniform(-0.6, 0.6, (300, 3)).astype(np.float32)) - o
    d = d / d.norm(dim=-1, keepdim=True)
    near, far = tracing.box_interval(o, d, *grid.box())
    t, hit, s = grid.trace(o, d, near, far)
    values, lo = grid.values.detach(), grid.lo
    true = tracing.sphere_trace(
        lambda p: sdf.spline_sdf(values, p, lo, grid.cell)[0], o, d, near, far, min_step=0.3 * grid.cell, factor=0.95
    )
    assert gpu == ["march"] and 50 < int(hit.sum()) < 280
    assert bool((hit == true[1]).all())
    torch.testing.assert_close(t, true[0], atol=1e-3, rtol=0)
    torch.testing.assert_close(s, true[2], atol=1e-4, rtol=0)


def test_rays_that_start_inside_or_miss_the_box(gpu: list[str]) -> None:
    grid = ball()
    o = torch.tensor([[0.0, 0.0, 0.0], [0.0, 5.0, 3.0], [0.0, 0.0, 3.0]])
    d = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, -1.0]])
    near, far = tracing.box_interval(o, d, *grid.box())
    _, hit, _ = grid.trace(o, d, near, far)
    assert hit.tolist() == [False, False, True] and gpu


def test_a_step_of_the_optimiser(gpu: list[str]) -> None:
    random = np.random.default_rng(3)
    start = [torch.from_numpy(random.normal(0, 1, 200).astype(np.float32)) for _ in range(4)]
    start[3].abs_()
    start[1][::3] = 0
    active = torch.arange(0, 200, 2)
    found, true = [x.clone() for x in start], [x.double() for x in start]
    cuda_kernels.band_adam(*found, active, 0.01, (0.9, 0.99), 1e-3, 7)
    values, grad, m, v = true
    at = active[grad[active] != 0]
    m[at], v[at] = 0.9 * m[at] + 0.1 * grad[at], 0.99 * v[at] + 0.01 * grad[at] ** 2
    values[at] -= 0.01 * (m[at] / (1 - 0.9**7)) / (torch.sqrt(v[at] / (1 - 0.99**7)) + 1e-3)
    grad[at] = 0
    for a, b in zip(found, true, strict=True):
        torch.testing.assert_close(a.double(), b, atol=1e-6, rtol=1e-5)
    assert gpu == ["band_adam"]


def encoding() -> HashEncoding:
    """Dense and hashed levels."""
    torch.manual_seed(0)
    made = HashEncoding(torch.full((3,), -1.0), torch.full((3,), 1.0), 0.5, 0.02, 5, 10)
    assert made.hashed.any() and not made.hashed.all()
    torch.nn.init.normal_(made.table)
    return made


def test_the_hash_encoding_and_its_gradients(gpu: list[str]) -> None:
    made, x = encoding(), points(120, 1.2).requires_grad_(True)
    found = made(x)
    found.sin().sum().backward()
    assert gpu == ["hash_forward", "hash_backward"]
    grads = made.table.grad, x.grad
    made.table.grad = x.grad = None
    true = made.reference(x)
    true.sin().sum().backward()
    torch.testing.assert_close(found, true, atol=3e-5, rtol=1e-4)
    for a, b in zip(grads, (made.table.grad, x.grad), strict=True):
        assert a is not None and b is not None
        torch.testing.assert_close(a, b, atol=2e-3, rtol=1e-3)


@pytest.mark.parametrize("order", [0, 1, 3, 10])
def test_harmonics_and_their_gradient(gpu: list[str], order: int) -> None:
    d = torch.from_numpy(sh.spiral(140).astype(np.float32))
    d[0] = torch.tensor([0.0, 0.0, 1.0])  # a pole
    weight = torch.from_numpy(np.random.default_rng(4).normal(0, 1, (140, (order + 1) ** 2)))
    found = d.clone().requires_grad_(True)
    y = sh.sh_basis(found, order)
    (y * weight.float()).sum().backward()
    assert gpu == ["sh_forward", "sh_backward"]
    true = d.double().requires_grad_(True)
    basis = sh.sh_basis(true, order)
    ((basis * weight).sum() + 0 * true.sum()).backward()  # order 0 is constant
    torch.testing.assert_close(y.double(), basis, atol=1e-5, rtol=1e-5)
    assert found.grad is not None
    expected = true.grad if true.grad is not None else torch.zeros_like(d).double()
    torch.testing.assert_close(found.grad.double(), expected, atol=1e-3, rtol=1e-4)


def test_nothing_is_launched_for_no_elements(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_kernels, "_kernel", lambda name: pytest.fail("a kernel was compiled"))
    cuda_kernels.launch("march", 0)


def test_too_many_elements_for_one_launch() -> None:
    with pytest.raises(ValueError, match=r"march: 2147483648 elements; one launch has at most"):
        cuda_kernels.launch("march", 2**31)


def test_a_gpu_whose_kernels_can_not_be_compiled(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(name: str) -> None:
        raise RuntimeError("no NVRTC")

    monkeypatch.setattr(cuda_kernels, "_kernel", fails)
    cuda_kernels.available.cache_clear()
    try:
        assert not cuda_kernels.available()
    finally:
        cuda_kernels.available.cache_clear()
    assert "no NVRTC" in caplog.text and "slow" in caplog.text
