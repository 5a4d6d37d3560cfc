"""The least cut of a graph: its nodes parted in two so that what is cut, and what is decided against, costs least."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

ENDLESS = 2**30  # a pull that no cut outweighs


def least_cut(a: I64, b: I64, cost: I32, pull: I32) -> Bool:
    """(N,) which nodes are on the first side.

    a, b: (E,) nodes of an edge; cost: (E,) >= 0 of cutting it. pull: (N,) cost of having a node on the second side
    where positive, on the first where negative. Nodes that cost the same on both sides are on the second.

    Source: Ford and Fulkerson 1956, the flow by SciPy. Costs in sum above 2^31 overflow: keep them below.
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
