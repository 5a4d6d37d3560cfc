"""Where the face and its eyes are in a photo: skin, and what the skin model does not know.

Labels: 0 background, 1 subject, 2 face, 3 eyes. The face is the hull of its landmarks, the eyes are what lies between
the lids (pipeline.faces). Closed eyes are labelled as open ones are: the landmarks hardly differ. Hair and beard have
no label of their own, for no network at hand that may be passed on knows them.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.faces.find import LEFT_EYE, RIGHT_EYE, Face, find_face
from pipeline.transforms import F64
from stages.masks.region import F32, U8, Disc, eroded

SUBJECT, FACE, EYES = 1, 2, 3
REACH = 1.2  # radii of the region of interest in which a face is looked for
INSIDE = 0.85  # share of its points that must lie on the subject: a picture on the wall is no face of theirs


def face_labels(image: U8, alpha: F32, disc: Disc) -> U8 | None:
    """(H, W) labels of a photo (H, W, 3) 8-bit sRGB with its mask (H, W), or None without a face on the subject."""
    face = find_face(image, disc.x, disc.y, REACH * disc.radius, disc.roll)
    if face is None or on_subject(face, alpha) < INSIDE:
        return None
    out = (alpha >= 0.5).astype(np.uint8) * SUBJECT
    # the hull and not the oval around the face, which runs through the nose where it is seen from the side
    hull = cv2.convexHull(face.points.astype(np.float32)).reshape(-1, 2)
    _fill(out, hull.astype(np.float64), FACE)
    for eye in (RIGHT_EYE, LEFT_EYE):
        _fill(out, face.points[list(eye)], EYES)
    return out


def on_subject(face: Face, alpha: F32) -> float:
    """Share of the face's points that lie on the mask."""
    h, w = alpha.shape
    at = np.floor(face.points).astype(np.int64)
    within = (at >= 0).all(1) & (at[:, 0] < w) & (at[:, 1] < h)
    return float((alpha[at[within, 1], at[within, 0]] >= 0.5).sum() / len(at))


def _fill(labels: npt.NDArray[np.uint8], outline: F64, value: int) -> None:
    """The inside of an outline (N, 2), as far as it is on the subject and no edge pixel of it."""
    drawn = np.zeros_like(labels)
    at = np.round((outline - 0.5) * 16).astype(np.int32)  # OpenCV's first pixel is at (0, 0)
    cv2.fillPoly(drawn, [at], 1, shift=4)
    labels[(drawn > 0) & eroded(labels > 0, 1)] = value
