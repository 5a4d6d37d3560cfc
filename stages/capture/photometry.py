"""Clipped pixels and relative exposure of photos. Files are never changed.

Symbols: e_n exposure of photo n, seconds x ISO / f-number^2, relative to the capture's median; b_n its mean linear
luminance. Under one light the linear value of a grey is proportional to e_n.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np
import numpy.typing as npt

from pipeline.colour import linear_from_srgb

CLIPPED = 0.99  # of an integer file's largest value: JPEG leaves clipped areas a level or two below it
PLATEAU = 64  # fewest pixels of a float file with exactly its largest value that count as clipped
EQUAL = 1.02  # exposures that differ by a smaller factor are equal: cameras round the values that they write
FARTHEST = 1e4  # times the median exposure, 13 stops: beyond it the metadata are damaged

Bool = npt.NDArray[np.bool_]


def clipped(image: npt.NDArray[np.generic]) -> Bool:
    """(H, W) pixels with a clipped channel, of a decoded file (H, W, C); alpha is ignored."""
    plane = image[..., : 3 if image.shape[2] >= 3 else 1]
    brightest = np.asarray(reduce(np.maximum, np.moveaxis(plane, 2, 0)))  # 10 times as fast as max(axis=2)
    if np.issubdtype(image.dtype, np.integer):
        return np.asarray(brightest >= CLIPPED * np.iinfo(image.dtype.name).max)
    top = brightest == brightest.max()
    return np.asarray(top if top.sum() >= PLATEAU and brightest.max() > 0 else np.zeros_like(top))


def mean_light(grey: npt.NDArray[np.uint8]) -> float:
    """Mean linear luminance of a grey picture (h, w), encoded as sRGB."""
    table = linear_from_srgb(np.arange(256) / 255)
    return float(table[grey].mean())


def exposures(
    written: Sequence[float | None], light: Sequence[float], fitted: Sequence[bool] | None = None
) -> list[float] | None:
    """e_n of each photo, if all have it in their metadata and the pixels confirm it; else None.

    fitted: the photos that are asked, and whose median is 1 (None: all): pixels of held-out photos decide nothing.

    The pixels confirm it if b_n / e_n vary less than b_n. After a raw converter that equalised the photos, or with a
    flash that lit all of them alike, e_n has no meaning.
    """
    asked = np.ones(len(written), bool) if fitted is None else np.array(fitted, bool)
    known = np.array([e for e in written if e is not None])
    if len(known) < len(written) or not asked.any() or known[asked].max() <= EQUAL * known[asked].min():
        return None
    found = known / float(np.quantile(known[asked], 0.5, method="nearest"))
    if not 1 / FARTHEST <= found.min() <= found.max() <= FARTHEST:
        return None
    b, e = np.log(np.maximum(light, 1e-6))[asked], np.log(found)[asked]
    return [float(f) for f in found] if np.std(b - e) < np.std(b) else None
