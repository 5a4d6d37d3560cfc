"""The minimum cut of a graph: divides the nodes into two sides at the least total cost of edges and nodes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

ENDLESS = 2**30  # a pull that is larger than any cut


def least_cut(a: I64, b: I64, cost: I32, pull: I32) -> Bool:
    """(N,) mask of the nodes on the first side.

    a, b: (E,) nodes of an edge; cost: (E,) >= 0 of cutting it. pull: (N,) cost of a node on the second side if
    positive, on the first side if negative. Nodes with equal cost on both sides are on the second.

    Source: Ford and Fulkerson 1956; the maximum flow is computed by SciPy. The sum of the costs must stay below 2^31.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    n = len(pull)
    first, last = np.flatnonzero(pull > 0), np.flatnonzero(pull < 0)
    rows = np.concatenate([a, b, np.full(len(first), n), last])
    columns = np.concatenate([b, a, first, np.full(len(last), n + 1)])
    capacity = np.concatenate([cost, cost, pull[first], -pull[last]]).astype(np.int32)
    graph = coo_array((capacity, (rows, columns)), shape=(n + 2, n + 2)).tocsr()
    left = (graph - maximum_flow(graph, n, n + 1).flow).tocsr()
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    reached = np.zeros(n + 2, np.bool_)
    reached[breadth_first_order(left, n, return_predecessors=False)] = True
    return reached[:n]
