"""How far the features of a face lie in a render from where the photo shows them.

The landmark network (pipeline.faces.find) tells where they are in the photo, and no more: it knows what faces look
like, and finds only half of a shift sideways. The shift itself is that at which a window of the render, around the
feature, correlates best with the photo:

    s = argmax NCC(render(x), photo(x + s)),    x in the window, |s| <= REACH in both directions

with the top of the quadratic through the largest correlation and its neighbours, for fractions of a pixel. Photo and
render lie on the same grey. Lengths are in pixels of a photo whose longer side has UNIT of them. Where the render looks
like nothing in the photo (NCC < LEAST), there is no shift.

Source of NCC: Lewis, Fast Normalized Cross-Correlation (1995).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.colour import LUMA
from pipeline.faces.find import LEFT_EYE, RIGHT_EYE, find_face
from stages.report.metrics import encoded

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

# Points of the network on each feature; a window goes around them.
FEATURES = {
    "eyes": (*RIGHT_EYE, *LEFT_EYE),
    "brows": (70, 63, 105, 66, 107, 336, 296, 334, 293, 300),
    "nose": (1, 2, 4, 5, 6, 48, 64, 97, 98, 168, 195, 197, 278, 294, 326, 327),
    "mouth": (61, 91, 84, 17, 314, 321, 291, 269, 267, 0, 37, 39, 78, 82, 13, 312, 308, 317, 14, 87),
    "chin": (172, 136, 150, 149, 176, 148, 152, 377, 400, 378, 379, 365, 397),
}
# Ears have no points: each lies outside of the end of the jaw, at the height of the eyes' corner to the mouth.
EARS = {"right ear": (234, 454), "left ear": (454, 234)}  # the face's border before the ear, and beyond the other ear
NOSE_TIP = 1
UNIT, REACH = 512, 12  # pixels of the longer side; the largest shift that is sought
MARGIN, OUT, EAR = 0.06, 0.08, (0.09, 0.16)  # of the face's size: around points; to an ear; half of an ear's window
SHOWN = 0.4  # of the face's width between nose and its border, from which the ear behind that border can be seen
LEAST = 0.7  # correlation
FLAT = 2.0  # standard deviation of a window in 8 bit, below which there is nothing to compare
GREY = 0.2  # linear, behind the subject


def feature_shifts(photo: F32, mask: F32, render: F32) -> dict[str, float]:
    """The length of the shift of each feature, pixels at UNIT; {} where the photo shows no face. photo (H, W, 3) and
    render (H, W, 4) linear, the render premultiplied; mask (H, W) of the subject."""
    h, w = photo.shape[:2]
    scale = UNIT / max(h, w)
    shown = encoded(np.asarray(photo * mask[..., None] + GREY * (1 - mask[..., None]), np.float32))
    made = encoded(np.asarray(render[..., :3] + GREY * (1 - render[..., 3:].clip(0, 1)), np.float32))
    face = find_face(np.rint(255 * shown).astype(np.uint8), w / 2, h / 2, max(h, w) / 2)
    if face is None:
        return {}
    one, two = (_grey(x, scale) for x in (shown, made))
    out = {}
    for name, (low, high) in _windows(face.points * scale).items():
        found = shift(one, two, low, high)
        if found is not None:
            out[name] = float(np.hypot(*found))
    return out


def _grey(picture: F32, scale: float) -> F32:
    """(H', W') luma in 8-bit values, at another size."""
    luma = 255 * picture @ np.array(LUMA, np.float32)
    return np.asarray(cv2.resize(luma, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.float32)


def shift(photo: F32, render: F32, low: F64, high: F64) -> tuple[float, float] | None:
    """(x, y) from a window of the render to where the photo (H, W) shows the same, pixels; None where that is nowhere
    or the window, from low (2,) to high (2,), is flat or leaves the picture."""
    size = np.array(photo.shape[::-1])
    a, b = np.maximum(np.floor(low).astype(int), REACH), np.minimum(np.ceil(high).astype(int), size - REACH)
    if (b - a).min() < REACH:
        return None
    window = np.ascontiguousarray(render[a[1] : b[1], a[0] : b[0]])
    around = np.ascontiguousarray(photo[a[1] - REACH : b[1] + REACH, a[0] - REACH : b[0] + REACH])
    if min(window.std(), around.std()) < FLAT:
        return None
    likeness = np.asarray(cv2.matchTemplate(around, window, cv2.TM_CCOEFF_NORMED), np.float64)
    y, x = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
    if likeness[y, x] < LEAST:
        return None
    dx, dy = _within(likeness, int(x), int(y))
    return float(x + dx - REACH), float(y + dy - REACH)


def feature_figures(shifts: Mapping[int, Mapping[str, float]]) -> dict[str, Any]:
    """For metrics.json, of the shifts of each view by its index: the median over all features but ears, the largest,
    and all of them; nothing where no view shows a face."""
    known = {str(i): {n: round(v, 2) for n, v in of.items()} for i, of in shifts.items() if of}
    values = [v for of in known.values() for n, v in of.items() if n in FEATURES]
    if not values:
        return {}
    return {"features_px": round(float(np.median(values)), 2), "features_px_most": max(values), "features": known}


def _windows(points: F64) -> dict[str, tuple[F64, F64]]:
    """Lower and upper corner (2,) of the window of each feature and of each ear that can be seen; points (468, 2)."""
    size = float(np.ptp(points, axis=0).max())
    out = {}
    for name, of in FEATURES.items():
        out[name] = points[list(of)].min(0) - MARGIN * size, points[list(of)].max(0) + MARGIN * size
    for name, (own, other) in EARS.items():
        across = points[own] - points[other]
        width = float(np.linalg.norm(across))
        if (points[own] - points[NOSE_TIP]) @ across >= SHOWN * width * width > 0:
            middle, half = points[own] + OUT * size * across / width, np.array(EAR) * size
            out[name] = middle - half, middle + half
    return out


def _within(values: F64, x: int, y: int) -> tuple[float, float]:
    """From the largest value to the top of the quadratic through it and its eight neighbours, each way one at most."""
    if not (0 < x < values.shape[1] - 1 and 0 < y < values.shape[0] - 1):
        return 0.0, 0.0
    v = values[y - 1 : y + 2, x - 1 : x + 2]
    slope = 0.5 * np.array([v[1, 2] - v[1, 0], v[2, 1] - v[0, 1]])
    both = 0.25 * (v[2, 2] - v[2, 0] - v[0, 2] + v[0, 0])
    bend = np.array([[v[1, 2] - 2 * v[1, 1] + v[1, 0], both], [both, v[2, 1] - 2 * v[1, 1] + v[0, 1]]])
    if not (bend[0, 0] < 0 and np.linalg.det(bend) > 0):  # a ridge has no top
        return 0.0, 0.0
    top = np.linalg.solve(bend, -slope).clip(-1, 1)
    return float(top[0]), float(top[1])
