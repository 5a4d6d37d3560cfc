"""Interface of a fitted field for the stages after the fit, in plain arrays.

Points are (N, 3) in asset coordinates. Calls are split into chunks inside, so any N is possible. There are no
gradients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:  # stages are listed without torch
    from pipeline.lighting.moving import MovingLight

F32 = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Material:
    """Appearance at N points.

    albedo: (N, 3) linear reflectance in [0, 1]. rho: (N,) specular intensity in [0, 1]. coefficients: (N, k), the
    c_j(x) of [NeuFace eq. 7]. inv_kappa: (N,) 1/kappa > 0, the lobe's width in [NeuFace eq. 10].
    """

    albedo: F32
    rho: F32
    coefficients: F32
    inv_kappa: F32


class Field(Protocol):
    """A fitted face (see pipeline.fields.face.load_face), or a replacement with the same interface."""

    @property
    def bounds(self) -> tuple[F32, F32]:
        """(3,) lower and (3,) upper corner of the box in which the SDF is defined."""
        ...

    @property
    def cell(self) -> float:
        """Edge of the finest SDF cell."""
        ...

    @property
    def rank(self) -> int:
        """k, the number of specular bases."""
        ...

    @property
    def light(self) -> F32:
        """(121, 3) real orthonormal SH coefficients of the captured light, index l(l+1)+m; of a light that moves, those
        of its still stand-in."""
        ...

    @property
    def moving_light(self) -> MovingLight | None:
        """The light that moves with the camera, if it does."""
        ...

    @property
    def colour_responses(self) -> F32 | None:
        """(views, 3, 3) A_n of the fitted photos [NeuFace eq. 19]; None if the field has none."""
        ...

    def sdf(self, points: F32) -> F32:
        """(N,) signed distance, negative inside."""
        ...

    def sdf_and_gradient(self, points: F32) -> tuple[F32, F32]:
        """(N,) signed distance and its gradient (N, 3), outward, about unit length near the surface."""
        ...

    def material(self, points: F32) -> Material:
        """Appearance; meaningful within a few cells of the surface."""
        ...

    def irradiance_ratio(self, points: F32) -> F32:
        """(N, 3) irradiance at the surface over that without shadows and interreflections; 1 if they are not modelled.
        For the captured light."""
        ...

    def basis(self, wo: F32, normal: F32) -> F32:
        """(N, k) integrated bases B_j(wo, n) >= 0 of [NeuFace eq. 9]; both (N, 3), unit; wo leaves the surface."""
        ...
