"""Rigid motions of a subject as six numbers, and how they move its points in a picture.

Symbols: xi = (w, t), a rotation vector in radians and a shift in the unit of the points; p the pivot;
    T: x -> R(w) (x - p) + p + t
Seen by a still camera, a subject that moved by T looks as the still one does to the camera T^-1 world_from_cam.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.transforms import F64, inverse_rigid, rigid

ORIGIN = np.zeros(3)


def rotation(v: npt.NDArray[np.floating]) -> F64:
    """(3, 3) rotation by |v| radians about v (3,)."""
    import cv2

    return np.asarray(cv2.Rodrigues(np.asarray(v, np.float64))[0], np.float64)


def rotation_vector(turn: F64) -> F64:
    """(3,) inverse of `rotation`, for angles below pi."""
    import cv2

    return np.asarray(cv2.Rodrigues(turn)[0], np.float64).ravel()


def motion_matrix(six: F64, pivot: F64 = ORIGIN) -> F64:
    """4x4 of T for six numbers (6,)."""
    turn = rotation(six[:3])
    return rigid(turn, pivot + six[3:] - turn @ pivot)


def six_of(motion: F64, pivot: F64 = ORIGIN) -> F64:
    """(6,) inverse of `motion_matrix`."""
    return np.concatenate([rotation_vector(motion[:3, :3]), motion[:3, 3] - pivot + motion[:3, :3] @ pivot])


def after(second: F64, first: F64) -> F64:
    """(6,) the motion `first`, then `second`, about the same pivot."""
    turn = rotation(second[:3])
    return np.concatenate([rotation_vector(turn @ rotation(first[:3])), turn @ first[3:] + second[3:]])


def camera_of_moved(world_from_cam: F64, six: F64) -> F64:
    """4x4 pose of the camera that sees the subject at rest as this one sees it after the motion, about the origin."""
    return np.asarray(inverse_rigid(motion_matrix(six)) @ world_from_cam, np.float64)


def motion_between(world_from_cam: F64, moved: F64) -> F64:
    """(6,) the motion about the origin for which `camera_of_moved` of the first pose is the second."""
    return six_of(world_from_cam @ inverse_rigid(moved))


def motion_slope(points: F64, slope: F64, pivot: F64 = ORIGIN) -> F64:
    """(N, K, 6) derivative by a further small motion, of what has the derivative slope (N, K, 3) by the points
    (N, 3)."""
    return np.concatenate([np.cross((points - pivot)[:, None], slope), slope], -1)
