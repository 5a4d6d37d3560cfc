"""How much of an expression the skin makes near the border of the neck, and where clothes or hair lie on the neck.

What the scan shows beside the head (collar, shoulders) is a mesh that no expression moves. A jaw that opens pulls the
template's neck along, and a gap would open there. Symbols: d distance along the edges of the template's skin from its
open border at the neck; e that from the nearest place of the neck that clothes or hair cover.

    share = min(step(d; HELD, FREE), step(e; HELD_COVERED, FREE_COVERED))    step: 0 up to the first, 1 from the second

The template's last ring lies beneath that mesh, which overlaps it (stages/uv/remainder.py): on the same surface, the
two would show in turn, in stripes.

    depth = SUNK (1 - step(d; OVERLAPPED, LEVEL))
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from pipeline.maths.smoothstep import smoothstep
from pipeline.meshes import F64, Indices, Mask, triangles_of, vertex_normals
from pipeline.registration.scan import Scan
from pipeline.registration.subdivision import Edges, edges_of
from pipeline.template.model import SKIN, Template

NECK = "neck"  # the region whose open border counts: other templates may have holes for eyes and mouth
HELD, FREE = 0.02, 0.055  # metres of the template; the face begins 51 mm from the border
HELD_COVERED, FREE_COVERED = 0.006, 0.035  # the same from a covered place: a collar ends where it is seen to end
SUNK, OVERLAPPED, LEVEL = 5e-4, 0.004, 0.008  # metres of the template
COVER = (0.004, 0.03)  # metres of the template outside of the skin: a surface between them covers it


def neck_share(template: Template, covered: Mask | None = None) -> F64:
    """(V,) share of its expressions that each vertex makes; 1 everywhere if the template has no open neck. covered
    (V,): vertices of the neck under clothes or hair."""
    skin = template.quads[template.parts[SKIN]]
    share = share_of(template.vertices, skin, _neck_quads(template))
    if covered is None or not covered.any():
        return share
    away = _along(template.vertices, edges_of(skin, len(template.vertices)), np.flatnonzero(covered))
    return np.asarray(np.minimum(share, smoothstep(away, HELD_COVERED, FREE_COVERED)))


def share_of(vertices: F64, skin: Indices, neck: Indices) -> F64:
    """The same for vertices (V, 3) in metres of the template, with quads (Q, 4) of the skin and of the neck."""
    return smoothstep(_away(vertices, skin, neck), HELD, FREE)


def covered_neck(template: Template, vertices: F64, scan: Scan, unit: float) -> Mask:
    """(V,) vertices of the neck outside of which the scan shows another surface: clothes or hair. vertices (V, 3): of
    the registered head; unit: world units per metre of the template."""
    out = np.zeros(len(vertices), np.bool_)
    rows = np.unique(_neck_quads(template))
    if len(rows):
        normals = vertex_normals(vertices, triangles_of(template.quads[template.parts[SKIN]])).astype(np.float64)
        away, _ = scan.along(vertices[rows], normals[rows], COVER[1] * unit)
        out[rows] = np.nan_to_num(away) > COVER[0] * unit
    return out


def from_border(template: Template) -> F64:
    """(V,) metres along edges of the skin from the neck's border; infinite without a border, and beside the skin."""
    return _away(template.vertices, template.quads[template.parts[SKIN]], _neck_quads(template))


def sunk(template: Template) -> F64:
    """(V,) metres of the template by which the skin lies beneath the surface near the neck's border; 0 elsewhere."""
    away = from_border(template)
    return np.asarray(SUNK * (1 - smoothstep(np.minimum(away, LEVEL), OVERLAPPED, LEVEL)))


def neck_border(template: Template) -> Indices:
    """(n,) vertices of open edges of the skin that belong to the neck."""
    skin = template.quads[template.parts[SKIN]]
    return _border(edges_of(skin, len(template.vertices)), _neck_quads(template))


def _away(vertices: F64, skin: Indices, neck: Indices) -> F64:
    count, edges = len(vertices), edges_of(skin, len(vertices))
    border = _border(edges, neck)
    if not len(border):
        return np.full(count, np.inf)
    return _along(vertices, edges, border)


def _along(vertices: F64, edges: Edges, start: Indices) -> F64:
    """(V,) distance along edges from the nearest of the vertices start (n,); infinite where no edges lead."""
    length = np.linalg.norm(vertices[edges.ends[:, 0]] - vertices[edges.ends[:, 1]], axis=1)
    count = len(vertices)
    graph = coo_array((length, (edges.ends[:, 0], edges.ends[:, 1])), shape=(count, count)).tocsr()
    return np.asarray(dijkstra(graph, directed=False, indices=start, min_only=True), np.float64)


def _border(edges: Edges, neck: Indices) -> Indices:
    open_ = edges.ends[edges.border]
    return np.asarray(np.unique(open_[np.isin(open_, neck).all(1)]), np.int64)


def _neck_quads(template: Template) -> Indices:
    own = template.regions.get(NECK, np.zeros(0, np.int64))
    return np.asarray(template.quads[own], np.int64)
