"""Factors of sparse matrices that are symmetric and positive definite, as those of surfaces' Laplacians are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scipy.sparse.linalg import SuperLU


def factorised(matrix: Any) -> SuperLU:
    """SuperLU's factors of a sparse positive definite matrix (V, V), symmetric or Hermitian, of any format. Its default
    ordering is for unsymmetric matrices and gives 2.5 to ten times the fill-in, and so much more time and memory."""
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    options = {"SymmetricMode": True}
    return splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
