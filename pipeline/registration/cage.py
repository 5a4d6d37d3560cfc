"""The template's skin as the control cage of a subdivision surface, with what its deformation needs.

Symbols: V vertices of the skin; M limit points (one at each vertex of the first subdivision, so about four for each
vertex of the cage); E edges and diagonals of the quads.

The stiffness of a place depends on its region: lids, lips, nostrils and ears keep their own shape longer than cheeks,
because the surface is least accurate there and a fold shows most.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from pipeline.meshes import F64, Indices, Mask, unit
from pipeline.registration.outgrown import GROWS, growing
from pipeline.registration.subdivision import edges_of, limit, subdivided
from pipeline.template.model import SKIN, Template

HIDDEN = ("mouth_inside", "sockets", "nostrils")  # regions that no surface of the photos shows as they are
STIFFER: Mapping[str, float] = {
    "lids": 3.0,
    "lips": 3.0,
    "nostrils": 6.0,
    "ears": 2.0,
    "mouth_inside": 4.0,
    "sockets": 4.0,
}
LOOSE = ("scalp", "neck")  # hair and clothes stand out of these: only a surface that is near counts there
DIAGONAL = 0.5  # stiffness of a quad's diagonals over that of its sides: against shear


@dataclass(frozen=True, slots=True)
class Cage:
    """of_template (V,): the skin's vertices in the template; quads (Q, 4) into V; region (Q,) into names.

    finer (16 Q, 4): the second subdivision; at_finer (n, V): its limit points. stencil (M, V): limit points of the
    first; along, across (M, V): of their tangents. shown (M,): points that a surface can show; loose (M,): those on
    scalp and neck. difference (E, V): end minus start of every edge and diagonal; stiffness (E,)."""

    of_template: Indices
    quads: Indices
    region: Indices
    names: tuple[str, ...]
    finer: Indices
    at_finer: csr_array
    stencil: csr_array
    along: csr_array
    across: csr_array
    shown: Mask
    loose: Mask
    grows: Mask
    difference: csr_array
    stiffness: F64

    def points(self, vertices: F64) -> F64:
        """(M, 3) limit points of the cage's vertices (V, 3)."""
        return np.asarray(self.stencil @ vertices)

    def normals(self, vertices: F64) -> F64:
        """(M, 3) unit normals there."""
        return unit(np.cross(self.along @ vertices, self.across @ vertices))


def cage_of(template: Template) -> Cage:
    """The cage of a template's skin."""
    rows = template.parts[SKIN]
    of_template, flat = np.unique(template.quads[rows], return_inverse=True)
    quads, count = flat.reshape(-1, 4).astype(np.int64), len(of_template)
    names = tuple(template.regions)
    region = _regions(template, names)[rows]
    fine, finer = subdivided(quads, count, 1), subdivided(quads, count, 2)
    at = limit(fine.quads, fine.stencil.shape[0])
    difference, stiffness = _springs(quads, count, region, names)
    fine_region = np.repeat(region, 4)
    hidden, loose, ears = (
        _touches(fine.quads, fine.stencil.shape[0], np.isin(fine_region, [names.index(n) for n in which if n in names]))
        for which in (HIDDEN, LOOSE, GROWS)
    )
    points = np.asarray(at.point @ fine.stencil @ template.vertices[of_template], np.float64)
    return Cage(
        np.asarray(of_template, np.int64), quads, region, names,
        finer.quads, csr_array(limit(finer.quads, finer.stencil.shape[0]).point @ finer.stencil),
        csr_array(at.point @ fine.stencil), csr_array(at.along @ fine.stencil), csr_array(at.across @ fine.stencil),
        ~hidden & ~at.rough, loose, growing(points, ears) & ~hidden & ~at.rough, difference, stiffness,
    )  # fmt: skip


def part_of(cage: Cage, keep: Mask) -> Cage:
    """The cage of some vertices keep (V,): with the quads, points and springs that need no other."""
    number = np.cumsum(keep) - 1
    own, points, springs = keep[cage.quads].all(1), points_of(cage, keep), rows_within(cage.difference, keep)

    def cut(matrix: csr_array, rows: Indices) -> csr_array:
        return csr_array(matrix[rows][:, np.flatnonzero(keep)])

    return Cage(
        cage.of_template[keep], number[cage.quads[own]], cage.region[own], cage.names,
        cage.finer[:0], csr_array((0, int(keep.sum()))),
        cut(cage.stencil, points), cut(cage.along, points), cut(cage.across, points),
        cage.shown[points], cage.loose[points], cage.grows[points], cut(cage.difference, springs),
        cage.stiffness[springs],
    )  # fmt: skip


def points_of(cage: Cage, keep: Mask) -> Indices:
    """Rows of the limit points that depend on the vertices keep (V,) alone."""
    return rows_within(cage.stencil, keep)


def rows_within(matrix: csr_array, keep: Mask) -> Indices:
    """Rows of a sparse matrix whose entries are all in columns keep (V,)."""
    return np.flatnonzero(abs(matrix) @ (~keep).astype(np.float64) == 0)


def _regions(template: Template, names: tuple[str, ...]) -> Indices:
    """(Q,) index into names of each quad of the template, -1 for none."""
    out = np.full(len(template.quads), -1, np.int64)
    for i, name in enumerate(names):
        out[template.regions[name]] = i
    return out


def _touches(quads: Indices, count: int, inside: Mask) -> Mask:
    """(count,) vertices of any of the quads (Q, 4) that are inside (Q,)."""
    out = np.zeros(count, np.bool_)
    out[quads[inside]] = True
    return out


def _springs(quads: Indices, count: int, region: Indices, names: tuple[str, ...]) -> tuple[csr_array, F64]:
    edges = edges_of(quads, count).ends
    diagonals = np.concatenate([quads[:, [0, 2]], quads[:, [1, 3]]])
    ends = np.concatenate([edges, diagonals])
    factor = np.array([STIFFER.get(names[r], 1.0) if r >= 0 else 1.0 for r in region])
    uses = np.bincount(quads.ravel(), minlength=count)
    of_vertex = np.bincount(quads.ravel(), np.repeat(factor, 4), count) / np.maximum(uses, 1)
    rows = np.arange(len(ends))
    difference = csr_array(
        (np.r_[np.ones(len(ends)), -np.ones(len(ends))], (np.r_[rows, rows], np.r_[ends[:, 1], ends[:, 0]])),
        shape=(len(ends), count),
    )
    share = np.r_[np.ones(len(edges)), np.full(len(diagonals), DIAGONAL)]
    return difference, share * np.sqrt(of_vertex[ends[:, 0]] * of_vertex[ends[:, 1]])
