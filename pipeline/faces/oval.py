"""The part of a surface that is the face: inside the outline of the landmarks, and facing the front.

Symbols: landmarks (L, 3) and the head's axes from them (pipeline.faces.landmarks3d); h chin to top of the forehead.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.faces.landmarks3d import head_frame
from pipeline.meshes import F64, Mask

DEEP = 0.15  # h: largest distance of the surface before or behind the landmarks' depths
FACING = 0.0  # least cosine to the front of a point that faces it


def on_face(points: F64, normals: npt.NDArray[np.floating], landmarks: F64) -> Mask:
    """(N,) whether points (N, 3) with normals (N, 3) are in the face: inside the outline of its landmarks (L, 3) seen
    from the front, at about their depth, and not facing back."""
    from scipy.spatial import ConvexHull

    frame = head_frame(landmarks)
    seen, at = ((x - frame.eyes) @ frame.axes.T for x in (landmarks, np.asarray(points, np.float64)))
    edges = ConvexHull(seen[:, :2]).equations  # normal . x + offset <= 0 inside
    inside = (at[:, :2] @ edges[:, :2].T + edges[:, 2]).max(1) <= 0
    room = DEEP * frame.height
    inside &= (at[:, 2] >= seen[:, 2].min() - room) & (at[:, 2] <= seen[:, 2].max() + room)
    return np.asarray(inside & (np.asarray(normals, np.float64) @ frame.axes[2] > FACING))
