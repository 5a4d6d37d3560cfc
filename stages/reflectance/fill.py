"""Values where no camera sees anything: harmonic continuation from the texels around.

    sum over neighbours j of i   w_ij (x_i - x_j) = 0   at every unseen texel i

on the graph of each texel's nearest neighbours in space, w = 1 / distance. It works on coefficients (albedo, lobes,
rest), so that a filled texel reflects as its surroundings do, under any light.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.images import F32
from pipeline.maths.sparse import factorised
from pipeline.transforms import F64

NEIGHBOURS = 8


def harmonic(values: F32, known: npt.NDArray[np.bool_], position: F64) -> F32:
    """(T, C) values with those of unknown texels continued from the known. position (T, 3). With nothing known: as
    they are."""
    from scipy.sparse import coo_array
    from scipy.spatial import cKDTree

    if known.all() or not known.any():
        return values.copy()
    far, near = cKDTree(position).query(position, NEIGHBOURS + 1)
    far, near = np.asarray(far, np.float64)[:, 1:], np.asarray(near, np.int64)[:, 1:]
    weight = 1 / np.maximum(far, 1e-6)
    i = np.repeat(np.arange(len(values)), NEIGHBOURS)
    half = coo_array((weight.ravel(), (i, near.ravel())), shape=(len(values),) * 2).tocsr()
    graph = (half + half.T).tocsr()
    unknown = np.flatnonzero(~known)
    own = np.asarray(graph.sum(1)).ravel()[unknown]
    inner = graph[unknown][:, unknown]
    mean = values[known].mean(0)
    tie = 1e-6 * own  # a part of the surface without any known texel takes the mean
    system = coo_array((own + tie, (np.arange(len(unknown)),) * 2), shape=inner.shape).tocsc() - inner.tocsc()
    right = graph[unknown][:, np.flatnonzero(known)] @ values[known].astype(np.float64) + tie[:, None] * mean
    out = values.copy()
    out[unknown] = factorised(system).solve(np.asarray(right, np.float64)).astype(np.float32)
    return out
