"""Slow variation of the colour of skin that belongs to the light and not to the skin.

The light that arrives at skin is not known exactly: near lamps, shadows that the fit lacks, light from cheek to neck.
The error varies slowly along the surface, and the base colour takes it in: in the photos' own light nobody sees it,
under any other light one cheek is pale and the other dark. Real skin varies slowly as well: stubble, a red nose. But
that is nearly the same on both sides of a face, and a light from a side is not. So the difference of the two sides
tells how large the error is, and as large an error is assumed in what both sides share.

Symbols: u slow part of the log luminance, or of the chromaticity, of the base colour: its mean within WIDTH; x' the
place of x on the other side (pipeline/registration/other_side.py);

    a = (u(x) - u(x')) / 2      s = (u(x) + u(x')) / 2 - mean
    A, S                        area-weighted means of a^2 and s^2 over skin that is seen on both sides
    e^2 = max(A - t^2, 0)       variance of the error, t the usual difference of two sides

If signal and error are Gaussian and independent, the best guess of the error (Wiener) is e^2 / A of a and
min(e^2, S) / S of s. That goes from the base colour, times `part`: what is taken out here the photos no longer have in
their own light. Skin whose other side is not seen has the share of s. Lips and lids are left alone. The mean luminance
of the skin stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.colour import LUMA
from pipeline.meshes import F64, Indices, Mask, Mesh, vertex_areas
from pipeline.registration.other_side import OtherSide
from pipeline.smoothing import Smoother

WIDTH = 0.006  # metres: standard deviation of the mean
EDGE = 0.004  # metres: over which the change ends at what is no skin
USUAL = 0.045, 0.03  # t of log luminance and of chromaticity: heads under an even light have .047, .058 and .020, .028
CLOSE = 0.004  # metres: seen skin so close to x' is the other side
LEAST = 1e-4  # albedo, below which it counts as that
MIN_SHARE = 0.3  # of the skin's area that must be seen on both sides, so that these tell for all of it


@dataclass(frozen=True, slots=True)
class Evened:
    """factor (V, 3) of the base colour, positive, 1 away from skin. figures: for the report."""

    factor: F64
    figures: dict[str, float]


Even = Callable[[Mask, F64], Evened]  # of seen skin (V,) and the base colour (V, 3)


def evening(mesh: Mesh, skin: Mask, albedo: F64, *, other: OtherSide, part: float) -> Evened:
    """skin (V,): seen skin; albedo (V, 3) linear; other: of the mesh's vertices; part in [0, 1]."""
    unchanged = Evened(np.ones((len(skin), 3)), {})
    own = skin & other.plain
    if not own.any():
        return unchanged
    area = vertex_areas(mesh.vertices, mesh.faces) * own
    twin, both = _twins(mesh, own, other)
    if area[both].sum() <= MIN_SHARE * area.sum():
        return unchanged
    colour = np.maximum(albedo, LEAST)
    luminance = colour @ np.array(LUMA)
    y = np.log(luminance)[:, None]
    slow = Smoother(mesh, WIDTH).mean(np.concatenate([y, np.log(colour) - y], 1), own.astype(np.float64))
    error = np.zeros_like(albedo)
    figures: dict[str, float] = {}
    for name, u, usual in zip(("luminance", "chromaticity"), (slow[:, :1], slow[:, 1:]), USUAL, strict=True):
        found = _error(u, twin, both, area, usual)
        error += found.error
        figures |= {f"skin_{name}_sides": found.sides, f"skin_{name}_error": found.level}
    soft = Smoother(mesh, EDGE)(np.concatenate([own[:, None] * error, own[:, None]], 1))
    factor = np.exp(-part * soft[:, :3])
    kept = (area @ luminance) / (area @ ((colour * factor) @ np.array(LUMA)))
    return Evened(factor * kept ** soft[:, 3:].clip(0, 1), {k: round(v, 4) for k, v in figures.items()})


def _twins(mesh: Mesh, own: Mask, other: OtherSide) -> tuple[Indices, Mask]:
    """(V,) the vertex of skin that is nearest to the other side of each, and (V,) which of the skin is seen there."""
    skin = np.flatnonzero(own)
    distance, nearest = cKDTree(mesh.vertices[skin]).query(other.where)
    return skin[nearest], own & other.on_head & (distance <= CLOSE)


@dataclass(frozen=True, slots=True)
class _Found:
    """error (V, C): the best guess; sides: sqrt(A); level: e."""

    error: F64
    sides: float
    level: float


def _error(u: F64, twin: Indices, both: Mask, area: F64, usual: float) -> _Found:
    """Of u (V, C), with the twin of each vertex, where both sides are seen, and their areas (V,)."""
    mean = np.average(u, axis=0, weights=area)
    weight = area * both
    across, along = (u - u[twin]) / 2, (u + u[twin]) / 2 - mean
    a, s = (float(np.average((z * z).sum(1), weights=weight)) for z in (across, along))
    of_a, of_s = shares(a, s, usual)
    error = np.where(both[:, None], of_a * across + of_s * along, of_s * (u - mean))
    return _Found(error, float(np.sqrt(a)), float(np.sqrt(of_a * a)))


def shares(across: float, along: float, usual: float) -> tuple[float, float]:
    """Shares, in [0, 1], of a and of s that are error, by A = across and S = along, both >= 0, and t = usual."""
    level = max(across - usual**2, 0.0)
    return level / across if level else 0.0, min(level, along) / along if level and along else 0.0
