"""The reference renderer of the exported material (standard.py) under a light that moves with the camera.

The light's two parts are cut into lamps once, the moving one in its own frame. For the points of one photo, normals and
directions are turned into that frame, so that the same lamps serve all photos. Nothing casts shadows and nothing is
reflected from one part of the subject to another, as in the fit under such a light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.lighting import ggx_kernels as kernels
from pipeline.lighting import standard
from pipeline.lighting.dome import environment
from pipeline.lighting.median_cut import lamps
from pipeline.lighting.moving import MovingLight, Standpoint

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

WIDTH = 256  # columns of the picture that is cut into lamps
CARRIED, AMBIENT = 256, 64  # lamps of the moving and of the still part


@dataclass(frozen=True, slots=True)
class _Points:
    """Normals and directions to the eye (N, 3) in the frame of the lamps, and the lamps' strength (N, 1)."""

    normal: F32
    wo: F32
    strength: F64


class MovingLamps:
    """A moving light as lamps; every method is for points x with unit normals n (N, 3) in the photo of one camera."""

    def __init__(self, light: MovingLight) -> None:
        self.light = light
        parts = ((light.coefficients, CARRIED), (light.ambient, AMBIENT))
        self._lamps = [_arrivals(coefficients, count) for coefficients, count in parts]

    def irradiance(self, x: F32, n: F32, eye: Standpoint) -> F32:
        """(N, 3), at least 0."""
        return np.asarray(self.light.irradiance(x, n, eye).clip(min=0), np.float32)

    def lobes(self, x: F32, n: F32, eye: Standpoint, alphas: F32) -> F32:
        """(N, K, 2, 3) specular radiance for K widths: the layer of F0 reflects F0 [:, :, 0] + [:, :, 1]."""
        out = np.zeros((len(x), len(alphas), 2, 3), np.float32)
        first = np.zeros(len(x), np.int64)
        for at, p in zip(self._lamps, self._turned(x, n, eye), strict=True):
            if at is not None:
                found = standard.lobes(at, first, p.normal.astype(np.float64), p.wo.astype(np.float64), alphas)
                out += found * p.strength[:, :, None, None].astype(np.float32)
        return out

    def radiance(self, x: F32, n: F32, eye: Standpoint, base: F32, f0: F32, roughness: F32) -> F64:
        """(N, 3) towards the eye. base (N, 3); f0, roughness (N,)."""
        alpha = np.maximum(roughness**2, standard.LEAST_ALPHA).astype(np.float32)
        corner, weights = np.zeros((len(x), 3), np.int32), np.tile(np.array([1, 0, 0], np.float32), (len(x), 1))
        specular = np.zeros((len(x), 3))
        for at, p in zip(self._lamps, self._turned(x, n, eye), strict=True):
            if at is not None:
                unused, own = (np.empty((len(x), 3), np.float32) for _ in range(2))
                share = standard.shares((p.normal * p.wo).sum(1), alpha).astype(np.float32)
                kernels.shade(
                    p.normal, p.wo, corner, weights, f0.astype(np.float32), alpha, at.flux, at.lamp, share, unused, own
                )
                specular += own * p.strength
        away = eye.centre - x
        cosine = (n * away).sum(1) / np.linalg.norm(away, axis=1).clip(min=1e-12)
        kept = 1 - standard.layer(cosine, f0, alpha)
        matt = kept[:, None] * base / np.pi * self.irradiance(x, n, eye)
        return np.asarray(matt + np.where(f0[:, None] > 0, specular, 0), np.float64)

    def _turned(self, x: F32, n: F32, eye: Standpoint) -> tuple[_Points, _Points]:
        """The points for the moving part and for the still one."""
        normal, wo, turn = self.light.turned(x, n, eye)
        still = _Points(normal.numpy(), wo.numpy(), np.ones((len(x), 1)))
        n_c, wo_c = (np.ascontiguousarray(turn(d).numpy()) for d in (normal, wo))
        return _Points(n_c, wo_c, turn.strength.double().numpy()), still


def _arrivals(coefficients: F32, count: int) -> standard.Arrivals | None:
    """Lamps that arrive alike everywhere; None for a light that is dark."""
    picture = environment(coefficients, WIDTH)
    if not picture.max() > 0:
        return None
    lit = lamps(picture, count)
    flux = np.ascontiguousarray(lit.flux[None], np.float32)
    return standard.Arrivals(flux, standard.table(lit), np.zeros((1, 3), np.float32))
