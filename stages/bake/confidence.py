"""How well the photos see each texel.

Symbols: w = sum over fitted views of max(cos, 0) V. V = 1 if the view sees the point: inside the photo, inside its
mask, not occluded, not clipped. cos: between the normal and the direction to the camera.

    confidence = 1 - 2^-w

One photo from straight ahead gives 0.5, four give 0.94, none gives 0. Clipped pixels do not count, as in the fit: their
value is only a lower bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import raster
from pipeline.meshes import F32, F64, Charts, Mesh
from pipeline.nearest import filled
from pipeline.visibility import FittedPhoto, Occluder, picked, view_cosines
from stages.bake.regions import Poll, Votes

SIZE = 512  # texels: visibility has little fine detail, and rays are expensive


@dataclass(frozen=True, slots=True)
class Sighted:
    """confidence (S, S), S = min(size, SIZE), texels between charts filled from the nearest chart; votes for the
    regions at the same size, None if no photo has labels."""

    confidence: F32
    votes: Votes | None


def sighted(
    mesh: Mesh,
    charts: Charts,
    views: Sequence[FittedPhoto],
    size: int,
    step: Callable[[int, int], None],
    occluder: Occluder | None = None,
) -> Sighted:
    """Confidence and votes of the views. occluder: of the whole mesh, if this is one tile of it."""
    small = min(size, SIZE)
    hits = raster.rasterise(raster.texel_corners(charts, small), small, 0, small)
    weights = hits.weights.astype(np.float64)[..., None]
    points = (mesh.vertices.astype(np.float64)[mesh.faces[hits.face]] * weights).sum(1)
    normals = (mesh.normals.astype(np.float64)[mesh.faces[hits.face]] * weights).sum(1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    occluder, poll = occluder or Occluder(mesh), Poll(len(points))
    total = np.zeros(len(points))
    for i, view in enumerate(views):
        step(i, len(views))
        cosine, uv = view_cosines(view, points, normals, occluder)
        poll.ask(view, cosine, uv)
        total += unclipped(view, cosine, uv)
    covered = np.zeros(small * small, np.bool_)
    covered[hits.texel] = True

    def spread(values: F64) -> F32:
        image = np.zeros((small * small, *values.shape[1:]), np.float32)
        image[hits.texel] = values
        return filled(image.reshape(small, small, *values.shape[1:]), covered.reshape(small, small))

    return Sighted(spread(1 - 2.0**-total), poll.result(spread))


def unclipped(view: FittedPhoto, cosine: F64, uv: F64) -> F64:
    """(N,) cosines (N,) of the points that a view sees, set to 0 where its photo is clipped at uv (N, 2) pixels."""
    if view.clipped is None:
        return cosine
    from pipeline.images import read_alpha

    out, seen = cosine.copy(), np.flatnonzero(cosine)
    out[seen[picked(read_alpha(view.clipped), view.camera, uv[seen]) > 0]] = 0
    return out
