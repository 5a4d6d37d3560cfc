"""The grid of a lat-long picture of radiance, as USD's dome light reads it.

Rows from +Y (top) to -Y; the image's centre looks along +Z, its left edge is longitude +pi, and columns grow towards
-X. Longitude 0 is +Z and grows towards +X.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


def latlong_directions(width: int, height: int) -> F64:
    """(height, width, 3) unit directions through the pixel centres."""
    longitude = np.pi * (1 - 2 * (np.arange(width) + 0.5) / width)
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    ring = np.cos(latitude)[:, None]
    return np.stack(
        [
            ring * np.sin(longitude),
            np.broadcast_to(np.sin(latitude)[:, None], (height, width)),
            ring * np.cos(longitude),
        ],
        -1,
    )


def latlong_weights(width: int, height: int) -> F64:
    """(height, 1) solid angle of one pixel in each row; the sum over all pixels is 4 pi."""
    edge = np.sin(np.pi * (0.5 - np.arange(height + 1) / height))
    weights: F64 = ((edge[:-1] - edge[1:]) * 2 * np.pi / width)[:, None]
    return weights
