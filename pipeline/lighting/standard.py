"""The reference renderer of the exported material: OpenPBR's dielectric layer over a diffuse base, under lamps.

    L(wo) = (1 - R(n.v)) b / pi sum_k E_k max(n.w_k, 0)  +  sum_k f_s(w_k, wo) E_k max(n.w_k, 0)

Symbols
    b          base colour
    w_k, E_k   lamp k: direction, and the irradiance that arrives from there on a facing surface: the lamp's own, or,
               where the subject is in the way, the light that leaves the subject there
    f_s        GGX reflection of F0 and alpha = roughness^2 (ggx_kernels.py)
    R(n.v)     F0 a + b, the share that the layer reflects under a uniform light (maths/microfacet.py): what is left of
               the light reaches the base. Blender's Principled shader and MaterialX layer in the same way.
A material without a layer (F0 = 0) has no rim either: it is a Lambertian surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from pipeline.lighting import ggx_kernels as kernels
from pipeline.lighting.median_cut import Lamps
from pipeline.maths import microfacet
from pipeline.ray_casting import RayCaster, neighbours_first
from pipeline.thinning import thinned

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]
Indices = npt.NDArray[np.integer]

LIFT = 1e-3  # of the subject's size: rays start this far above the surface, against self-shadowing of facets
BENEATH = 0.01  # of the subject's size: what lies less deep beneath another part of the surface is that part's
GRAZING = -0.2  # least cosine of lamps at a vertex: others can't light its triangles' interpolated normals
BESIDE = -0.5  # the same where a vertex lends its light to its neighbours, whose normals differ more
BOUNCES = 3
COUNT = 384  # lamps of a captured dome: GGX radiance within 3 % of quadrature at roughness .5, 5 % at .35 (tests)
SIDE = 64  # entries of the table of R over n.v and over roughness
LEAST_ALPHA = 0.01
BLOCK = 4096  # vertices


@dataclass(frozen=True, slots=True)
class Arrivals:
    """flux (V, N, 3) of each lamp's direction at the vertices; lamp (5, N): `table` of the lamps; irradiance (V, 3)."""

    flux: F32
    lamp: F32
    irradiance: F32


def arrivals(
    vertices: F32, normals: F32, faces: I32, lit: Lamps, albedo: F64, check: Callable[[], None] = lambda: None
) -> Arrivals:
    """Trace the lamps from every vertex, of a dense mesh from every third. albedo (V, 3): of the diffuse light between
    the subject's own parts."""
    n = np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12), np.float64)
    thin = thinned(len(n), faces)
    if thin is None:
        flux, total = _traced(vertices, n, faces, lit, albedo, np.arange(len(n)), lambda x: x, GRAZING, check)
    else:
        own = np.flatnonzero(thin.chosen)
        flux, total = _traced(vertices, n, faces, lit, albedo, own, thin.spread, BESIDE, check)
        flux = thin.spread(flux)
        total = _received(n, lit, flux)
    return Arrivals(flux, table(lit), total)


def _received(normals: F64, lit: Lamps, flux: F32) -> F32:
    """(V, 3) irradiance of the flux (V, N, 3), in blocks: all cosines at once take as much memory as the flux."""
    out = np.empty((len(normals), 3), np.float32)
    for i in range(0, len(normals), BLOCK):
        some = slice(i, i + BLOCK)
        out[some] = np.einsum("vn,vnc->vc", _cosines(normals[some], lit), flux[some])
    return out


def _traced(
    vertices: F32, normals: F64, faces: I32, lit: Lamps, albedo: F64, own: Indices, spread: Callable[[F32], F32],
    lowest: float, check: Callable[[], None],
) -> tuple[F32, F32]:  # fmt: skip
    """Flux (n, N, 3) and irradiance (n, 3) at the vertices `own` (n,). spread: from them to all; lowest: cosine from
    which lamps are traced."""
    n = normals[own]
    caster = RayCaster(vertices, faces)
    starts, order = _starts(caster, vertices, faces, own, n), neighbours_first(vertices[own])
    flux = np.zeros((len(n), len(lit.directions), 3), np.float32)
    rows: list[Indices] = []
    lamps: list[Indices] = []
    hit: list[Indices] = []
    for k, w in enumerate(lit.directions):
        if k % 32 == 0:
            check()
        live = order[(n @ w > lowest)[order]]
        face = caster.first_faces(starts[live], np.broadcast_to(w, (len(live), 3)))
        flux[live[face < 0], k] = lit.flux[k]
        rows, lamps, hit = [*rows, live[face >= 0]], [*lamps, np.full((face >= 0).sum(), k)], [*hit, face[face >= 0]]
    row, lamp, face = np.concatenate(rows), np.concatenate(lamps), np.concatenate(hit)
    cosine = _cosines(n, lit)
    direct = np.einsum("vn,vnc->vc", cosine, flux)
    total, sent = direct, np.zeros((len(row), 3), np.float32)
    for _ in range(BOUNCES):
        leaving = (albedo / np.pi * spread(total))[faces].mean(1).astype(np.float32)
        sent = leaving[face] * lit.solid[lamp, None]
        more = [np.bincount(row, sent[:, i] * cosine[row, lamp], len(n)) for i in range(3)]
        total = direct + np.stack(more, 1).astype(np.float32)
    flux[row, lamp] = sent
    return flux, total


def _starts(caster: RayCaster, vertices: F32, faces: I32, own: Indices, normals: F64) -> F64:
    """(n, 3) where rays of the vertices `own` (n,) start: above the surface. normals (n, 3).

    A vertex just beneath another part of the surface, as the rim of hair and clothes beneath the skin, gets the light
    of the place above it. No light reaches it, but its triangles come out beside it and would be dark there, and their
    base colour, which the photos give, too bright."""
    lift = LIFT * caster.span
    starts = vertices[own] + lift * normals
    far, face = caster.hits(starts, normals)
    a, b, c = np.moveaxis(vertices[faces[face]], 1, 0)
    leaves = (np.cross(b - a, c - a) * normals).sum(1) > 0
    beneath = (far < BENEATH * caster.span) & leaves
    starts[beneath] += (far[beneath, None] + lift) * normals[beneath]
    return starts


def _cosines(normals: F64, lit: Lamps) -> F32:
    """(V, N) cosines to the lamps, 0 below the horizon."""
    return np.maximum(normals @ lit.directions.T.astype(np.float64), 0).astype(np.float32)


def table(lit: Lamps) -> F32:
    """(5, N) direction, spread and solid angle of lamps."""
    return np.concatenate([lit.directions.T, lit.spread[None], lit.solid[None]]).astype(np.float32)


def lobes(at: Arrivals, vertex: npt.NDArray[np.int64], normal: F64, wo: F64, alphas: F32) -> F32:
    """(M, K, 2, 3) specular radiance of M observations at vertices, for K widths: F0 [:, :, 0] + [:, :, 1]."""
    out = np.empty((len(vertex), len(alphas), 2, 3), np.float32)
    share = shares((normal * wo).sum(1)[:, None], np.asarray(alphas)[None])
    order = np.argsort(vertex, kind="stable")
    kernels.lobes(order, vertex, _f32(normal), _f32(wo), at.flux, at.lamp, _f32(alphas), _f32(share), out)
    return out


def shares(cosine: npt.NDArray[np.floating], alpha: npt.NDArray[np.floating]) -> F64:
    """(2, ...) a and b of the layer's reflected share F0 a + b, bilinear in a table."""
    return np.stack([_looked_up(t, cosine, alpha) for t in _tables()])


def layer(cosine: npt.NDArray[np.floating], f0: npt.NDArray[np.floating], alpha: npt.NDArray[np.floating]) -> F64:
    """R (M,) for n.v, F0 and alpha (M,), bilinear in a table; 0 where F0 is 0, because there is no layer."""
    return reflected(shares(cosine, alpha), f0)


def reflected(share: F64, f0: npt.NDArray[np.floating]) -> F64:
    """R (M,) of `layer` from `shares` (2, M)."""
    return np.where(np.asarray(f0) > 0, f0 * share[0] + share[1], 0.0)


def radiance(
    at: Arrivals, corner: I32, weights: F32, normal: F64, wo: F64, base: F32, f0: F32, roughness: F32
) -> tuple[F64, F64]:
    """Diffuse and specular radiance (M, 3) each, of points inside triangles. normal, wo, base (M, 3); f0, roughness
    (M,); corner, weights (M, 3)."""
    alpha = np.maximum(roughness**2, LEAST_ALPHA).astype(np.float32)
    diffuse, specular = (np.empty((len(normal), 3), np.float32) for _ in range(2))
    share = shares((normal * wo).sum(1), alpha)
    kernels.shade(
        _f32(normal), _f32(wo), corner, _f32(weights), _f32(f0), alpha, at.flux, at.lamp, _f32(share), diffuse, specular
    )
    kept = 1 - reflected(share, f0)
    return kept[:, None] * base / np.pi * diffuse, np.where(f0[:, None] > 0, specular, 0).astype(np.float64)


@lru_cache(maxsize=1)
def _tables() -> tuple[F64, F64]:
    """a and b of `microfacet.split_albedo` at n.v = (i + 1/2) / SIDE, roughness = (j + 1/2) / SIDE."""
    at = (np.arange(SIDE) + 0.5) / SIDE
    return microfacet.split_albedo(at[:, None], np.maximum(at**2, LEAST_ALPHA)[None])


def _looked_up(table: F64, cosine: npt.NDArray[np.floating], alpha: npt.NDArray[np.floating]) -> F64:
    x, y = (np.clip(np.asarray(v, np.float64) * SIDE - 0.5, 0, SIDE - 1) for v in (cosine, np.sqrt(alpha)))
    i, j = (np.minimum(v.astype(np.int64), SIDE - 2) for v in (x, y))
    u, v = x - i, y - j
    low = table[i, j] * (1 - v) + table[i, j + 1] * v
    high = table[i + 1, j] * (1 - v) + table[i + 1, j + 1] * v
    return np.asarray(low * (1 - u) + high * u)


def _f32(x: npt.NDArray[np.floating]) -> F32:
    return np.ascontiguousarray(x, np.float32)
