"""Every function of pipeline.maths against finite differences in float64, and a list that can't forget one."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from typing import Any

import pytest
import torch

import pipeline.maths
from pipeline.maths import brdf, correlation, cubemap, density, ggx_width, light_frame, losses, sdf, sh, split_sum, vmf


def draw(*shape: int, seed: int = 0, low: float = 0.1, high: float = 0.9) -> torch.Tensor:
    u = torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (low + (high - low) * u).requires_grad_()


def unit(n: int, seed: int = 0) -> torch.Tensor:
    x = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(x, dim=-1).requires_grad_()


def lit(order: int = 3) -> torch.Tensor:
    """A light that is positive everywhere, so that no clamp is met."""
    c = 0.1 * torch.randn((order + 1) ** 2, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    c[0] += 8
    return c.requires_grad_()


BETA = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
LO = torch.zeros(3, dtype=torch.float64)
CASES: dict[str, tuple[Callable[..., Any], tuple[torch.Tensor, ...]]] = {
    "brdf.reflect": (brdf.reflect, (unit(4), unit(4, 1))),
    "brdf.diffuse": (brdf.diffuse, (draw(4, 3), unit(4), lit())),
    "brdf.lambertian": (brdf.lambertian, (draw(4, 3), draw(4, 3, seed=1))),
    "brdf.light_integral": (lambda d, s, c: brdf.light_integral(d, s, c, "exact"), (unit(4), draw(4), lit())),
    "brdf.specular": (brdf.specular, (draw(4), draw(4, seed=1), draw(4, 3, seed=2))),
    "correlation.standardised": (correlation.standardised, (draw(3, 9),)),
    "correlation.agreement": (
        lambda p: correlation.agreement(p, torch.ones(2, 4, dtype=torch.bool)),
        (draw(2, 4, 9),),
    ),
    "cubemap.project": (lambda d: cubemap.project(d)[1:], (unit(6),)),
    "cubemap.corners": (lambda d: cubemap.corners(d, 3)[1], (unit(6),)),
    "cubemap.lookup": (cubemap.lookup, (draw(3, 54, 3), unit(6), draw(6, low=0.1, high=1.9))),
    "cubemap.blur": (lambda k: cubemap.blur(2, k), (draw(24, 24),)),
    "density.laplace_density": (density.laplace_density, (draw(3, 5, low=-0.9), BETA)),
    "density.laplace_survival": (density.laplace_survival, (draw(3, 5, low=-0.9), BETA)),
    "density.ray_weights": (density.ray_weights, (draw(3, 5), draw(3, 5, seed=1))),
    "density.crossing_weights": (density.crossing_weights, (draw(3, 5, low=-0.9), BETA)),
    "density.opacity_cross_entropy": (density.opacity_cross_entropy, (draw(6, high=3.0), draw(6, seed=1))),
    "losses.rgb_l1": (lambda p: losses.rgb_l1(p, torch.full((4, 3), 0.05, dtype=torch.float64)), (draw(4, 3),)),
    "losses.rgb_cost": (losses.rgb_cost, (draw(4, 3, low=0.001, high=0.06),)),  # on both sides of RGB_SCALE
    "losses.rgb_residual": (  # predictions are .1 and more, the targets smaller, so that no residual is 0
        lambda p: losses.rgb_residual(p, torch.full((4, 3), 0.05, dtype=torch.float64), torch.tensor([[0, 1, -1]] * 4)),
        (draw(4, 3),),
    ),
    "losses.above": (lambda v: losses.above(v, 0.05), (draw(4),)),
    "losses.white_light": (losses.white_light, (draw(9, 3),)),
    "losses.specular_energy": (losses.specular_energy, (draw(4, 3),)),
    "losses.shininess_prior": (lambda s: losses.shininess_prior(s, 0.1), (draw(4, low=0.2),)),
    "losses.albedo_sparsity": (  # the median, which is held fixed by design, is that of rows that stay
        lambda a: losses.albedo_sparsity(torch.cat([a, torch.full((20, 3), 0.5, dtype=torch.float64)]))[:5],
        (draw(5, 3),),
    ),
    "losses.eikonal": (lambda g: (losses.eikonal(g), losses.eikonal(g, False)), (draw(4, 3, high=0.4),)),
    "losses.displacement": (losses.displacement, (draw(4),)),
    "losses.embedding": (losses.embedding, (draw(2, 8),)),
    "losses.normal_consistency": (losses.normal_consistency, (unit(4), unit(4, 1))),
    "sdf.axis_weights": (sdf.axis_weights, (draw(4, low=-0.4, high=0.4),)),
    "sdf.spline_sdf": (lambda v, x: sdf.spline_sdf(v, x, LO, 0.25), (draw(6, 6, 6), draw(4, 3, low=0.4, high=0.8))),
    "sdf.spline_stencil": (
        lambda x: sdf.spline_stencil(x, LO, 0.25, (6, 6, 6))[1:],
        (draw(4, 3, low=0.4, high=0.8),),
    ),
    "sdf.refine": (sdf.refine, (draw(3, 4, 3),)),
    "sdf.unit": (sdf.unit, (draw(4, 3, low=-0.9),)),
    "sh.sh_basis": (lambda d: sh.sh_basis(d, 5), (unit(4),)),
    "sh.irradiance": (sh.irradiance, (lit(4), unit(4))),
    "sh.radiance": (sh.radiance, (lit(4), unit(4))),
    "sh.band_radiance": (sh.band_radiance, (lit(4), unit(4))),
    "sh.band_radiance_reference": (lambda c, d: sh.band_radiance_reference(c, d, 4), (lit(4), unit(4))),
    "split_sum.ggx_kernel": (lambda c: split_sum.ggx_kernel(c, 0.3), (draw(5),)),
    "split_sum.smith": (split_sum.smith, (draw(5), draw(5, seed=1))),
    "split_sum.environment_brdf": (
        split_sum.environment_brdf,
        (draw(5, 3), draw(5, seed=1, low=0.2, high=0.8), draw(5, seed=2, low=0.2, high=0.8)),
    ),
    "ggx_width.gauge_alpha": (ggx_width.gauge_alpha, (draw(5),)),
    "light_frame.lamp_axes": (lambda wo: light_frame.lamp_axes(torch.eye(3).double().expand(4, 3, 3), wo), (unit(4),)),
    "light_frame.level_axes": (lambda x: light_frame.level_axes(x.reshape(4, 3, 3)), (draw(4, 9, seed=3),)),
    "light_frame.turn_of": (
        lambda x, wo: (
            light_frame.turn_of(
                "flash", light_frame.Stations(2 + 0 * x, torch.eye(3).double().expand(4, 3, 3)), x, wo, 0.7
            ).strength
        ),
        (draw(4, 3), unit(4)),
    ),
    "vmf.attenuation_phong": (lambda s: vmf.attenuation_phong(s, 6), (draw(5),)),
    "vmf.attenuation_exponential": (lambda s: vmf.attenuation_exponential(s, 6), (draw(5),)),
    "vmf.attenuation_exact": (lambda s: vmf.attenuation_exact(s, 6), (draw(5),)),
}
WITHOUT = {
    "density": set(),
    "sdf": {"locate", "neighbour_offsets"},  # indices
    "sh": {"count", "order_of", "clamped_cosine", "band_selector", "rotated", "spiral"},  # constants; numpy
    "tracing": {"box_interval", "sphere_interval", "sphere_trace", "aggressive_trace"},  # searches, without gradients
    "cubemap": {"texel_directions", "solid_angles", "padded"},
    "split_sum": {"table"},
    "ggx_width": {"best_fit_alpha"},  # numpy, after the fit
    "precision": {"full_precision", "raise_half"},
    "sh_recurrence": {"recurrence", "tables"},
}


NUMPY = {  # nothing is differentiated there by torch
    "cuda_kernels",  # float32 alone; held to plain torch in tests/fields/test_cuda_kernels.py
    "latlong",
    "microfacet",
    "rigid_motion",
    "sh_monomials",
    "smoothstep",
    "sparse",
    "student",
    "studio_lights",
}


@pytest.mark.parametrize("name", CASES)
def test_gradcheck(name: str) -> None:
    function, inputs = CASES[name]
    assert torch.autograd.gradcheck(function, inputs)


def test_none_is_forgotten() -> None:
    missing = []
    for info in pkgutil.iter_modules(pipeline.maths.__path__):
        if info.name in NUMPY:
            continue
        module = importlib.import_module(f"pipeline.maths.{info.name}")
        for name, thing in inspect.getmembers(module, inspect.isfunction):
            ours = thing.__module__ == module.__name__ and not name.startswith("_")
            if ours and f"{info.name}.{name}" not in CASES and name not in WITHOUT.get(info.name, set()):
                missing.append(f"{info.name}.{name}")
    assert missing == []
