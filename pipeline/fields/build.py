"""Which network stands where: the paper's systems as configurations of one model.

appearance   hash | sinusoidal               the Spatial MLP
shading      neural | phong | disney         the specular term [NeuFace section 5.2]
light        sh | cubemap
integral     low_rank | direct | feature     the material integral [NeuFace eq. 6], [NeuFace eq. 8]
geometry     grid | displaced                a spline grid, or a prior and a displacement [NeuFace eq. 17]
prior        hull | sphere | imface          for displaced; a grid starts from a hull or a sphere
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.fields.appearance import IntegratedBasis, SpatialField
from pipeline.fields.displaced import DisplacedSdf
from pipeline.fields.encodings import HashEncoding
from pipeline.fields.light import ShLight
from pipeline.fields.material import FEATURES, DirectIntegral, FeatureIntegral
from pipeline.fields.prior_imface import ImFacePrior, under
from pipeline.fields.priors import HullPrior, SpherePrior
from pipeline.fields.sinusoidal import SinusoidalField
from pipeline.fields.spec import FaceSpec


def middle(spec: FaceSpec) -> tuple[Tensor, float]:
    """Centre and radius of the sphere around the box of a spec."""
    lo, hi = torch.tensor(spec.lo), torch.tensor(spec.hi)
    return (lo + hi) / 2, 0.5 * float((hi - lo).norm())


def spatial(spec: FaceSpec) -> nn.Module:
    """x -> (a, rho, c, 1/kappa)."""
    columns = {"low_rank": spec.rank, "direct": 1, "feature": FEATURES}[spec.integral]
    positive = spec.integral == "low_rank"
    if spec.appearance == "sinusoidal":
        centre, radius = middle(spec)
        return SinusoidalField(centre, radius, columns, positive, spec.albedo_start, spec.width, spec.depth)
    lo, hi = torch.tensor(spec.lo), torch.tensor(spec.hi)
    encoding = HashEncoding(lo, hi, spec.coarse, spec.hash_fine, spec.hash_levels, spec.hash_log2_size)
    return SpatialField(encoding, columns, spec.width, spec.depth, spec.albedo_start, positive)


def material_integral(spec: FaceSpec) -> nn.Module:
    """The factor between rho and the light integral."""
    if spec.integral == "direct":
        return DirectIntegral(*middle(spec), 2 * spec.basis_width, spec.basis_depth + 1)
    if spec.integral == "feature":
        return FeatureIntegral(2 * spec.basis_width, spec.basis_depth + 1)
    return IntegratedBasis(spec.rank, spec.basis_width, spec.basis_depth, spec.basis_inputs == "cosine")


def light(spec: FaceSpec) -> nn.Module:
    """The captured light."""
    if spec.light == "cubemap":
        from pipeline.fields.cubemap import CubemapLight

        return CubemapLight(spec.cubemap_size, spec.light_start, "ggx" if spec.shading == "disney" else "vmf")
    return ShLight(spec.light_order, spec.light_start)


def sphere_prior(spec: FaceSpec) -> SpherePrior:
    """A sphere in the middle of the box, of its smallest half edge."""
    centre, _ = middle(spec)
    return SpherePrior(centre, 0.5 * min(b - a for a, b in zip(spec.lo, spec.hi, strict=True)) * 1.2)


def displaced(spec: FaceSpec, prior: nn.Module) -> DisplacedSdf:
    """[NeuFace eq. 17] over a prior."""
    return DisplacedSdf(prior, spec.displacement_width)


def stored_displaced(spec: FaceSpec, arrays: dict[str, Tensor]) -> DisplacedSdf:
    """The same over the prior whose arrays are given."""
    if spec.prior == "imface":
        prior: nn.Module = ImFacePrior(
            under(arrays, "geometry.prior"), torch.tensor(spec.prior_centre), spec.prior_scale
        )
    elif spec.prior == "sphere":
        prior = sphere_prior(spec)
    else:
        named = under(arrays, "geometry.prior")
        prior = HullPrior(named["values"], named["lo"], float(named["edge"]))
    return displaced(spec, prior)
