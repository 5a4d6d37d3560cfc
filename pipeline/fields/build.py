"""The parts of a model from its spec: ours, or those of a system that the paper compares.

appearance   hash | sinusoidal               the Spatial MLP
shading      neural | phong | disney         the specular term [NeuFace section 5.2]
light        sh | cubemap
integral     low_rank | direct | feature     the material integral [NeuFace eq. 6], [NeuFace eq. 8]
geometry     grid | displaced                a spline grid, or a prior and a displacement [NeuFace eq. 17]

The first of each is ours. All others are in pipeline.fields.paper, which is loaded only where one of them is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from pipeline.fields.appearance import IntegratedBasis, SpatialField
from pipeline.fields.encodings import HashEncoding
from pipeline.fields.geometry import GridSdf
from pipeline.fields.light import ShLight
from pipeline.fields.parts import Integral, Light, System
from pipeline.fields.shading import BasisShading
from pipeline.fields.spec import FaceSpec

OURS = {"appearance": "hash", "shading": "neural", "light": "sh", "integral": "low_rank", "geometry": "grid"}


def system_of(spec: FaceSpec) -> System:
    """The makers of a model's parts. The one door to pipeline.fields.paper."""
    if all(getattr(spec, part) == name for part, name in OURS.items()):
        return System(geometry, spatial, basis, light, shading)
    from pipeline.fields.paper.build import compared

    return compared(spec)


def geometry(spec: FaceSpec, arrays: Mapping[str, Tensor], cell: float) -> GridSdf:
    """The grid of a saved model."""
    return GridSdf(arrays["geometry.values"], arrays["geometry.lo"], cell)


def spatial(spec: FaceSpec) -> SpatialField:
    """x -> (a, rho, c, 1/kappa), c of the bases."""
    return hashed(spec, spec.rank, positive=True)


def hashed(spec: FaceSpec, columns: int, positive: bool) -> SpatialField:
    """A Spatial MLP over a hash encoding; `columns` numbers beside albedo, rho and 1/kappa."""
    lo, hi = torch.tensor(spec.lo), torch.tensor(spec.hi)
    encoding = HashEncoding(lo, hi, spec.coarse, spec.hash_fine, spec.hash_levels, spec.hash_log2_size)
    return SpatialField(encoding, columns, spec.width, spec.depth, spec.albedo_start, positive)


def basis(spec: FaceSpec) -> IntegratedBasis:
    """The factor between rho and the light integral."""
    return IntegratedBasis(spec.rank, spec.basis_width, spec.basis_depth, spec.basis_inputs == "cosine")


def light(spec: FaceSpec) -> ShLight:
    """The captured light."""
    return ShLight(spec.light_order, spec.light_start)


def shading(spec: FaceSpec, integral: Integral, light: Light) -> BasisShading:
    """The specular term."""
    assert isinstance(integral, IntegratedBasis)
    return BasisShading(integral, light, spec.attenuation)
