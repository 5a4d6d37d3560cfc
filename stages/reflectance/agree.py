"""How far the surface has to move at each vertex so that the cameras that see it agree on what they see there.

    cost(d) = mean over pairs of cameras c, k of   w_c w_k min(|N_c - N_k|^2 / s_N^2 + |log a_c - log a_k|^2 / s_a^2, M)

Symbols
    d            way along the vertex's normal
    N_c, a_c     normal and albedo in camera c's map (answers.py) where the moved vertex is seen
    w_c          N_c . v: a camera that looks along the surface says little
    s_N, s_a, M  what they may differ by; the most that one pair can cost
All lights together say far more of a point than one photo's patch does: also bare skin has a normal everywhere. The
costs of neighbours are averaged. The curvature of the cost at its minimum is how well d is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.meshes import unit
from pipeline.transforms import F64
from stages.reflectance.answers import AnswerMap

NORMALS, ALBEDOS = 0.05, 0.12  # radians; of the logarithm
MOST = 12.0  # of one pair
BAD = 6.0  # minima that cost more say nothing
AVERAGES = 3  # times that costs are averaged over neighbours
LEAST = 0.02  # sum of w_c w_k of a vertex, from which the cost is used
SHARPEST = 4e-4  # asset units (metres): no place is known better


def ways(
    vertices: F64, normals: F64, seen: npt.NDArray[np.bool_], maps: Sequence[AnswerMap], mean: Any, tried: F64
) -> tuple[F64, F64]:
    """(V,) the ways along the normals, and (V,) the curvature there, 0 where nothing is known.

    vertices, normals (V, 3); seen (C, V): by each map's camera; mean: sparse (V, V) average over neighbours; tried
    (K,): ascending, equally spaced.
    """
    cost = np.stack([_cost(vertices + d * normals, seen, maps) for d in tried], 1)
    known = np.asarray(np.isfinite(cost).all(1), np.bool_)
    total, share = np.where(known[:, None], cost, 0), known.astype(np.float64)
    for _ in range(AVERAGES):
        total, share = mean @ total, mean @ share
    return _lowest(total / np.maximum(share, 1e-9)[:, None], known, tried)


def _cost(points: F64, seen: npt.NDArray[np.bool_], maps: Sequence[AnswerMap]) -> F64:
    """(V,) cost; NaN where fewer than two cameras see the point."""
    found = []
    for visible, one in zip(seen, maps, strict=True):
        normal, albedo, known = one.at(points)
        facing = np.clip((normal * unit(one.camera.eye - points)).sum(1), 0, 1)
        found.append((normal, albedo, facing * known * visible))
    total, weight = np.zeros(len(points)), np.zeros(len(points))
    for k, (normal, albedo, own) in enumerate(found):
        for other_normal, other_albedo, other in found[:k]:
            both = own * other
            off = ((normal - other_normal) ** 2).sum(1) / NORMALS**2
            off += ((albedo - other_albedo) ** 2).sum(1) / ALBEDOS**2
            total += both * np.minimum(off, MOST)
            weight += both
    return np.asarray(np.where(weight > LEAST, total / np.maximum(weight, 1e-9), np.nan), np.float64)


def _lowest(cost: F64, known: npt.NDArray[np.bool_], tried: F64) -> tuple[F64, F64]:
    """Minima (V,) of costs (V, K) by a parabola through three values, and the curvature there. At either end of what
    was tried there is no minimum."""
    spacing, every = tried[1] - tried[0], np.arange(len(cost))
    best = cost.argmin(1)
    inner = (best > 0) & (best < len(tried) - 1)
    best = np.clip(best, 1, len(tried) - 2)
    before, least, after = cost[every, best - 1], cost[every, best], cost[every, best + 1]
    curvature = np.maximum((before - 2 * least + after) / spacing**2, 1e-12)
    way = tried[best] - np.clip((after - before) / (2 * spacing) / curvature, -0.5 * spacing, 0.5 * spacing)
    trust = np.minimum(curvature, 1 / SHARPEST**2) * np.clip(1 - least / BAD, 0, 1)
    return np.asarray(way, np.float64), np.asarray(np.where(known & inner, trust, 0.0), np.float64)
