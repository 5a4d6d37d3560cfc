"""The base colour of standard shaders, once the layer is known, and the F0 that leaves room for one.

Symbols as in standard_fit.py. The base colour is r a, and r is not negative. In a bright room black hair reflects less
than a layer with the F0 of keratin would on its own: what varies with the view gives that F0, because its base colour
is eliminated there with either sign. The photos leave less for it:

    F0 <= pooled sum of w S (I - B - r_min m) over that of w S A,   m = a S (1 - R)

at each place, so the F0 of a material is at most what a share DARK of its places exceed. Then r follows by linear least
squares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.lighting import standard
from pipeline.meshes import F64, Mask
from pipeline.smoothing import Smoother
from stages.bake.standard_seen import ALPHAS, Lit, Seen

CORRECTION = (0.4, 2.5)  # limits of r
DARK = 0.25  # share of a group's places that may be darker than its layer leaves room for


@dataclass(frozen=True, slots=True)
class Layers:
    """What a layer reflects of the light at M observations. mirror, rim (M, 3): A and B; cosine (M,)."""

    mirror: F64
    rim: F64
    cosine: F64


def layers(normals: F64, seen: Seen, lit: Lit, f0: F64, roughness: F64) -> Layers:
    """At the vertices with a layer, f0 (V,) > 0, for the listed width next to roughness (V,); 0 at the others, and in
    cross-polarised photos."""
    v = seen.vertex
    mirror, rim = np.zeros((len(v), 3)), np.zeros((len(v), 3))
    k = np.abs(ALPHAS[None] - (roughness**2)[:, None]).argmin(1)[v]
    for one in np.unique(k) if seen.mirror is None else ():
        rows = np.flatnonzero((k == one) & (f0[v] > 0))
        lobes = lit.lobes(rows, ALPHAS[one : one + 1])[:, 0]
        mirror[rows], rim[rows] = lobes[:, 0], lobes[:, 1]
    return Layers(mirror, rim, (normals[v] * seen.wo).sum(1))


def _under(seen: Seen, lit: Lit, of: Layers, albedo: F64, f0: F64, roughness: F64) -> F64:
    """m (M, 3): what the field's albedo shows under the layer."""
    v = seen.vertex
    kept = 1 - standard.layer(of.cosine, f0[v], roughness[v] ** 2)
    return np.asarray(albedo[v] * lit.shade * kept[:, None])


def room_for_layer(
    smooth: Smoother, of: Layers, albedo: F64, seen: Seen, w: F64, lit: Lit, f0: F64, roughness: F64, own: Mask
) -> float:
    """The F0 of a group own (V,) at which r falls below its limit in a share DARK of the vertices that are seen;
    infinite where none is."""
    m = _under(seen, lit, of, albedo, f0, roughness)
    room, taken = (
        np.bincount(seen.vertex, w * (lit.shade * z).sum(1), len(f0)).astype(np.float64)
        for z in (seen.colour - of.rim - CORRECTION[0] * m, of.mirror)
    )
    known = own & (taken > 0)
    if not known.any():
        return np.inf
    room, taken = smooth(np.stack([room, taken], 1)).T
    return float(np.quantile(room[known] / np.maximum(taken[known], 1e-30), DARK).clip(0))


def correction(
    smooth: Smoother, of: Layers, albedo: F64, seen: Seen, w: F64, lit: Lit, f0: F64, roughness: F64, pull: F64
) -> F64:
    """r (V, 3) = pooled sum of w m (I - specular) over that of w m^2, m = a S (1 - R), drawn to 1 by pull (V,) >= 0;
    1 where nothing is seen."""
    v, count = seen.vertex, len(f0)
    specular = np.where(f0[v, None] > 0, f0[v, None] * of.mirror + of.rim, 0.0)  # without a layer no rim
    m = _under(seen, lit, of, albedo, f0, roughness)
    above, below = (
        np.stack([np.bincount(v, w * z[:, i], count) for i in range(3)], 1).astype(np.float64)
        for z in (m * (seen.colour - specular), m * m)
    )
    dark = albedo**2 + 1e-12  # so that the pull to 1 does not depend on how dark the surface is
    typical = 1e-3 * dark * (below / dark)[below > 0].mean() if (below > 0).any() else np.ones(1)
    r = ((smooth(above) + typical) / (smooth(below) + typical)).clip(*CORRECTION)
    return np.asarray((r + pull[:, None]) / (1 + pull[:, None]))
