"""Constructors of the parts of the systems that the paper compares. For the names see pipeline.fields.build.

prior        hull | sphere | imface          for the geometry `displaced`; a grid starts from a hull or a sphere
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from pipeline.fields import makers
from pipeline.fields.paper.cubemap import CubemapLight
from pipeline.fields.paper.displaced import DisplacedSdf
from pipeline.fields.paper.material import FEATURES, DirectIntegral, FeatureIntegral
from pipeline.fields.paper.prior_imface import ImFacePrior, under
from pipeline.fields.paper.priors import HullPrior, SpherePrior
from pipeline.fields.paper.rendering import rendering
from pipeline.fields.paper.shading import DisneyShading, IntegralShading, PhongShading
from pipeline.fields.paper.sinusoidal import SinusoidalField
from pipeline.fields.parts import Geometry, Integral, Light, Shading, Spatial, System
from pipeline.fields.spec import FaceSpec


def compared(spec: FaceSpec) -> System:
    """A system that differs from ours in at least one part."""
    return System(
        GEOMETRIES[spec.geometry], SPATIALS[spec.appearance], INTEGRALS[spec.integral], LIGHTS[spec.light],
        shading_of(spec), rendering,
    )  # fmt: skip


def middle(spec: FaceSpec) -> tuple[Tensor, float]:
    """Centre and radius of the sphere around the box of a spec."""
    lo, hi = torch.tensor(spec.lo), torch.tensor(spec.hi)
    return (lo + hi) / 2, 0.5 * float((hi - lo).norm())


def columns(spec: FaceSpec) -> tuple[int, bool]:
    """Number of outputs of the Spatial MLP for the material integral, and whether they are kept >= 0."""
    return {"low_rank": spec.rank, "direct": 1, "feature": FEATURES}[spec.integral], spec.integral == "low_rank"


def hashed(spec: FaceSpec) -> Spatial:
    """Ours."""
    return makers.hashed(spec, *columns(spec))


def sinusoidal(spec: FaceSpec) -> Spatial:
    """The paper's Spatial MLP."""
    return SinusoidalField(*middle(spec), *columns(spec), spec.albedo_start, spec.width, spec.depth)


def direct(spec: FaceSpec) -> Integral:
    """Material integral by one network of position and directions."""
    return DirectIntegral(*middle(spec), 2 * spec.basis_width, spec.basis_depth + 1)


def feature(spec: FaceSpec) -> Integral:
    """Material integral by one network of a feature and the directions."""
    return FeatureIntegral(2 * spec.basis_width, spec.basis_depth + 1)


def cubemap(spec: FaceSpec) -> Light:
    """A cube map, blurred with the lobe of the specular term."""
    return CubemapLight(spec.cubemap_size, spec.light_start, "ggx" if spec.shading == "disney" else "vmf")


def shading_of(spec: FaceSpec) -> Callable[[FaceSpec, Integral, Light], Shading]:
    """The specular term: neural bases if the system has them, else one of the others."""
    if spec.shading == "neural":
        return makers.shading if spec.integral == "low_rank" else IntegralShading
    return {"phong": PhongShading, "disney": DisneyShading}[spec.shading]


def sphere_prior(spec: FaceSpec) -> SpherePrior:
    """A sphere at the centre of the box, with its smallest half edge as radius."""
    centre, _ = middle(spec)
    return SpherePrior(centre, 0.5 * min(b - a for a, b in zip(spec.lo, spec.hi, strict=True)) * 1.2)


def displaced(spec: FaceSpec, prior: nn.Module) -> DisplacedSdf:
    """Displaced geometry over a prior. [NeuFace eq. 17]"""
    return DisplacedSdf(prior, spec.displacement_width)


def stored_displaced(spec: FaceSpec, arrays: Mapping[str, Tensor], cell: float) -> DisplacedSdf:
    """The same over a prior given by its arrays; the cell is that of the prior."""
    named = under(arrays, "geometry.prior")
    if spec.prior == "imface":
        return displaced(spec, ImFacePrior(named, torch.tensor(spec.prior_centre), spec.prior_scale))
    if spec.prior == "sphere":
        return displaced(spec, sphere_prior(spec))
    return displaced(spec, HullPrior(named["values"], named["lo"], float(named["edge"])))


GEOMETRIES: dict[str, Callable[[FaceSpec, Mapping[str, Tensor], float], Geometry]] = {
    "grid": makers.geometry,
    "displaced": stored_displaced,
}
SPATIALS: dict[str, Callable[[FaceSpec], Spatial]] = {"hash": hashed, "sinusoidal": sinusoidal}
INTEGRALS: dict[str, Callable[[FaceSpec], Integral]] = {"low_rank": makers.basis, "direct": direct, "feature": feature}
LIGHTS: dict[str, Callable[[FaceSpec], Light]] = {"sh": makers.light, "cubemap": cubemap}
