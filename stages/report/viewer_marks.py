"""The face's landmarks for the 3D view."""

from __future__ import annotations

import numpy as np

from stages.report.collect import Started

DIGITS = 5  # of a coordinate in metres: a hundredth of a millimetre


def landmarks(r: Started) -> list[list[float]]:
    """(468, 3) asset coordinates; empty if too few photos agree on a face."""
    found = r.masks.artifact.landmarks
    if found is None:
        return []
    with np.load(r.masks.path(found), allow_pickle=False) as z:
        points = np.asarray(z["xyz"], np.float64)
    return [[round(float(v), DIGITS) for v in p] for p in points if np.isfinite(p).all()]
