"""Checks of one given camera, for all formats: K, pose and distortion."""

from __future__ import annotations

import numpy as np

from pipeline.capture_artifacts import GivenCamera
from pipeline.transforms import F64, rigid, rows
from stages.capture.readers.values import fault, finite

ORTHONORMAL_LIMIT = 1e-3  # float32 and few printed digits give less, a scaled or sheared matrix more
FOCAL = (0.05, 100.0)  # of the photo's longest edge: a fisheye of 180 degrees has 0.3, a lens of 1200 mm has 33
PRINCIPAL = 100.0  # longest edges from the frame's centre: a small crop's principal point lies far outside
FARTHEST = 1e9  # units from the world's origin: millimetres on a map of a country
BENT = 10.0  # largest shift of a corner by one distortion term, relative to its distance from the axis


def given_camera(
    K: F64, cam_from_world: F64, distortion: F64, where: str, size: tuple[int, int] | None = None
) -> GivenCamera:
    """A checked camera. K: (3, 3) pixels, the first pixel's centre at (0.5, 0.5). cam_from_world: (3, 4) or (4, 4).
    distortion: (5,) k1 k2 p1 p2 k3. size: the photo's (width, height) in pixels, None if unknown. where: for errors."""
    K, pose = checked_K(K, where), checked_pose(cam_from_world, where)
    if size is not None:
        checked_lens(checked_frame(K, size, where), distortion, size, where)
    return GivenCamera(K=rows(K), cam_from_world=rows(pose), distortion=tuple(float(x) for x in distortion))


def checked_frame(K: F64, size: tuple[int, int], where: str) -> F64:
    """K (3, 3) itself. Raises StageError if its focal lengths, skew or principal point do not fit a photo of this
    (width, height) in pixels."""
    edge = max(size)
    low, high = FOCAL[0] * edge, FOCAL[1] * edge
    if not (low <= K[0, 0] <= high and low <= K[1, 1] <= high):
        raise fault("a focal length is out of range", where, f"fx = {K[0, 0]:g}, fy = {K[1, 1]:g}",
                    f"{low:g} to {high:g} for a photo of {size[0]} x {size[1]}",
                    "write the focal lengths in pixels")  # fmt: skip
    off = float(np.abs(K[:2, 2] - np.array(size) / 2).max())
    if not max(off, abs(K[0, 1])) <= PRINCIPAL * edge:
        raise fault("the principal point or the skew is out of range", where,
                    f"cx = {K[0, 2]:g}, cy = {K[1, 2]:g}, skew = {K[0, 1]:g}",
                    f"at most {PRINCIPAL * edge:g} from the frame's centre",
                    "write the principal point in pixels")  # fmt: skip
    return K


def checked_lens(K: F64, d: F64, size: tuple[int, int], where: str) -> F64:
    """d (5,), k1 k2 p1 p2 k3, itself. Raises StageError if one term moves a corner of the frame too far."""
    r = float(np.hypot(size[0] / 2 / K[0, 0], size[1] / 2 / K[1, 1]))
    moved = float(np.abs(finite(d, where) * np.array([r**2, r**4, r, r, r**6])).max())
    if moved > BENT:
        raise fault("the lens distortion is too large", where,
                    f"{', '.join(f'{x:g}' for x in d)}: a corner moves by {moved:.3g} times its distance",
                    f"at most {BENT:g} times for each of k1 k2 p1 p2 k3",
                    "check the order k1 k2 p1 p2 k3 and their unit; zeros for a lens without distortion")  # fmt: skip
    return d


def checked_K(K: F64, where: str) -> F64:
    """K (3, 3) itself. Raises StageError if it is not finite, not 3 x 3, singular or not upper triangular."""
    if K.shape != (3, 3):
        raise fault("camera matrix has the wrong shape", where, f"shape {K.shape}", "3 x 3", "write K as three rows")
    finite(K, where)
    scale = max(float(np.abs(K).max()), 1e-300)
    if abs(float(np.linalg.det(K / scale))) * scale**2 < 1e-9 or min(K[0, 0], K[1, 1]) <= 0:
        raise fault(
            "camera matrix K is singular",
            where,
            f"fx = {K[0, 0]:g}, fy = {K[1, 1]:g}, determinant {float(np.linalg.det(K)):.3g}",
            "fx and fy above 0",
            "write the focal lengths in pixels",
        )
    if np.abs(K[2] - [0, 0, 1]).max() > 1e-6 or abs(K[1, 0]) > 1e-6 * K[0, 0]:
        raise fault(
            "camera matrix K is not upper triangular",
            where,
            K.tolist(),
            "rows (fx, s, cx), (0, fy, cy), (0, 0, 1)",
            "check that the matrix is not transposed",
        )
    return K


def checked_pose(m: F64, where: str) -> F64:
    """cam_from_world (4, 4) with an exact rotation, from m (3, 4) or (4, 4). Raises StageError if m is no pose,
    left-handed or too far away."""
    if m.shape not in ((3, 4), (4, 4)) or (m.shape == (4, 4) and np.abs(m[3] - [0, 0, 0, 1]).max() > 1e-6):
        raise fault(
            "camera pose has the wrong shape",
            where,
            f"shape {m.shape}",
            "3 x 4: rotation, then translation",
            "write the pose as three rows of four",
        )
    finite(m, where)
    exact = rigid(checked_rotation(m[:3, :3], where), m[:3, 3])
    if np.linalg.norm(m[:3, 3]) > FARTHEST:
        raise fault("a camera is too far away", where, f"{np.linalg.norm(m[:3, 3]):.3g} units from the origin",
                    f"at most {FARTHEST:g}", "write the pose in metres or millimetres, near the origin")  # fmt: skip
    return exact


def checked_rotation(R: F64, where: str) -> F64:
    """The rotation (3, 3) nearest to R. Raises StageError if R is not orthonormal, or left-handed."""
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if not error <= ORTHONORMAL_LIMIT:
        raise fault(
            "the rotation of a camera pose is not orthonormal",
            where,
            f"|R R^T - 1| = {error:.3g}",
            f"at most {ORTHONORMAL_LIMIT:g}",
            "write a pure rotation, without scale or shear",
        )
    if np.linalg.det(R) < 0:
        raise fault(
            "camera pose is left-handed",
            where,
            "det R = -1 (mirrored)",
            "det R = +1",
            "use right-handed axes; flip one axis in the program that writes the pose",
        )
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ vt, np.float64)
