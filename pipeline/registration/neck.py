"""How much of an expression the skin makes near the border of the neck.

What the scan shows beside the head (collar, shoulders) is a mesh that no expression moves. A jaw that opens pulls the
template's neck along, and a gap would open there. Symbols: d distance along the edges of the template's skin from its
open border at the neck.

    share = 0 up to HELD, 1 from FREE on, with a smooth step between
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from pipeline.meshes import F64, Indices
from pipeline.registration.subdivision import Edges, edges_of
from pipeline.template.model import SKIN, Template

NECK = "neck"  # the region whose open border counts: other templates may have holes for eyes and mouth
HELD, FREE = 0.02, 0.055  # metres of the template; the face begins 51 mm from the border


def neck_share(template: Template) -> F64:
    """(V,) share of its expressions that each vertex makes; 1 everywhere if the template has no open neck."""
    return share_of(template.vertices, template.quads[template.parts[SKIN]], _neck_quads(template))


def share_of(vertices: F64, skin: Indices, neck: Indices) -> F64:
    """The same for vertices (V, 3) in metres of the template, with quads (Q, 4) of the skin and of the neck."""
    away = _away(vertices, skin, neck)
    step = np.clip((away - HELD) / (FREE - HELD), 0, 1)
    return np.asarray(step * step * (3 - 2 * step))


def from_border(template: Template) -> F64:
    """(V,) metres along edges of the skin from the neck's border; infinite without a border, and beside the skin."""
    return _away(template.vertices, template.quads[template.parts[SKIN]], _neck_quads(template))


def neck_border(template: Template) -> Indices:
    """(n,) vertices of open edges of the skin that belong to the neck."""
    skin = template.quads[template.parts[SKIN]]
    return _border(edges_of(skin, len(template.vertices)), _neck_quads(template))


def _away(vertices: F64, skin: Indices, neck: Indices) -> F64:
    count, edges = len(vertices), edges_of(skin, len(vertices))
    border = _border(edges, neck)
    if not len(border):
        return np.full(count, np.inf)
    length = np.linalg.norm(vertices[edges.ends[:, 0]] - vertices[edges.ends[:, 1]], axis=1)
    graph = coo_array((length, (edges.ends[:, 0], edges.ends[:, 1])), shape=(count, count)).tocsr()
    return np.asarray(dijkstra(graph, directed=False, indices=border, min_only=True), np.float64)


def _border(edges: Edges, neck: Indices) -> Indices:
    open_ = edges.ends[edges.border]
    return np.asarray(np.unique(open_[np.isin(open_, neck).all(1)]), np.int64)


def _neck_quads(template: Template) -> Indices:
    own = template.regions.get(NECK, np.zeros(0, np.int64))
    return np.asarray(template.quads[own], np.int64)
