"""The inside of the mouth stays beneath the skin.

Photos do not show it, so that it follows the skin by its stiffness alone. On a face that is flatter than the template
it can come through the cheek beside the nose. Symbols: p a point of the inside, N its normal, into the cavity; s its
signed distance to the displaced skin, closed between the lips, negative beneath it; r its distance to the lips' inner
edge. Where

    s > -min(DEEP, EDGE r)

p moves along N by what is missing, over N's slope towards the skin; the surroundings follow smoothly. Where N leads out
of the skin, as it can at the lips' edge, p stays: moving it would show it.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from pipeline.meshes import F64, Faces, Indices, Mask, triangles_of
from pipeline.registration.head import Head
from pipeline.registration.quality import outer_quads
from pipeline.registration.shell import border_loops, fans, shell_distance

CAVITY, PASSAGE = "mouth_inside", "nostrils"  # regions: of what stays beneath, and of what is skin, but cannot be shown
DEEP = 1.5e-3  # metres of the template beneath the skin
EDGE = 0.25  # towards the lips: the flesh becomes thinner
CELL, ROOM = 1e-3, 0.012  # metres of the template: of the grid of s, and around the inside
MOST = 8e-3  # metres of the template: longest way
STEEPEST = 0.3  # cosine between N and the way from the skin, at least
ROUNDS, RINGS = 4, 3  # rounds; rings of quads that follow
SHOWN = 3e-4  # metres of the template outside of the skin from which a point counts as shown


def beneath(
    points: F64, normals: F64, moved: F64, quads: Indices, region: Indices, names: tuple[str, ...], unit: float
) -> F64:
    """(n,) what must be added to the displacement moved (n,) of points (n, 3) along normals (n, 3). quads (Q, 4) with
    region (Q,) into names; unit: world units per metre of the template."""
    more = np.zeros(len(points))
    own = _own(quads, region, names, len(points))
    if not own.any():
        return more
    surface = points + moved[:, None] * normals
    skin = quads[_skin(region, names)]
    depth = _Depth(surface, skin, surface[own], unit)
    shared = np.intersect1d(skin, quads[region == names.index(CAVITY)])
    away = cKDTree(surface[shared]).query(surface[own])[0] if len(shared) else np.full(int(own.sum()), np.inf)
    wanted = np.minimum(DEEP * unit, EDGE * away)
    inner = quads[own[quads].all(1)]
    for _ in range(ROUNDS):
        at = surface[own] + more[own, None] * normals[own]
        lack = np.maximum(depth(at) + wanted, 0.0)
        if not (lack > 1e-3 * DEEP * unit).any():
            break
        slope = (depth(at) - depth(at + CELL * unit * normals[own])) / (CELL * unit)
        step = np.zeros(len(points))
        step[own] = np.where(slope > 0, lack / slope.clip(STEEPEST, 1.0), 0.0)
        more = np.minimum(more + _spread(step, inner), MOST * unit)
    return np.where(own, more, 0.0)


def shown_through(head: Head, names: tuple[str, ...], unit: float) -> int:
    """Points of the inside of a head's mouth that lie outside of its skin. unit: world units per metre of the
    template."""
    _, _, quads = head.surface()
    region, moved = np.repeat(head.region, 4**head.levels), head.displaced()
    own = _own(quads, region, names, len(moved))
    if not own.any():
        return 0
    depth = _Depth(moved, quads[_skin(region, names)], moved[own], unit)
    return int((depth(moved[own]) > SHOWN * unit).sum())


class _Depth:
    """Signed distance to the skin near some points, negative beneath it."""

    def __init__(self, surface: F64, skin: Indices, around: F64, unit: float) -> None:
        """surface (n, 3); skin (Q, 4): its quads on the outside; around (N, 3)."""
        vertices, faces = _closed(surface, skin)
        self._lo, self._cell = around.min(0) - ROOM * unit, CELL * unit
        x, y, z = (int(n) for n in np.ceil((around.max(0) + ROOM * unit - self._lo) / self._cell) + 1)
        self._values = shell_distance(vertices, faces, self._lo, self._cell, (x, y, z)).values

    def __call__(self, at: F64) -> F64:
        """(N,) at points (N, 3)."""
        node = ((at - self._lo) / self._cell).T
        return np.asarray(ndimage.map_coordinates(self._values, node, order=1, mode="nearest"), np.float64)


def _skin(region: Indices, names: tuple[str, ...]) -> Mask:
    """(Q,) quads of the skin's outside and of the nostrils."""
    return outer_quads(region, names) | np.isin(region, [i for i, n in enumerate(names) if n == PASSAGE])


def _own(quads: Indices, region: Indices, names: tuple[str, ...], count: int) -> Mask:
    """(count,) vertices of the inside that no quad of the skin has."""
    own = np.zeros(count, np.bool_)
    if CAVITY in names:
        own[quads[region == names.index(CAVITY)]] = True
        own[quads[_skin(region, names)]] = False
    return own


def _closed(points: F64, quads: Indices) -> tuple[F64, Faces]:
    """Quads (Q, 4) of points (n, 3) as triangles, with fans over their open borders."""
    loops = border_loops(quads)
    vertices = np.concatenate([points, *(points[loop].mean(0)[None] for loop in loops)])
    return vertices, np.concatenate([triangles_of(quads), *fans(loops, len(points))]).astype(np.int32)


def _spread(values: F64, quads: Indices) -> F64:
    """(n,) values that fall to zero over RINGS rings of quads (Q, 4) instead of at once; nowhere less than before."""
    out = values
    for ring in range(RINGS):
        grown = out.copy()
        np.maximum.at(grown, quads.ravel(), np.repeat(out[quads].max(1), 4) * (RINGS - ring) / (RINGS - ring + 1))
        out = grown
    return out
