"""Constructors of our own parts of a model, from its spec."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from pipeline.fields.appearance import IntegratedBasis, SpatialField
from pipeline.fields.encodings import HashEncoding
from pipeline.fields.geometry import GridSdf
from pipeline.fields.light import ShLight
from pipeline.fields.parts import Integral, Light
from pipeline.fields.rendering import ExpectedPoint
from pipeline.fields.shading import BasisShading
from pipeline.fields.spec import FaceSpec


def geometry(spec: FaceSpec, arrays: Mapping[str, Tensor], cell: float) -> GridSdf:
    """The grid of a saved model."""
    return GridSdf(arrays["geometry.values"], arrays["geometry.lo"], cell)


def spatial(spec: FaceSpec) -> SpatialField:
    """x -> (a, rho, c, 1/kappa), c of the bases."""
    return hashed(spec, spec.rank, positive=True)


def hashed(spec: FaceSpec, columns: int, positive: bool) -> SpatialField:
    """A Spatial MLP over a hash encoding, with `columns` outputs besides albedo, rho and 1/kappa."""
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


def rendering(spec: FaceSpec) -> ExpectedPoint:
    """Shading once per ray."""
    return ExpectedPoint()
