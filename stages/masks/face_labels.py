"""Label pictures: face, eyes and hair in a photo.

Labels are codes (pipeline/faces/labels.py). The face is the convex hull of its landmarks, the eyes are the areas
between the lids (pipeline.faces). Closed eyes are labelled like open ones: the landmarks hardly differ. Hair is
labelled only with the user's network, because no such network may be redistributed; without it hair is subject, or
face. Colour does not separate it: the stubble of shaved heads is as different from their skin as fair hair from other
skin.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.faces.find import LEFT_EYE, RIGHT_EYE, Face, find_face
from pipeline.faces.labels import EYES, FACE, HAIR, SUBJECT
from pipeline.transforms import F64
from stages.masks.region import F32, U8, Disc, eroded
from stages.masks.user_model import UserModel

REACH = 1.2  # radii of the region of interest in which a face is searched
CROP, SURE = 1.3, 0.5  # half-edge of the hair network's crop in such radii; smallest probability of hair
INSIDE = 0.85  # smallest share of the landmarks on the subject: excludes faces in pictures on a wall


def subjects_face(image: U8, alpha: F32, disc: Disc) -> Face | None:
    """The face in the region of interest of a photo (H, W, 3) 8-bit sRGB, if it lies on the mask (H, W); else None."""
    face = find_face(image, disc.x, disc.y, REACH * disc.radius, disc.roll)
    return face if face is not None and on_subject(face, alpha) >= INSIDE else None


def labels_with(face: Face | None, image: U8, alpha: F32, disc: Disc, hair: UserModel | None) -> U8 | None:
    """(H, W) labels of a photo (H, W, 3) 8-bit sRGB with its mask (H, W), or None without face and hair.

    face: from `subjects_face`. hair: the user's network, if any; its label replaces all others except the eyes.
    """
    out = (alpha >= 0.5).astype(np.uint8) * SUBJECT
    if face is not None:
        # not the oval around the face, which crosses the nose in side views
        hull = cv2.convexHull(face.points.astype(np.float32)).reshape(-1, 2)
        _fill(out, hull.astype(np.float64), FACE)
        for eye in (RIGHT_EYE, LEFT_EYE):
            _fill(out, face.points[list(eye)], EYES)
    if hair is not None:
        out[(out > 0) & (out != EYES) & (_probability(image, disc, hair) >= SURE)] = HAIR
    return out if out.max() > SUBJECT else None


def _probability(image: U8, disc: Disc, model: UserModel) -> F32:
    """(H, W) probability of hair. The network's input is the upright square around the region of interest, padded by
    repeated edges."""
    h, w = image.shape[:2]
    scale = 2 * CROP * disc.radius / model.side
    c, s = np.cos(disc.roll) * scale, np.sin(disc.roll) * scale
    turn = np.array([[c, -s], [s, c]])  # photo position = centre + turn (network's position - middle)
    shift = np.array([disc.x - 0.5, disc.y - 0.5]) - turn @ np.array([model.side / 2 - 0.5] * 2)
    photo_from_net = np.concatenate([turn, shift[:, None]], 1)
    blurred = cv2.GaussianBlur(image, (0, 0), 0.4 * scale) if scale > 1.3 else image  # against aliasing
    square = cv2.warpAffine(blurred, photo_from_net, (model.side, model.side),
                            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    found = model.probability(np.asarray(square, np.uint8))
    return np.asarray(cv2.warpAffine(found, photo_from_net, (w, h), flags=cv2.INTER_LINEAR), np.float32)


def on_subject(face: Face, alpha: F32) -> float:
    """Share of the face's landmarks that lie on the mask (H, W)."""
    h, w = alpha.shape
    at = np.floor(face.points).astype(np.int64)
    within = (at >= 0).all(1) & (at[:, 0] < w) & (at[:, 1] < h)
    return float((alpha[at[within, 1], at[within, 0]] >= 0.5).sum() / len(at))


def _fill(labels: npt.NDArray[np.uint8], outline: F64, value: int) -> None:
    """Set the label inside an outline (N, 2), except outside of the subject and on its edge pixels. In place."""
    drawn = np.zeros_like(labels)
    at = np.round((outline - 0.5) * 16).astype(np.int32)  # OpenCV's first pixel is at (0, 0)
    cv2.fillPoly(drawn, [at], 1, shift=4)
    labels[(drawn > 0) & eroded(labels > 0, 1)] = value
