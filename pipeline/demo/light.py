"""The studio of the demo capture: soft boxes and a fill, strictly band-limited and positive everywhere.

Symbols
    w       unit direction towards the light, (N, 3), world frame (+Y up, +Z out of the face)
    Y       real orthonormal spherical harmonics, (N, 121), column l (l + 1) + m, l <= 10
    c       coefficients of the light, (121, 3), linear RGB radiance
    K       positive zonal kernel of degree 10, integral one over the sphere

    Y_lm = sqrt(2) N_lm P_l^|m|(z) cos(m phi)     m > 0         phi is the angle from +x towards +y
    Y_lm = sqrt(2) N_lm P_l^|m|(z) sin(|m| phi)   m < 0         no Condon-Shortley sign, so that
    Y_l0 = N_l0 P_l(z)                                          Y_1 = sqrt(3 / 4 pi) (y, z, x)

The polar axis of the harmonics is the world's z axis, although the world's up is y.

    K(t) = a (sum_{l <= 5} (2 l + 1) P_l(t))^2    c_lm = k_l sum_j b_j Y_lm(w_j)    k_l = 2 pi int K P_l dt

A square is never negative, and a sum of kernels with positive weights b_j stays so: the light is positive
by construction, and of degree 10 exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import eval_legendre, sph_legendre_p_all

F64 = npt.NDArray[np.float64]

DEGREE = 10
COEFFICIENTS = (DEGREE + 1) ** 2


@dataclass(frozen=True, slots=True)
class SoftBox:
    """A rectangular lamp: centre direction, full width and height in radians, radiance in linear RGB."""

    towards: tuple[float, float, float]
    width: float
    height: float
    radiance: tuple[float, float, float]


STUDIO = (
    SoftBox((0.62, 0.42, 0.66), 0.75, 1.00, (7.2, 6.9, 6.6)),
    SoftBox((-0.80, 0.10, 0.60), 0.70, 1.10, (3.1, 3.2, 3.3)),
    SoftBox((-0.55, 0.45, -0.70), 0.60, 0.90, (4.2, 4.2, 4.3)),
    SoftBox((0.85, 0.15, -0.50), 0.45, 0.90, (3.4, 3.3, 3.2)),
    SoftBox((0.00, 1.00, 0.15), 0.90, 0.90, (2.4, 2.4, 2.4)),
)
FILL = (0.30, 0.30, 0.31)
"""Radiance that comes from everywhere."""

_SAMPLES = 24  # points along each side of a soft box


def real_basis(directions: F64) -> F64:
    """Real orthonormal harmonics (N, 121) at unit `directions` (N, 3)."""
    x, y, z = directions.T
    azimuth = np.arctan2(y, x)
    legendre = np.asarray(sph_legendre_p_all(DEGREE, DEGREE, np.arccos(np.clip(z, -1.0, 1.0))))
    legendre = legendre.reshape(DEGREE + 1, 2 * DEGREE + 1, len(directions))
    basis = np.empty((COEFFICIENTS, len(directions)))
    for order in range(DEGREE + 1):
        # scipy carries the Condon-Shortley sign; this basis does not.
        scale = 1.0 if order == 0 else np.sqrt(2.0) * (-1.0) ** order
        cosine, sine = scale * np.cos(order * azimuth), scale * np.sin(order * azimuth)
        for degree in range(order, DEGREE + 1):
            centre = degree * (degree + 1)
            basis[centre - order] = legendre[degree, order] * sine
            basis[centre + order] = legendre[degree, order] * cosine
    return np.ascontiguousarray(basis.T)


def kernel_bands() -> F64:
    """Legendre coefficients k_l (11,) of the positive kernel K, with k_0 = 1."""
    # Degree 10 times degree 10 is integrated exactly by 16 Gauss points.
    t, weight = np.polynomial.legendre.leggauss(16)
    kernel = sum((2 * degree + 1) * eval_legendre(degree, t) for degree in range(DEGREE // 2 + 1)) ** 2
    bands = np.array([np.sum(weight * kernel * eval_legendre(degree, t)) for degree in range(DEGREE + 1)])
    return np.asarray(bands / bands[0])


def studio_coefficients(scale: float = 1.0) -> F64:
    """Coefficients (121, 3) of the studio, times `scale`."""
    total = np.zeros((COEFFICIENTS, 3))
    for box in STUDIO:
        directions, solid_angle = _box_points(box)
        projected = real_basis(directions).T @ solid_angle
        total += projected[:, None] * np.asarray(box.radiance)
    degree = np.repeat(np.arange(DEGREE + 1), 2 * np.arange(DEGREE + 1) + 1)
    total *= kernel_bands()[degree][:, None]
    total[0] += np.sqrt(4.0 * np.pi) * np.asarray(FILL)
    return np.asarray(total * scale)


def radiance(coefficients: F64, directions: F64) -> F64:
    """Radiance (N, 3) from unit `directions` (N, 3)."""
    return np.asarray(real_basis(directions) @ coefficients)


def lat_long_directions(height: int) -> F64:
    """Directions (H, 2 H, 3) of a lat-long's pixel centres.

    Row 0 is next to +Y; the centre columns look along +Z; columns grow towards -X.
    """
    polar = (np.arange(height) + 0.5) * np.pi / height
    turn = (np.arange(2 * height) + 0.5) * np.pi / height - np.pi
    sine = np.sin(polar)[:, None]
    rows = [-sine * np.sin(turn), np.cos(polar)[:, None] * np.ones_like(turn), sine * np.cos(turn)]
    return np.stack(rows, axis=-1)


def lat_long(coefficients: F64, height: int) -> npt.NDArray[np.float32]:
    """Lat-long picture (H, 2 H, 3) of the light, sampled at pixel centres."""
    directions = lat_long_directions(height)
    values = radiance(coefficients, directions.reshape(-1, 3))
    return values.reshape(directions.shape).astype(np.float32)


def _box_points(box: SoftBox) -> tuple[F64, F64]:
    """Directions (n, 3) on a soft box and the solid angle (n,) that each stands for."""
    centre = np.asarray(box.towards) / np.linalg.norm(box.towards)
    side = np.cross((0.0, 1.0, 0.0) if abs(centre[1]) < 0.9 else (0.0, 0.0, 1.0), centre)
    side /= np.linalg.norm(side)
    up = np.cross(centre, side)
    grid = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    u, v = np.meshgrid(grid * 2 * np.tan(box.width / 2), grid * 2 * np.tan(box.height / 2), indexing="ij")
    plane = centre + u.reshape(-1, 1) * side + v.reshape(-1, 1) * up
    length = np.linalg.norm(plane, axis=1)
    area = 4 * np.tan(box.width / 2) * np.tan(box.height / 2) / _SAMPLES**2
    return np.asarray(plane / length[:, None]), np.asarray(area / length**3)
