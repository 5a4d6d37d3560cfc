"""Interfaces of the parts of a model, and of the systems that construct them.

Our own model has one implementation of each (geometry.GridSdf, appearance.SpatialField and IntegratedBasis,
light.ShLight, shading.BasisShading). Those that the paper compares are in pipeline.fields.paper. build.system_of
selects one when a model is constructed. Every part is a network module: its parameters belong to the model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor, nn

from pipeline.fields.protocol import F32
from pipeline.fields.spec import FaceSpec


@dataclass(frozen=True, slots=True)
class Skin:
    """Material at N points: albedo (N, 3), rho (N,), c (N, k) of [NeuFace eq. 7], inv_kappa (N,)."""

    albedo: Tensor
    rho: Tensor
    c: Tensor
    inv_kappa: Tensor


@dataclass(frozen=True, slots=True)
class Shaded:
    """Radiance at N surface points: total = diffuse + specular [NeuFace eq. 4], (N, 3) each, linear, before the
    calibration. along_normal: (N,) rho c . B(n, n), the reflectance along the normal; 0 for models without bases."""

    total: Tensor
    diffuse: Tensor
    specular: Tensor
    albedo: Tensor
    inv_kappa: Tensor
    along_normal: Tensor


class Part(Protocol):
    """A network module."""

    def parameters(self, recurse: bool = True) -> Iterator[nn.Parameter]:
        """The learnt parameters."""
        ...


class Geometry(Part, Protocol):
    """A surface: the zero set of a signed distance, negative inside, asset units."""

    @property
    def cell(self) -> float:
        """Edge of the finest cell."""
        ...

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 3) -> SDF (N,) and its gradient (N, 3)."""
        ...

    def box(self) -> tuple[Tensor, Tensor]:
        """(3,) corners of the volume in which the SDF is defined."""
        ...

    def trace(self, o: Tensor, d: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """N rays -> t, hit and SDF of the first hit or the closest approach, (N,) each. [NeuFace section 4.4]"""
        ...


class Spatial(Part, Protocol):
    """The Spatial MLP. [NeuFace section 4.1]"""

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(N, 3) -> the fields of Skin."""
        ...


class Integral(Part, Protocol):
    """The material integral: the factor between rho and the light. [NeuFace eq. 6]"""

    def integral(self, x: Tensor, c: Tensor, wo: Tensor, n: Tensor) -> Tensor:
        """(N, 3), (N, k), (N, 3), (N, 3) -> (N,), at least 0."""
        ...


class Light(Part, Protocol):
    """The captured light."""

    def __call__(self) -> Tensor:
        """((L + 1)^2, 3) coefficients of the real orthonormal harmonics."""
        ...

    def uniform_gradient(self, order: int) -> None:
        """Restrict the gradient to that of a white light of this order."""
        ...

    def irradiance(self, n: Tensor) -> Tensor:
        """E(n): (N, 3) -> (N, 3)."""
        ...

    def reflected(self, w_r: Tensor, width: Tensor, attenuation: str) -> Tensor:
        """Radiance averaged over a lobe of `width` (N,) around w_r (N, 3): (N, 3). [NeuFace eq. 11]"""
        ...


class Shading(Protocol):
    """How skin reflects the light, and the part of it that textures can represent."""

    @property
    def rank(self) -> int:
        """k, the number of specular bases."""
        ...

    def diffuse_albedo(self, skin: Skin) -> Tensor:
        """(N, 3): the a of [NeuFace eq. 16]."""
        ...

    def specular(self, skin: Skin, x: Tensor, n: Tensor, wo: Tensor) -> Tensor:
        """L_s (N, 3) at x with unit n and wo, (N, 3) each. [NeuFace eq. 5]"""
        ...

    def coefficients(self, c: F32) -> F32:
        """(N, columns) of the Spatial MLP -> (N, k), those of the bases."""
        ...

    def bases(self, wo: Tensor, n: Tensor) -> Tensor:
        """(N, k) at unit directions, (N, 3) each. Raises StageError for a model without bases."""
        ...


@dataclass(frozen=True, slots=True)
class RayPoints:
    """Where K rays are shaded: the expected point x, unit normal n and unit direction to the eye wo, (K, 3) each.
    samples(): all S samples of each ray, as points (K, S, 3), unit normals (K, S, 3) and their shares of the ray's
    weight (K, S)."""

    x: Tensor
    n: Tensor
    wo: Tensor
    samples: Callable[[], tuple[Tensor, Tensor, Tensor]]


class RayRendering(Protocol):
    """How the samples of a ray become its opacity and its radiance. [NeuFace eq. 18]"""

    def weights(self, s: Tensor, half_width: Tensor, hit: Tensor, beta: Tensor) -> tuple[Tensor, Tensor]:
        """SDF (M, S) at samples spread evenly over +-half_width (M,), whether the ray hits (M,), width of the density
        (): weights (M, S) and optical depth (M,)."""
        ...

    def shade(self, model: Callable[[Tensor, Tensor, Tensor], Shaded], at: RayPoints) -> Shaded:
        """Radiance of K rays; model: (x, n, wo) -> radiance at surface points."""
        ...


@dataclass(frozen=True, slots=True)
class System:
    """Constructors of a model's parts. geometry: from the arrays of a saved model, by name, and its cell."""

    geometry: Callable[[FaceSpec, Mapping[str, Tensor], float], Geometry]
    spatial: Callable[[FaceSpec], Spatial]
    integral: Callable[[FaceSpec], Integral]
    light: Callable[[FaceSpec], Light]
    shading: Callable[[FaceSpec, Integral, Light], Shading]
    rendering: Callable[[FaceSpec], RayRendering]
