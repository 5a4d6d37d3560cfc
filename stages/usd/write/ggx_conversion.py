"""Converts NeuFace's specular lobe to GGX: a lookup table for the basis, and the error of the conversion.

Symbols
    c           n.v
    s           1 / kappa
    F(c)        sum_j rho c_j B_j(c): reflectance of the fitted lobe under constant light
    R(c)        reflectance of a GGX lobe of F0 and alpha(kappa) under it: F0 a(c, alpha) + b(c, alpha); 0 without a
                layer, which is where F0 is 0

A dielectric layer in a shader reflects `tint` R(c), with the R of its own index of refraction. So the tint that gives
exactly F is sum_j rho c_j B_j(c) / R(c, alpha(s)): linear in the coefficients, with a table over (c, s).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.map_lookup import lookup
from pipeline.maths import ggx_width, microfacet

F32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

REFERENCE_IOR = 1.5
REFERENCE_F0 = ((REFERENCE_IOR - 1) / (REFERENCE_IOR + 1)) ** 2
INV_KAPPA_SCALE = 2.0  # the table's v is this times 1/kappa: 1/kappa up to 0.5, beyond which alpha is clamped
ROWS = 64
COSINES = (np.arange(16) + 0.5) / 16  # at which F and R are compared
NO_LOBE = 1e-6  # reflectance under constant light: below it there is no lobe
GROUP = 3  # coefficients in one picture: red, green, blue
RESOLVED_KAPPA = 50.0  # light of order 10 does not resolve sharper lobes


@dataclass(frozen=True, slots=True)
class LobeFit:
    """residual (H, W): |F - R| over |F|, root mean square over c weighted by c; 0 where there is no lobe.
    unresolved (H, W): the light does not determine kappa.
    covered (H, W): texels under charts.
    error, power: |F - R|^2 and |F|^2, sums over the covered texels."""

    residual: F32
    unresolved: Mask
    covered: Mask
    error: float
    power: float

    def shown(self, step: int = 1) -> tuple[F32, Mask]:
        """(N,) residual and unresolved of every step-th covered texel."""
        return self.residual[self.covered][::step], self.unresolved[self.covered][::step]


def fit_figures(fits: Sequence[LobeFit]) -> dict[str, float]:
    """Figures over the covered texels of all tiles, for the report.

    ggx_residual: |F - R| over |F|, both summed first, so that a texel counts by its reflectance. (The mean of the
    texels' ratios would depend mainly on texels with almost no lobe.)"""
    if not fits:
        return {}
    shown, unresolved = (np.concatenate(p) for p in zip(*(f.shown(len(fits)) for f in fits), strict=True))
    power = sum(f.power for f in fits)
    figures = {
        "ggx_residual": float(np.sqrt(sum(f.error for f in fits) / power)) if power > 0 else 0.0,
        "ggx_residual_mean": float(shown.mean(dtype=np.float64)) if shown.size else 0.0,
        "ggx_residual_p95": float(np.percentile(shown, 95)) if shown.size else 0.0,
        "kappa_unresolved_share": float(unresolved.sum() / max(unresolved.size, 1)),
    }
    return {k: round(v, 5) for k, v in figures.items()}


def basis_table(basis: F32) -> F32:
    """(ROWS, W, k) B_j(c) / R(c, alpha(s)) of a dielectric of REFERENCE_IOR; row 0 is s = 0.5 (v = 1), as in pictures.

    basis (W, k): B_j at c = (i + 0.5) / W.
    """
    width = len(basis)
    c = (np.arange(width) + 0.5) / width
    s = (1 - (np.arange(ROWS) + 0.5) / ROWS) / INV_KAPPA_SCALE
    alpha = ggx_width.best_fit_alpha(1 / s)
    a, b = microfacet.split_albedo(c[None], alpha[:, None])
    reflected = REFERENCE_F0 * a + b
    return np.asarray(basis[None].astype(np.float64) / reflected[..., None], np.float32)


def in_groups(image: F32) -> list[F32]:
    """Split (H, W, k) into pictures (H, W, 3) for colour textures, padded with 0."""
    count = -(-image.shape[2] // GROUP)
    padded = np.zeros((*image.shape[:2], count * GROUP), np.float32)
    padded[..., : image.shape[2]] = image
    return [np.ascontiguousarray(padded[..., i * GROUP : (i + 1) * GROUP]) for i in range(count)]


def lobe_fit(coefficients: F32, inv_kappa: F32, f0: F32, basis: F32, covered: Mask) -> LobeFit:
    """Error of GGX against the fitted lobe. coefficients (H, W, k); inv_kappa, f0, covered (H, W); basis (W, k)."""
    residual = np.zeros(covered.shape, np.float32)
    errors = powers = 0.0
    weights = COSINES / COSINES.sum()
    at = lookup(basis, COSINES).T.astype(np.float64)  # (k, 16)
    rows, columns = np.nonzero(covered)
    sharpest, roughest = (float(ggx_width.best_fit_alpha(k)) for k in ggx_width.KAPPA_RANGE[::-1])
    table_alpha = np.linspace(sharpest, roughest, 24)
    a, b = microfacet.split_albedo(COSINES[None], table_alpha[:, None])
    for some in np.array_split(np.arange(len(rows)), max(1, len(rows) // 200_000)):
        y, x = rows[some], columns[some]
        fitted = coefficients[y, x].astype(np.float64) @ at
        alpha = ggx_width.best_fit_alpha(1 / np.maximum(inv_kappa[y, x].astype(np.float64), 1e-9))
        ggx = f0[y, x, None].astype(np.float64) * _rows_at(a, table_alpha, alpha) + _rows_at(b, table_alpha, alpha)
        ggx[f0[y, x] <= 0] = 0.0  # no layer, so no rim either
        error = ((fitted - ggx) ** 2 * weights).sum(1)
        scale = (fitted**2 * weights).sum(1)
        errors, powers = errors + float(error.sum()), powers + float(scale.sum())
        residual[y, x] = np.where(scale > NO_LOBE**2, np.sqrt(error / np.maximum(scale, NO_LOBE**2)), 0)
    unresolved = covered & (inv_kappa < 1 / RESOLVED_KAPPA)
    return LobeFit(residual, unresolved, covered, errors, powers)


def _rows_at(
    table: npt.NDArray[np.float64], places: npt.NDArray[np.float64], x: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(N, columns) rows of `table` at evenly spaced `places`, interpolated linearly."""
    t = ((x - places[0]) / (places[1] - places[0])).clip(0, len(places) - 1)
    low = np.minimum(t.astype(np.int64), len(places) - 2)
    f = (t - low)[:, None]
    return np.asarray(table[low] * (1 - f) + table[low + 1] * f)
