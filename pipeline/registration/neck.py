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
    away = from_border(template)
    step = np.clip((away - HELD) / (FREE - HELD), 0, 1)
    return np.asarray(step * step * (3 - 2 * step))


def from_border(template: Template) -> F64:
    """(V,) metres along edges of the skin from the neck's border; infinite without a border, and beside the skin."""
    count = len(template.vertices)
    edges, border = _skin_edges(template), neck_border(template)
    if not len(border):
        return np.full(count, np.inf)
    length = np.linalg.norm(template.vertices[edges.ends[:, 0]] - template.vertices[edges.ends[:, 1]], axis=1)
    graph = coo_array((length, (edges.ends[:, 0], edges.ends[:, 1])), shape=(count, count)).tocsr()
    return np.asarray(dijkstra(graph, directed=False, indices=border, min_only=True), np.float64)


def neck_border(template: Template) -> Indices:
    """(n,) vertices of open edges of the skin that belong to the neck."""
    if NECK not in template.regions:
        return np.zeros(0, np.int64)
    edges = _skin_edges(template)
    open_ = edges.ends[edges.border]
    neck = np.isin(open_, template.quads[template.regions[NECK]]).all(1)
    return np.asarray(np.unique(open_[neck]), np.int64)


def _skin_edges(template: Template) -> Edges:
    return edges_of(template.quads[template.parts[SKIN]], len(template.vertices))
