"""Weights of Student's t distribution, for residuals of which some are outliers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
FARTHEST = 1e150  # its square is a number


def student_weight(r: F64, nu: F64 | float) -> F64:
    """min((nu + 1) / (nu + r^2), 1): (N,) residuals over their scale, (N,) or one number of degrees of freedom above
    0 -> (N,) in [0, 1].

    The score of the distribution over that of a Gaussian, -(d/dr ln p(r)) / r: with it, weighted least squares is the
    maximum likelihood estimate. Residuals below their scale have weight 1. That of
    an infinite residual is almost 0 (1e-299).

    Source: Lange, Little and Taylor, Robust statistical modeling using the t distribution (1989).
    """
    most = np.minimum(np.abs(r), FARTHEST)
    return np.asarray(np.minimum((nu + 1) / (nu + most * most), 1.0), np.float64)
