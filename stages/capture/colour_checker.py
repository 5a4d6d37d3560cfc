"""Detection of a classic colour checker (24 patches) in a photo, and the linear colours of its patches.

Frames: corners are pixels of the photo, the first pixel's centre at (0.5, 0.5). Chart coordinates (x, y) run from
(-1, -1) at the first patch, dark skin, to (1, 1) at the last, black; both points lie half the gap between patches
outside of the patch's outer corner. So patches are 1/3 apart in x and 1/2 in y.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.colour import linear_from_srgb, srgb_from_linear
from stages.capture.photometry import clipped

F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

WORKING = 1000  # pixels, longest edge of the picture that is searched
THUMBNAIL, DIM, HUE, HUE_PIXELS = 250, 0.03, 0.04, 6  # pixels; sum of a pixel's channels; cell of chromaticity; pixels
HUES = 24  # fewest cells for a search: rendered charts have 35 to 110, a head on black 11 to 20
STEP = (
    48  # pixels between the detector's threshold windows: the default 16 detects hardly more, in three times the time
)
COLUMNS, ROWS = 6, 4
PATCHES = COLUMNS * ROWS
CORNERS: F64 = np.array([[-1.0, -1.0], [1, -1], [1, 1], [-1, 1]])
MEASURED = 0.5  # edge of the measured part of a patch, as a share of the distance between patches
CELL, ROUNDS = 48, 3  # pixels between patches of the rectified chart; number of rectifications
SMALLEST, LARGEST = 0.4, 1.1  # edge of a patch, as a share of the distance between patches
LIKE = 16  # levels: pixels that differ less belong to one patch
MIN_PIXELS = 9  # of the measured part of a patch
CLIPPED = 0.02  # largest share of a patch's pixels that may be clipped

# Linear Rec.709 of the patches where a perfect white is (1, 1, 1): the maker's CIE L*a*b* (D50, charts before November
# 2014), adapted to D65 by Bradford's matrix. By rows: dark skin to bluish green, orange to orange yellow, blue to cyan,
# white to black. Cyan lies outside the gamut.
REFLECTANCES: F64 = np.array([
    [0.1730, 0.0821, 0.0567], [0.5682, 0.2927, 0.2184], [0.1036, 0.1959, 0.3314],
    [0.1016, 0.1489, 0.0519], [0.2215, 0.2159, 0.4347], [0.1079, 0.5144, 0.4127],
    [0.7473, 0.2007, 0.0281], [0.0575, 0.1052, 0.4030], [0.5667, 0.0843, 0.1197],
    [0.1110, 0.0423, 0.1429], [0.3453, 0.5088, 0.0495], [0.7945, 0.3595, 0.0205],
    [0.0171, 0.0502, 0.2922], [0.0559, 0.3002, 0.0687], [0.4558, 0.0303, 0.0409],
    [0.8572, 0.5676, 0.0069], [0.5335, 0.0886, 0.3075], [-0.0375, 0.2470, 0.4004],
    [0.9123, 0.9150, 0.8938], [0.5796, 0.5921, 0.5934], [0.3548, 0.3655, 0.3676],
    [0.1900, 0.1919, 0.1931], [0.0853, 0.0889, 0.0926], [0.0303, 0.0311, 0.0328],
])  # fmt: skip


@dataclass(frozen=True, slots=True)
class Patches:
    """A chart in a photo. corners: (4, 2) pixels, in order around the chart, the first patch's first. colours: (24, 3)
    mean linear values of the patches' centres. usable: (24,) patches that are large enough and not clipped."""

    corners: F64
    colours: F64
    usable: Bool


def places() -> F64:
    """(24, 2) centres of the patches in chart coordinates."""
    x, y = np.meshgrid((np.arange(COLUMNS) + 0.5) * 2 / COLUMNS - 1, (np.arange(ROWS) + 0.5) * 2 / ROWS - 1)
    return np.stack([x.ravel(), y.ravel()], 1)


def find_chart(image: npt.NDArray[np.generic]) -> Patches | None:
    """The chart in a decoded photo (H, W, C), 8 or 16 bit sRGB or linear float; None if there is none, or in a grey
    photo.

    The detector is OpenCV's `cv2.mcc`, by contours: the wheel does not contain its network.
    """
    if image.shape[2] < 3 or hues(_shown(image, min(1.0, THUMBNAIL / max(image.shape[:2])))) < HUES:
        return None
    scale = min(1.0, WORKING / max(image.shape[:2]))
    detector: Any = cv2.mcc.CCheckerDetector.create()
    detector.setColorChartType(cv2.mcc.MCC24)
    detector.setUseDnnModel(False)
    settings = detector.getDetectionParams()
    settings.adaptiveThreshWinSizeStep = STEP
    settings.minImageSize = 1  # else small photos are enlarged, and take longer
    detector.setDetectionParams(settings)
    small = _shown(image, scale)
    if not detector.process(small, 1):
        return None
    middles = np.asarray(detector.getBestColorChecker().getColorCharts(), np.float64).reshape(PATCHES, 4, 2).mean(1)
    start: Any = cv2.findHomography(places(), middles)[0]
    if start is None:
        return None
    corners = _settled(small, _mapped(np.asarray(start, np.float64), CORNERS))
    return _measured(image, (corners + 0.5) / scale)


def hues(small: npt.NDArray[Any]) -> int:
    """Number of chromaticities in a small picture (h, w, 3), 8-bit sRGB. Under any one light a chart has more of them
    than most heads and walls, so a picture with fewer need not be searched."""
    linear = np.asarray(linear_from_srgb(np.arange(256) / 255), np.float32)[small].reshape(-1, 3)
    total = linear.sum(1)
    shown = total > DIM
    cell = np.floor(linear[shown, :2] / total[shown, None] / HUE).astype(np.int64)
    counts = np.bincount(cell[:, 0] * round(2 / HUE) + cell[:, 1])
    return int((counts >= HUE_PIXELS).sum())


def _settled(small: npt.NDArray[Any], corners: F64) -> F64:
    """Corners (4, 2), refined from the patches: the detector's are off by up to a third of a patch.

    The chart is rectified with a margin of one cell. The connected area with the colour of a cell's centre is its
    patch, unless it is too large or too small. The centres of these patches give the corrected homography.
    """
    for _ in range(ROUNDS):
        half_x, half_y = COLUMNS * CELL / 2, ROWS * CELL / 2
        flat_from_chart = np.array([[half_x, 0, half_x + CELL], [0, half_y, half_y + CELL], [0, 0, 1]])
        photo_from_flat = _homography(corners) @ np.linalg.inv(flat_from_chart)
        size = ((COLUMNS + 2) * CELL, (ROWS + 2) * CELL)
        flat = cv2.warpPerspective(small, photo_from_flat, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        flat = cv2.medianBlur(flat, 5)
        at, to = [], []
        for place, seed in zip(places(), _mapped(flat_from_chart, places()), strict=True):
            found = _patch(flat, (round(seed[0]), round(seed[1])))
            if found is not None:
                at.append(place)
                to.append(found)
        if len(at) < PATCHES // 2:
            break
        moved: Any = cv2.findHomography(np.array(at), _mapped(photo_from_flat, np.array(to)), cv2.RANSAC, 2.0)[0]
        if moved is None:
            break
        corners = _mapped(np.asarray(moved, np.float64), CORNERS)
    return corners


def _patch(flat: npt.NDArray[Any], seed: tuple[int, int]) -> tuple[float, float] | None:
    """Centre of the area of one colour around a pixel of the rectified chart, if it has the size of a patch."""
    inside = np.zeros((flat.shape[0] + 2, flat.shape[1] + 2), np.uint8)
    how = 4 | (255 << 8) | cv2.FLOODFILL_FIXED_RANGE | cv2.FLOODFILL_MASK_ONLY
    _, _, _, (x, y, w, h) = cv2.floodFill(flat, inside, seed, 0, (LIKE,) * 3, (LIKE,) * 3, how)
    if not all(SMALLEST * CELL <= edge <= LARGEST * CELL for edge in (w, h)):
        return None
    return x + (w - 1) / 2, y + (h - 1) / 2


def _homography(corners: F64) -> F64:
    """(3, 3) from chart coordinates to OpenCV's pixels."""
    return np.asarray(cv2.getPerspectiveTransform(CORNERS.astype(np.float32), corners.astype(np.float32)), np.float64)


def _mapped(homography: F64, at: F64) -> F64:
    out = np.concatenate([at, np.ones((len(at), 1))], 1) @ homography.T
    return np.asarray(out[:, :2] / out[:, 2:], np.float64)


def _shown(image: npt.NDArray[np.generic], scale: float) -> npt.NDArray[Any]:
    """The photo as the detector reads it: (h, w, 3), reduced by `scale`, 8-bit sRGB, BGR."""
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    plane: Any = np.ascontiguousarray(image[..., 2::-1])
    small: Any = cv2.resize(plane, size, interpolation=cv2.INTER_AREA)
    if small.dtype == np.uint8:
        return np.asarray(small)
    if np.issubdtype(small.dtype, np.integer):
        return np.asarray(small / 257, np.uint8)
    lit = small / max(float(np.quantile(small, 0.99)), 1e-6)
    return np.asarray(srgb_from_linear(lit.clip(0, 1)) * 255, np.uint8)


def _measured(image: npt.NDArray[np.generic], corners: F64) -> Patches | None:
    """The patches' colours at full resolution. corners: (4, 2) pixels, the first pixel's centre at (0.5, 0.5)."""
    colours, usable = np.zeros((PATCHES, 3)), np.zeros(PATCHES, bool)
    to_photo = _homography(corners)
    for i, middle in enumerate(places()):
        outline = _mapped(to_photo, middle + MEASURED * CORNERS / [COLUMNS, ROWS])
        low = np.floor(outline.min(0)).astype(int).clip(0)
        high = np.ceil(outline.max(0)).astype(int).clip(None, image.shape[1::-1])
        part = image[low[1] : high[1], low[0] : high[0]]
        if not part.size:
            continue
        inside = np.zeros(part.shape[:2], np.uint8)
        cv2.fillConvexPoly(inside, np.round(outline - low - 0.5).astype(np.int32), 1)
        where = inside > 0
        if not where.any():
            continue
        ends = clipped(part)[where] if np.issubdtype(image.dtype, np.integer) else np.zeros(int(where.sum()), bool)
        colours[i] = _linear(part[where][:, :3]).mean(0)
        usable[i] = len(ends) >= MIN_PIXELS and ends.mean() <= CLIPPED
    return Patches(corners, colours, usable) if usable.any() else None


def _linear(values: npt.NDArray[np.generic]) -> F64:
    if not np.issubdtype(values.dtype, np.integer):
        return np.asarray(values, np.float64)
    return np.asarray(linear_from_srgb(np.asarray(values, np.float64) / np.iinfo(values.dtype.name).max), np.float64)
