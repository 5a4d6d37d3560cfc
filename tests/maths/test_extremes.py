"""Values and gradients at the ends of every range, in float32 and under bfloat16 autocast.

A check takes the module that it looks at, so that the same check runs on the real module, where it must pass, and on
a copy without the guard, where it must fail (GUARDS).
"""

from __future__ import annotations

import importlib
import types
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import ive

from tests.support.mutants import without

Module = types.ModuleType
KAPPAS = (1e-6, 1e-3, 0.1, 1.44, 20.0, 150.0, 1e4, 1e8)
BETAS = (1e-6, 1e-3, 1.0, 10.0)
SCENES = (1e-4, 1.0, 1e4)
ORDERS = (0, 1, 2, 5, 10, 16)


def directions(n: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> torch.Tensor:
    x = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(x, dim=-1).to(dtype)


def finite(*values: torch.Tensor | None) -> None:
    for v in values:
        assert v is not None and bool(torch.isfinite(v).all())


def derive(f: Callable[..., Any], *inputs: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """f at inputs, and the gradients of its sum; both must be finite."""
    leaves = [x.clone().requires_grad_() for x in inputs]
    out = f(*leaves)
    out = out if isinstance(out, torch.Tensor) else sum(o.sum() for o in out)
    if out.requires_grad:  # order 0 is constant
        out.sum().backward()
    grads = [x.grad if x.grad is not None else torch.zeros_like(x) for x in leaves]
    finite(out, *grads)
    return out.detach(), grads


# ------------------------------------------------------------------ attenuation and light
def attenuation_exact(m: Module) -> None:
    for order in ORDERS:
        s = torch.tensor([1 / k for k in KAPPAS])
        a, (g,) = derive(lambda x, o=order: m.attenuation_exact(x, o), s)
        expected = np.stack([ive(np.arange(order + 1) + 0.5, k) / ive(0.5, k) for k in KAPPAS])
        assert np.abs(a.numpy() - expected).max() < 2e-6
        exactly = m.attenuation_exact(torch.tensor([1 / k for k in KAPPAS], dtype=torch.float64), order)
        assert np.abs(exactly.numpy() - expected).max() < 5e-8
        if order:  # order 0 is constant
            wide = s.double().requires_grad_()
            (exact,) = torch.autograd.grad(m.attenuation_exact(wide, order).sum(), wide)
            assert torch.allclose(g.double(), exact, rtol=2e-3, atol=1e-6)

    derive(lambda x: m.attenuation_exact(x, 10), torch.tensor([1e9, 1e20, 1e30]))


def attenuation_exponential(m: Module) -> None:
    for order in ORDERS:
        s = torch.tensor([1 / k for k in KAPPAS])
        a, (g,) = derive(lambda x, o=order: m.attenuation_exponential(x, o), s)
        l = torch.arange(order + 1).double()  # noqa: E741
        rate = l * (l + 1) / 2
        expected = torch.exp(-rate * s.double()[:, None])
        assert (a - expected).abs().max() < 1e-6
        assert torch.allclose(g.double(), -(rate * expected).sum(1), rtol=1e-4, atol=1e-6)


def light(m: Module) -> None:
    """Specular and diffuse transport at every angle, width, order and brightness."""
    cosines = torch.tensor([-1.0, -1e-4, 0.0, 1e-4, 0.5, 1.0])
    wo = torch.stack([torch.sqrt(1 - cosines**2), torch.zeros(6), cosines], -1)
    n = torch.tensor([[0.0, 0, 1]]).expand(6, 3)
    for order in ORDERS:
        for brightness in (0.0, 1e-6, 1.0, 1e5):
            c = torch.randn((order + 1) ** 2, 3, generator=torch.Generator().manual_seed(order))
            c = brightness * c / c.abs().max()
            for kappa in KAPPAS:
                s = torch.full((6,), 1 / kappa)
                for kind in ("exponential", "exact"):

                    def shade(n: torch.Tensor, s: torch.Tensor, c: torch.Tensor, kind: str = kind) -> torch.Tensor:
                        incident = m.light_integral(m.reflect(wo, n), s, c, kind)
                        return torch.cat([incident, m.diffuse(torch.full((6, 3), 0.5), n, c)])

                    out, _ = derive(shade, n, s, c)
                    assert out.min() >= 0


def half_precision(m: Module) -> None:
    """Under autocast to bfloat16, whose three digits would ruin sums of 121 terms: float32's results."""
    c = 1e3 * torch.randn(121, 3, generator=torch.Generator().manual_seed(1))
    d, s = directions(200), torch.full((200,), 0.02)
    plain = m.light_integral(d, s, c)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        got = m.light_integral(d, s, c)
        diffuse = m.diffuse(torch.full((200, 3), 0.5, dtype=torch.bfloat16), d, c)
    assert got.dtype == torch.float32 and torch.allclose(got, plain, rtol=1e-5)
    assert torch.allclose(diffuse, m.diffuse(torch.full((200, 3), 0.5), d, c), rtol=1e-5)


# ------------------------------------------------------------------ surfaces and density
def unit_normals(m: Module) -> None:
    for size in (0.0, 1e-30, 1e-7, 1.0, 1e6):
        n, (g,) = derive(m.unit, size * directions(20))
        assert n.norm(dim=-1).max() <= 1 + 1e-6
        if size >= 1:
            assert torch.allclose(n, directions(20), atol=1e-5)


def laplace(m: Module) -> None:
    for beta in BETAS:
        for scene in SCENES:
            s = scene * torch.tensor([-1.0, -1e-3, 0.0, 1e-3, 1.0])
            out, _ = derive(m.laplace_density, s, torch.tensor(beta))
            assert out.min() >= 0 and out.max() <= 1 / beta * (1 + 1e-6)
            survival, _ = derive(m.laplace_survival, s, torch.tensor(beta))
            assert survival.min() >= 0 and survival.max() <= 1


def rays_through(m: Module, weigh: Callable[[Module, torch.Tensor, torch.Tensor, float], Any]) -> None:
    """All in front, all behind, through, coincident, touching: weights are a share of 1 and add up to 1 - T."""
    for beta in BETAS:
        for scene in SCENES:
            t = torch.linspace(-1, 1, 16)
            cases = torch.stack([t * 0 + 1, t * 0 - 1, -t, t * 0, t * t, t * 0 + 1e-9, t])
            s = (scene * cases).requires_grad_()
            b = torch.tensor(beta, requires_grad=True)
            w, tau = weigh(m, s, b, 2 * scene / 16)
            (w.sum() + tau.clamp(max=50).sum()).backward()
            finite(w, tau, s.grad, b.grad)
            assert w.min() >= 0 and w.max() <= 1 + 1e-6
            assert torch.allclose(w.sum(-1), -torch.expm1(-tau), atol=3e-5)


def volume_weights(m: Module) -> None:
    rays_through(m, lambda m, s, b, d: m.ray_weights(m.laplace_density(s, b), torch.full_like(s, d)))
    thin = torch.full((1, 4), 1e-9)
    w, tau = m.ray_weights(thin, torch.ones(1, 4))
    assert w.sum().item() == pytest.approx(4e-9, rel=1e-3)
    uneven = torch.tensor([[1e-3, 1e10, 1.0]])  # a thin interval before an opaque one
    w, tau = m.ray_weights(uneven, torch.ones(1, 3))
    assert w.sum().item() == pytest.approx(1.0, abs=1e-6) and w[0, 1].item() == pytest.approx(0.999, abs=1e-5)


def crossing(m: Module) -> None:
    for beta in BETAS:
        for scene in SCENES:
            t = torch.linspace(-1, 1, 32)
            s = (scene * torch.stack([t * 0 + 1, t * 0 - 1, -t, t * 0, t * t, t * 0 + 1e-9])).requires_grad_()
            b = torch.tensor(beta, requires_grad=True)
            w, tau = m.crossing_weights(s, b)
            (w.sum() + tau.sum()).backward()
            finite(w, tau, s.grad, b.grad)
            assert w.min() >= 0 and w.sum(-1).max() <= 1 + 1e-6 and tau.min() >= -1e-6
            if beta < 0.01 * scene:  # from in front to behind: all of it, and nothing where there is nothing
                assert w[2].sum().item() == pytest.approx(1, abs=1e-5) and w[0].sum() < 1e-5


def cross_entropy(m: Module) -> None:
    tau = torch.tensor([0.0, 1e-30, 1e-5, 1.0, 3.4, 3.6, 100.0, 1e10])
    for alpha in (0.0, 0.5, 1.0):
        out, (g,) = derive(lambda x, a=alpha: m.opacity_cross_entropy(x, torch.full_like(x, a)), tau)
        assert out.min() >= 0 and g.abs().max() <= 1e5


# ------------------------------------------------------------------ losses
def colours(m: Module) -> None:
    """Black, white, saturated and dazzling, and a prediction below zero."""
    x = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1e5, 1e5, 1e5], [-1.0, 0, 1e-8], [0.0031308, 0.0031308, 0.5]])
    free = torch.zeros(5, 3, dtype=torch.int8)
    for target in (0.0, 0.5, 1.0):
        out, (g,) = derive(lambda p, t=target: m.rgb_l1(p, torch.full_like(p, t)), x)
        assert (g[2] > 0).all() and g.abs().max() < 10
        out, (g,) = derive(lambda p, t=target: m.rgb_cost(m.rgb_residual(p, torch.full_like(p, t), free)), x)
        assert (g[2] > 0).all() and g.abs().max() < 10


def steepness(m: Module) -> None:
    for size in (0.0, 1e-30, 1e-7, 1.0, 1e6):
        for squared in (True, False):
            out, _ = derive(lambda g, q=squared: m.eikonal(g, q), size * directions(10))
            if size <= 1e-7:
                assert torch.allclose(out, torch.ones(10), atol=1e-5)


def gauge(m: Module) -> None:
    out, _ = derive(lambda s: m.shininess_prior(s, 0.1), torch.tensor([0.0, 1e-30, 1e-8, 0.1, 1e6]))
    assert out[3] == 0


# ------------------------------------------------------------------ tracing
def boxes(m: Module) -> None:
    lo, hi = -torch.ones(3), torch.ones(3)
    o = torch.tensor([[-1.0, 0, 3], [1, 1, 1], [0, 0, 0], [-1, -1, -1]])
    d = torch.tensor([[0.0, 0, -1], [0, 0, -1], [0, 1, 0], [1, 0, 0]])
    near, far = m.box_interval(o, d, lo, hi)
    assert not torch.isnan(near).any() and not torch.isnan(far).any()
    assert near[0] == 2 and far[0] == 4


def grazing(m: Module) -> None:
    """A ray along a plane, within a step's length of it for ever, reaches its end; so does one that starts on it."""
    for scene in SCENES:
        o = scene * torch.tensor([[0.0, 0, 1e-9], [0, 0, 0], [0, 0, -0.5], [0, 0, 1]])
        d = torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, -1]])
        t, hit, s = m.sphere_trace(
            lambda p: p[:, 2], o, d, torch.zeros(4), torch.full((4,), 2 * scene), min_step=0.01 * scene, factor=1.2
        )
        finite(t, s)
        assert hit.tolist() == [False, False, False, True]
        assert t[3].item() == pytest.approx(scene, rel=1e-5)
        past = m.sphere_trace(
            lambda p, z=scene: p[:, 2] - 1e-3 * torch.relu(p[:, 0] - z),
            o[:1], d[:1], torch.zeros(1), torch.full((1,), 2 * scene), min_step=0.01 * scene,
        )  # fmt: skip
        assert bool(past[1]), "the march stalled before the plane bends into the ray"


CHECKS: dict[str, tuple[str, Callable[[Module], None]]] = {
    "attenuation_exact": ("pipeline.maths.vmf", attenuation_exact),
    "attenuation_exponential": ("pipeline.maths.vmf", attenuation_exponential),
    "light": ("pipeline.maths.brdf", light),
    "half_precision": ("pipeline.maths.brdf", half_precision),
    "unit": ("pipeline.maths.sdf", unit_normals),
    "laplace": ("pipeline.maths.density", laplace),
    "volume_weights": ("pipeline.maths.density", volume_weights),
    "crossing": ("pipeline.maths.density", crossing),
    "cross_entropy": ("pipeline.maths.density", cross_entropy),
    "colours": ("pipeline.maths.losses", colours),
    "steepness": ("pipeline.maths.losses", steepness),
    "gauge": ("pipeline.maths.losses", gauge),
    "boxes": ("pipeline.maths.tracing", boxes),
    "grazing": ("pipeline.maths.tracing", grazing),
}

GUARDS = [
    ("attenuation_exact", "EXTRA_ORDERS = 8", "EXTRA_ORDERS = 0"),
    ("attenuation_exact", "MIN_ORDER = 10", "MIN_ORDER = -7"),
    ("attenuation_exact", "s.clamp(max=1e9)", "s"),
    ("attenuation_exact", "* (1 + t / (1 + t))", ""),
    ("attenuation_exact", "torch.sqrt(1 + (top + 1) * (top + 2) * t * t * (1 + t / (1 + t)))", "0.0"),
    ("light", ".clamp(min=0)", ""),
    ("half_precision", "@full_precision", ""),
    ("unit", "+ 1e-12", ""),
    ("laplace", "torch.exp(-s.abs() / beta)", "torch.exp(-s / beta)"),
    ("volume_weights", "-torch.expm1(-depth)", "(1 - torch.exp(-depth))"),
    (
        "volume_weights",
        "torch.cumsum(torch.nn.functional.pad(depth[..., :-1], (1, 0)), -1)",
        "torch.cumsum(depth, -1) - depth",
    ),
    ("crossing", ".clamp(min=floor)", ""),
    ("cross_entropy", "tau.clamp(min=1e-4)", "tau"),
    ("steepness", "+ 1e-12", ""),
    ("gauge", ".clamp(min=1e-6)", ""),
    ("boxes", "d.abs() < 1e-12", "d.abs() < 0"),
    ("grazing", ".clamp(min=min_step)", ""),
]


@pytest.mark.parametrize("name", CHECKS)
@pytest.mark.parametrize("precision", ["float32", "bfloat16 autocast"])
def test_extremes(name: str, precision: str) -> None:
    module, check = CHECKS[name]
    with torch.autocast("cpu", dtype=torch.bfloat16) if precision != "float32" else nullcontext():
        check(importlib.import_module(module))


@pytest.mark.parametrize(("name", "guard", "unguarded"), GUARDS, ids=[f"{n}-{i}" for i, (n, *_) in enumerate(GUARDS)])
def test_the_check_fails_without_the_guard(name: str, guard: str, unguarded: str) -> None:
    module, check = CHECKS[name]
    with without(module, guard, unguarded) as broken, pytest.raises((AssertionError, RuntimeError, ValueError)):
        check(broken)


def test_the_colour_curve_needs_its_guard() -> None:
    """The power's derivative at 0 would reach the gradient of the losses through `where`."""

    def check(m: Module) -> None:
        derive(m.srgb_from_linear, torch.tensor([0.0, 1e-30, 1e5, -1.0]))

    check(importlib.import_module("pipeline.colour"))
    with without("pipeline.colour", "v.clamp(min=0.0031308)", "v") as broken, pytest.raises(AssertionError):
        check(broken)
