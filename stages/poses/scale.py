"""Metres per unit of the capture's world, from known lengths in the scene.

Symbols: cameras in the capture's world; s metres per unit. Each source gives s with a description; none is assumed.
    distance   s = d / |a - b|, a and b camera centres or points seen in photos
    markers    s = edge / median of the measured edges of all markers
    pupils     s = interpupillary distance / |a - b|, a and b the centres of the eyes seen in photos
    positions  least squares s of  s R c_i + t = p_i  (Umeyama, 1991), p_i from EXIF
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.errors import StageError, UsageError
from pipeline.transforms import F64, apply, inverse_rigid, matrix, project, rays, scale_of, umeyama

DICTIONARIES = {
    "aruco_4x4": cv2.aruco.DICT_4X4_250,
    "aruco_5x5": cv2.aruco.DICT_5X5_250,
    "aruco_6x6": cv2.aruco.DICT_6X6_250,
    "apriltag_16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "apriltag_25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "apriltag_36h11": cv2.aruco.DICT_APRILTAG_36h11,
}
MET = 0.004  # of the photo's longest edge: largest reprojection error of a point
SQUARE = 0.05  # of the longer edge: a marker whose edges differ more is two markers, or bent
MIN_SPREAD = 5.0  # smallest ratio of the positions' spread to their error
MIN_POSITIONS = 5
MIN_FACES, EYE_MET = 3, 0.1  # photos; largest reprojection error of an eye, as a share of the pupils' distance
_SPEC = re.compile(r"(?P<a>[^=]+?)\s+to\s+(?P<b>[^=]+?)\s*=\s*(?P<d>[0-9.eE+-]+)")
_GRAMMAR = "A to B = METRES, where A and B are photos, or points as PHOTO@X,Y+PHOTO@X,Y"
U8 = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Scale:
    """metres_per_unit, and its source as text."""

    metres_per_unit: float
    source: str


def check_distance(spec: str) -> str:
    """The setting itself if its grammar is right. Raises UsageError otherwise."""
    if spec:
        _parsed(spec)
    return spec


def by_distance(spec: str, cameras: Sequence[Camera]) -> Scale:
    """The scale from a known distance between two cameras, two points, or one of each.

    Raises UsageError: a photo that has no camera; StageError: rays that do not meet.
    """
    a, b, metres = _parsed(spec)
    apart = float(np.linalg.norm(_place(a, cameras) - _place(b, cameras)))
    if apart < 1e-9:
        raise UsageError("both ends of the known distance are the same point", where="poses.distance", value=spec,
                         limit="two different points", remedy="give another camera or point")  # fmt: skip
    return Scale(metres / apart, f"from the known distance of {metres:g} m: {a} to {b}")


def _parsed(spec: str) -> tuple[str, str, float]:
    found = _SPEC.fullmatch(spec.strip())
    metres = float(found["d"]) if found and re.fullmatch(r"\d*\.?\d+([eE][+-]?\d+)?", found["d"]) else 0.0
    if found is None or not 0 < metres < 1e6:
        raise UsageError("the known distance is not understood", where="poses.distance", value=spec, limit=_GRAMMAR,
                         remedy='write for example "1.jpg to 5.jpg = 0.42"')  # fmt: skip
    return found["a"].strip(), found["b"].strip(), metres


def _place(text: str, cameras: Sequence[Camera]) -> F64:
    """(3,) centre of the camera with this name, or the point where the rays of PHOTO@X,Y+... meet."""
    if "@" not in text:
        return np.asarray(matrix(_camera(text, cameras).world_from_cam)[:3, 3], np.float64)
    observed = []
    for part in text.split("+"):
        name, _, at = part.strip().rpartition("@")
        try:
            x, y = (float(v) for v in at.split(","))
        except ValueError as e:
            raise UsageError("a point of the known distance is not understood", where="poses.distance", value=part,
                             limit="PHOTO@X,Y", remedy="write for example 1.jpg@812,440") from e  # fmt: skip
        observed.append((_camera(name, cameras), np.array([x, y])))
    point = meeting_point(observed)
    if point is None:
        raise StageError("the rays to a point of the known distance do not meet", where="poses.distance",
                         value=text, limit=f"rays that meet within {MET:.1%} of the photo's longest edge, from "
                         "different directions", remedy="give the spot's pixel in at least two photos")  # fmt: skip
    return point


def _camera(name: str, cameras: Sequence[Camera]) -> Camera:
    for c in cameras:
        if name in (c.name, c.name.rpartition(".")[0]):
            return c
    raise UsageError("a photo of the known distance has no camera", where="poses.distance", value=name,
                     limit=f"one of {cameras[0].name} ... {cameras[-1].name}",
                     remedy="give a photo that has a camera")  # fmt: skip


def meeting_point(observed: Sequence[tuple[Camera, F64]]) -> F64 | None:
    """(3,) the point nearest to the rays through pixels uv (2,), or None if the rays do not meet.

    sum_i (1 - d_i d_i^T) (x - o_i) = 0
    """
    if len(observed) < 2:
        return None
    x = _nearest(observed)
    met = all(_miss(camera, x, uv) <= MET * max(camera.width, camera.height) for camera, uv in observed)
    return x if met else None


def _nearest(observed: Sequence[tuple[Camera, F64]]) -> F64:
    """(3,) the point nearest to the rays; NaN if they are nearly parallel."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for camera, uv in observed:
        o, d = rays(matrix(camera.K), matrix(camera.world_from_cam), np.array(camera.distortion), uv[None])
        across = np.eye(3) - np.outer(d[0], d[0])
        A, b = A + across, b + across @ o
    if np.linalg.eigvalsh(A)[0] < 1e-4 * len(observed):  # a sixth of a degree between two rays
        return np.full(3, np.nan)
    return np.asarray(np.linalg.solve(A, b), np.float64)


def _miss(camera: Camera, x: F64, uv: F64) -> float:
    """Distance in pixels between the projection of x (3,) and uv (2,); infinite if x is behind the camera, or NaN."""
    cam_from_world = inverse_rigid(matrix(camera.world_from_cam))
    seen, z = project(matrix(camera.K), cam_from_world, np.array(camera.distortion), x[None])
    return float(np.linalg.norm(seen[0] - uv)) if z[0] > 0 and np.isfinite(seen).all() else float("inf")


def find_markers(grey: U8, dictionary: str) -> dict[int, F64]:
    """Corners (4, 2) in pixels, first pixel's centre at (0.5, 0.5), of each marker in a grey photo (H, W), by its
    id."""
    detector: Any = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]))
    parameters = detector.getDetectorParameters()
    # corners from lines along the edges: blur rounds the corners, which makes markers of 60 pixels 0.8 % too small
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    detector.setDetectorParameters(parameters)
    corners, numbers, _ = detector.detectMarkers(grey)
    if numbers is None:
        return {}
    # AprilTag counts pixels from their corners, unlike the rest of OpenCV: nothing is to be added
    found = {int(n): np.asarray(c, np.float64).reshape(4, 2) for n, c in zip(numbers.ravel(), corners, strict=True)}
    twice = {int(n) for n in numbers.ravel() if (numbers == n).sum() > 1}
    return {n: c for n, c in found.items() if n not in twice}


def by_markers(seen: Sequence[tuple[Camera, Mapping[int, F64]]], edge: float) -> Scale | None:
    """The scale from square markers whose black edge is `edge` metres; None if no marker is well visible in two
    photos."""
    lengths, used = [], []
    for number in sorted({n for _, found in seen for n in found}):
        corners = [meeting_point([(c, found[number][k]) for c, found in seen if number in found]) for k in range(4)]
        placed = [x for x in corners if x is not None]
        if len(placed) < 4:
            continue
        edges = [float(np.linalg.norm(placed[k] - placed[k - 1])) for k in range(4)]
        if max(edges) - min(edges) <= SQUARE * max(edges):
            lengths += edges
            used.append(number)
    if not lengths:
        return None
    spread = float(np.std(lengths) / np.median(lengths))
    return Scale(edge / float(np.median(lengths)), f"from {len(used)} markers of {1e3 * edge:g} mm (numbers "
                 f"{', '.join(map(str, used[:8]))}), whose edges agree to {spread:.1%}")  # fmt: skip


def by_world(metres_from_world: F64) -> tuple[Scale, F64]:
    """The scale and the rotation (3, 3) to upright axes of a published similarity (4, 4)."""
    s = scale_of(metres_from_world)
    return Scale(s, "from FaceScape's scale dictionary"), np.asarray(metres_from_world[:3, :3] / s, np.float64)


@dataclass(frozen=True, slots=True)
class Eyes:
    """right, left: (3,) centres of the person's own eyes. photos: number of photos used; off: median reprojection error
    as a share of the eyes' distance in the photo."""

    right: F64
    left: F64
    photos: int
    off: float


def eyes_of(seen: Sequence[tuple[Camera, tuple[F64, F64]]]) -> Eyes | None:
    """The eyes from the right and left pupil (2,) in pixels in each photo with a face; None if fewer than MIN_FACES
    photos agree.

    Photos with a wrong detection, or a face from the side, are left out one by one, the worst first.
    """
    left = list(seen)
    while len(left) >= MIN_FACES:
        eyes = [_nearest([(c, pair[k]) for c, pair in left]) for k in range(2)]
        wide = [max(float(np.hypot(*(pair[1] - pair[0]))), 1e-9) for _, pair in left]
        missed = [max(_miss(c, x, uv) for x, uv in zip(eyes, pair, strict=True)) for c, pair in left]
        off = np.array(missed) / wide
        if off.max() <= EYE_MET:
            return Eyes(eyes[0], eyes[1], len(left), float(np.median(off)))
        # relative to the frame, because a wrong detection may have any width
        left.pop(int(np.argmax([m / max(c.width, c.height) for m, (c, _) in zip(missed, left, strict=True)])))
    return None


def by_pupils(eyes: Eyes, metres: float) -> Scale:
    """The scale from the distance of the pupils in metres."""
    source = (
        f"from a distance of {1e3 * metres:g} mm between the pupils, seen in {eyes.photos} photos with an error of "
        f"{eyes.off:.1%}"
    )
    return Scale(metres / float(np.linalg.norm(eyes.left - eyes.right)), source)


def by_positions(
    cameras: Sequence[Camera], places: Mapping[int, tuple[float, float, float]]
) -> tuple[Scale | None, str]:
    """The scale from GPS positions in metres by the cameras' index; or None and the reason. With errors of a few metres
    they are useless for a rig around a head, but good for a walk around a statue."""
    known = [c for c in cameras if c.index in places]
    if len(known) < MIN_POSITIONS:
        return None, f"only {len(known)} photos with a camera have a GPS position"
    a = np.stack([matrix(c.world_from_cam)[:3, 3] for c in known])
    b = np.array([places[c.index] for c in known])
    found = umeyama(a, b)
    scale, residual = scale_of(found), apply(found, a) - b
    spread = float(np.sqrt(((b - b.mean(0)) ** 2).sum(1).mean()))
    wrong = float(np.sqrt((residual**2).sum(1).mean() * len(b) / (len(b) - 7 / 3)))
    if scale <= 0 or spread < MIN_SPREAD * wrong:
        return None, f"the GPS positions have an error of {wrong:.2g} m and a spread of only {spread:.2g} m"
    return Scale(
        scale,
        f"from the GPS positions of {len(known)} photos, with an error of {wrong:.2g} m and a spread of {spread:.2g} m",
    ), ""
