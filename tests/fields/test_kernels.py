"""Compiled kernels against their plain torch references, and the optimiser against torch's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from pipeline.fields import kernels
from pipeline.fields.encodings import HashEncoding
from pipeline.maths.sdf import spline_sdf
from pipeline.maths.tracing import sphere_trace

LO, CELL, SHAPE = torch.tensor([-1.0, -1.1, -0.9]), 0.08, (26, 28, 24)


COMPILED = kernels.nb


@pytest.fixture(autouse=True)
def _compiled() -> Iterator[None]:
    if COMPILED is None:
        pytest.skip("numba is not installed: there are no compiled kernels")
    yield
    use_numba(True)


def use_numba(enabled: bool) -> None:
    """Without the kernels' module all goes the plain way, as it does where numba is not installed."""
    kernels.nb = COMPILED if enabled else None


def ball_grid(radius: float = 0.6) -> torch.Tensor:
    i = torch.stack(torch.meshgrid(*[torch.arange(n) for n in SHAPE], indexing="ij"), -1)
    return (LO + CELL * i).norm(dim=-1) - radius


def points(n: int) -> torch.Tensor:
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(0)) * 2.4 - 1.2  # some beyond the border


def grid_gradients(values: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
    values = values.clone().requires_grad_()
    sink = torch.zeros_like(values)
    s, g = kernels.SplineSdf.apply(x, values, sink, LO, CELL)
    torch.manual_seed(1)
    (s * torch.randn(len(x)) + (g * torch.randn(len(x), 3)).sum(-1)).sum().backward()
    return s.detach(), g.detach(), sink


def test_spline_matches_the_reference_both_ways() -> None:
    v, x = torch.randn(SHAPE, generator=torch.Generator().manual_seed(3)), points(5000)
    fast = grid_gradients(v, x)
    use_numba(False)
    slow = grid_gradients(v, x)
    for a, b in zip(fast, slow, strict=True):
        assert (a - b).abs().max() < 3e-5 * b.abs().max()


def test_spline_sink_is_the_gradient() -> None:
    """The sink against autograd through the reference in float64."""
    v = torch.randn(SHAPE, generator=torch.Generator().manual_seed(3), dtype=torch.float64).requires_grad_()
    x = points(50).double()
    sink = torch.zeros_like(v)
    s, g = kernels.SplineSdf.apply(x, v, sink, LO.double(), CELL)
    (s.sum() + (g**2).sum()).backward()
    s2, g2 = spline_sdf(v, x, LO.double(), CELL)
    (expected,) = torch.autograd.grad(s2.sum() + (g2**2).sum(), v)
    assert torch.allclose(sink, expected, atol=1e-9)


def test_scatter_repeats_bit_by_bit() -> None:
    v, x = torch.randn(SHAPE), points(20_000)
    assert torch.equal(grid_gradients(v, x)[2], grid_gradients(v, x)[2])


def test_march_matches_the_reference() -> None:
    v = ball_grid()
    g = torch.Generator().manual_seed(5)
    o = torch.tensor([0.0, 0.0, 1.0]) + 0.02 * torch.randn(400, 3, generator=g)
    d = torch.nn.functional.normalize(torch.randn(400, 3, generator=g) * 0.6 + torch.tensor([0.0, 0, -1]), dim=-1)
    near, far = torch.full((400,), 0.0), torch.full((400,), 1.8)
    t, hit, s = kernels.trace(v, LO, CELL, o, d, near, far, min_step=0.02)
    t2, hit2, s2 = sphere_trace(lambda p: spline_sdf(v, p, LO, CELL)[0], o, d, near, far, min_step=0.02)
    assert (hit == hit2).float().mean() > 0.99 and 0.2 < hit.float().mean() < 0.8
    both = hit & hit2
    assert (t - t2)[both].abs().max() < 2e-4 and (s - s2)[~hit & ~hit2].abs().max() < 1e-4
    # and against the true ball
    b = (o * d).sum(-1)
    true = -b - torch.sqrt((b * b - (o * o).sum(-1) + 0.6**2).clamp(min=0))
    # coefficients are samples here, which moves the surface by cell^2 * curvature / 4 = 2.7e-3 outward
    assert (t - true)[both].abs().median() < 5e-3


def encoding(levels: int = 6) -> HashEncoding:
    torch.manual_seed(0)
    e = HashEncoding(torch.tensor([-1.0, -1, -1]), torch.tensor([1.0, 1, 1]), 0.25, 0.01, levels, 10)
    with torch.no_grad():
        e.table.normal_()
    return e


def test_hash_matches_the_reference_both_ways() -> None:
    e, x = encoding(), points(3000)
    upstream = torch.randn(3000, e.width, generator=torch.Generator().manual_seed(2))
    results = []
    for enabled in (True, False):
        use_numba(enabled)
        xx = x.clone().requires_grad_()
        e.table.grad = None
        out = e(xx)
        (out * upstream).sum().backward()
        results.append((out.detach(), e.table.grad.clone(), xx.grad))
    inside = (x.abs() < 0.99).all(-1)  # beyond the box the clamped corner's one-sided derivative is free
    for k, (a, b) in enumerate(zip(*results, strict=True)):
        a, b = (a[inside], b[inside]) if k == 2 else (a, b)
        assert (a - b).abs().max() < 1e-4 * b.abs().max()


def test_hash_tables_stay_within_their_rows() -> None:
    e = encoding()
    rows = torch.diff(torch.cat([e.offset, torch.tensor([len(e.table)])]))
    assert (rows <= 2**10).all() and e.hashed.any() and not e.hashed.all()


def test_closed_levels_give_nothing() -> None:
    e, x = encoding(4), points(10)
    e.open_levels(0.625)
    out = e(x)
    assert (out[:, 6:] == 0).all() and (out[:, :4] != 0).any()
    e.open_levels(1.0)
    assert (e(x)[:, 6:] != 0).any()


def test_band_optimiser_is_adam_where_rays_touch() -> None:
    torch.manual_seed(0)
    start = torch.randn(SHAPE)
    active = torch.nonzero(torch.rand(start.numel()) < 0.5).squeeze(-1)
    reference = torch.nn.Parameter(start.view(-1)[active].clone())
    adam = torch.optim.Adam([reference], lr=0.01, betas=(0.9, 0.99), eps=1e-12)
    for enabled in (True, False):
        use_numba(enabled)
        v, g, m, w = start.clone(), torch.zeros(SHAPE), torch.zeros(SHAPE), torch.zeros(SHAPE)
        torch.manual_seed(9)
        for step in range(1, 6):
            grad = torch.randn(SHAPE)
            g.copy_(grad)
            g.view(-1)[torch.ones(start.numel(), dtype=torch.bool).index_fill_(0, active, False)] = 0
            kernels.adam_on_band(v, g, m, w, active, step, 0.01, (0.9, 0.99))
            if enabled:
                reference.grad = grad.view(-1)[active].clone()
                adam.step()
            assert (g == 0).all()
        assert torch.allclose(v.view(-1)[active], reference.detach(), atol=2e-6)


def test_band_optimiser_leaves_untouched_coefficients_alone() -> None:
    v, m, w = torch.zeros(SHAPE), torch.ones(SHAPE), torch.ones(SHAPE)
    kernels.adam_on_band(v, torch.zeros(SHAPE), m, w, torch.arange(v.numel()), 3, 0.01, (0.9, 0.99))
    assert (v == 0).all() and (m == 1).all()


@pytest.mark.parametrize("fast", [True, False])
def test_patches_against_scipy(fast: bool) -> None:
    """Two photos of other sizes, positions inside, at the border and beyond it, scaled as projections are."""
    use_numba(fast)
    rng = np.random.default_rng(2)
    photos = [rng.random(size, np.float32) for size in ((13, 9), (7, 21))]
    sizes = torch.tensor([p.shape for p in photos])
    view = torch.from_numpy(rng.integers(0, 2, (40, 3)))
    uv = rng.uniform(-4, 25, (40, 3, 2, 5)).astype(np.float32)
    depth = rng.uniform(0.2, 3, (40, 3, 1, 5)).astype(np.float32)
    q = torch.from_numpy(np.concatenate([uv * depth, depth], 2))
    grey = torch.from_numpy(np.concatenate([p.ravel() for p in photos]))
    first = torch.tensor([0, photos[0].size])
    found = kernels.look_up(grey, first, sizes[:, 1], sizes[:, 0], view, q).numpy()
    for k, photo in enumerate(photos):
        chosen = view.numpy() == k
        x, y = (uv[chosen][:, i].astype(np.float64) - 0.5 for i in (0, 1))
        wanted = map_coordinates(photo.astype(np.float64), [y, x], order=1, mode="nearest")
        assert np.abs(found[chosen] - wanted).max() < 2e-3  # held 0.001 of a pixel before the border


def test_patches_of_nothing() -> None:
    none = kernels.look_up(torch.zeros(1), *[torch.ones(1, dtype=torch.long)] * 3,
                           torch.zeros(0, 3, dtype=torch.long), torch.zeros(0, 3, 3, 5))  # fmt: skip
    assert none.shape == (0, 3, 5)
