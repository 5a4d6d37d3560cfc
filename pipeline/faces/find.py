"""Detects a face in a photo and 468 landmarks on it: a detector, then a landmark network on an upright square.

Positions are in pixels of the photo, the first pixel's centre at (0.5, 0.5); left and right are the person's own.

The detector (models/NOTICE) takes 128 x 128 RGB in [-1, 1] and has 896 outputs, two for each cell of a 16 x 16 grid and
six for each cell of an 8 x 8 grid: a logit, and a box and six points as offsets from the cell's centre, in pixels of
its input. The landmark network takes 192 x 192 RGB in [0, 1] and returns points in pixels of its input, and a logit for
the presence of a face.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.networks import network

U8 = npt.NDArray[np.uint8]
F64 = npt.NDArray[np.float64]

MODELS = Path(__file__).parent / "models"
DETECTOR_SIDE, LANDMARK_SIDE = 128, 192
SURE, PRESENT = 0.6, 0.8  # least probabilities of a detection, and of landmarks
ROOM = 0.75  # half-edge of the landmarks' square, in edges of the detected box
RIGHT_EYE = (33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246)  # along the lids
LEFT_EYE = (263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466)


@dataclass(frozen=True, slots=True)
class Face:
    """points: (468, 2) pixels. sure: probability that they are on a face."""

    points: F64
    sure: float

    @property
    def pupils(self) -> tuple[F64, F64]:
        """(2,) each: centres of the right and of the left eye, between the eye corners."""
        right, left = ((self.points[eye[0]] + self.points[eye[8]]) / 2 for eye in (RIGHT_EYE, LEFT_EYE))
        return np.asarray(right), np.asarray(left)


def find_face(image: U8, x: float, y: float, half: float, roll: float = 0.0) -> Face | None:
    """The face in the square of half-edge `half` around (x, y) of a photo (H, W, 3) 8-bit sRGB, or None.

    roll: angle of the person's up direction in the photo, radians, clockwise positive.
    """
    photo_from_net = _square(x, y, half, roll, DETECTOR_SIDE)
    logits, found = _detected(image, photo_from_net)
    best = int(np.argmax(logits.ravel()))
    if _probability(float(logits.ravel()[best])) < SURE:
        return None
    offsets = found.reshape(-1, 16)[best]
    middle = offsets[:2] + _cells()[best]
    eyes = offsets[4:8].reshape(2, 2)  # right, left
    lean = float(np.arctan2(*(eyes[1] - eyes[0])[::-1]))
    centre = photo_from_net[:, :2] @ middle + photo_from_net[:, 2] + 0.5
    scale = 2 * half / DETECTOR_SIDE
    return _landmarks(image, centre, ROOM * float(offsets[2:4].max()) * scale, roll + lean)


def face_boxes(
    image: U8, x: float, y: float, half: float, least: float, roll: float = 0.0
) -> list[tuple[F64, float]]:  # fmt: skip
    """Centre (2,) and edge of each face in the square, pixels of the photo, the most probable first; see `find_face`.

    least: least probability. Of detections that overlap by half, the most probable is kept.
    """
    photo_from_net = _square(x, y, half, roll, DETECTOR_SIDE)
    logits, found = _detected(image, photo_from_net)
    offsets, cells = found.reshape(-1, 16), _cells()
    kept: list[tuple[F64, float]] = []
    for k in np.argsort(-logits.ravel(), kind="stable"):
        if _probability(float(logits.ravel()[k])) < least:
            break
        middle, size = offsets[k, :2] + cells[k], float(offsets[k, 2:4].max())
        if all(np.hypot(*(middle - m)) > 0.5 * max(size, s) for m, s in kept):
            kept.append((np.asarray(middle, np.float64), size))
    scale = 2 * half / DETECTOR_SIDE
    return [(photo_from_net[:, :2] @ m + photo_from_net[:, 2] + 0.5, s * scale) for m, s in kept]


def _detected(image: U8, photo_from_net: F64) -> tuple[Any, Any]:
    """Logits and offsets of the detector for the square given by `photo_from_net`."""
    picture = _sampled(image, photo_from_net, DETECTOR_SIDE) * 2 - 1
    return _run("face_detection_short_range", picture, ("classificators", "regressors"))


def _landmarks(image: U8, centre: F64, half: float, roll: float) -> Face | None:
    photo_from_net = _square(centre[0], centre[1], half, roll, LANDMARK_SIDE)
    points, logit = _run("face_landmark", _sampled(image, photo_from_net, LANDMARK_SIDE), ("conv2d_21", "conv2d_31"))
    sure = _probability(float(logit.ravel()[0]))
    if sure < PRESENT:
        return None
    xy = points.reshape(-1, 3)[:, :2].astype(np.float64) - 0.5
    return Face(np.asarray(xy @ photo_from_net[:, :2].T + photo_from_net[:, 2] + 0.5, np.float64), sure)


def _square(x: float, y: float, half: float, roll: float, side: int) -> F64:
    """(2, 3) affine matrix, photo from net, both with the first pixel's centre at (0, 0)."""
    c, s = np.cos(roll) * 2 * half / side, np.sin(roll) * 2 * half / side
    turn = np.array([[c, -s], [s, c]])
    shift = np.array([x - 0.5, y - 0.5]) - turn @ np.array([side / 2 - 0.5] * 2)
    return np.concatenate([turn, shift[:, None]], 1)


def _sampled(image: U8, photo_from_net: F64, side: int) -> npt.NDArray[np.float32]:
    """(side, side, 3) in [0, 1]; black outside the photo."""
    scale = float(np.hypot(*photo_from_net[:, 0]))
    source = cv2.GaussianBlur(image, (0, 0), 0.4 * scale) if scale > 1.3 else image  # against aliasing
    out = cv2.warpAffine(source, photo_from_net, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.asarray(out, np.float32) / np.float32(255)


def _cells() -> F64:
    """(896, 2) centres of the detector's cells, pixels of its input."""
    out = []
    for count, each in ((16, 2), (8, 6)):
        grid = (np.arange(count) + 0.5) * DETECTOR_SIDE / count
        y, x = np.meshgrid(grid, grid, indexing="ij")
        out.append(np.repeat(np.stack([x, y], -1).reshape(-1, 2), each, 0))
    return np.concatenate(out)


def _probability(logit: float) -> float:
    return float(1 / (1 + np.exp(-np.clip(logit, -50, 50))))


def _run(name: str, picture: npt.NDArray[np.float32], outputs: tuple[str, str]) -> tuple[Any, Any]:
    """Two outputs of a network for a picture (S, S, 3)."""
    net = network(MODELS / f"{name}.tflite", cv2.dnn.readNetFromTFLite)
    net.setInput(np.ascontiguousarray(picture.transpose(2, 0, 1)[None]))
    first, second = (
        np.array(net.forward(o), np.float32) for o in outputs
    )  # the file does not declare the second as output
    return first, second
