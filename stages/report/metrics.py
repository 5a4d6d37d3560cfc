"""Metrics of the difference between a rendered view and its photo.

Symbols: rendered (H, W, 4) linear RGBA, colour premultiplied (the photo's pixel value over black); photo (H, W, 3)
linear; mask (H, W) in [0, 1], the photo's subject. All metrics use sRGB-encoded values clipped to [0, 1], which is
close to human perception. "Full" images are multiplied by their own alpha first, which removes the background.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.colour import srgb_from_linear

F32 = npt.NDArray[np.float32]
EQUAL = 100.0  # dB for equal images, in place of infinity
FLIP_REACH = 16  # pixels: a difference reaches 5 pixels at its standard distance of the eye


@dataclass(frozen=True, slots=True)
class Scores:
    """psnr (dB, only the subject's pixels), psnr_matched (the same after `matched`), psnr_full (dB), ssim (-1..1),
    flip (0..1, 0 = equal), mask_iou (0..1)."""

    psnr: float
    psnr_matched: float
    psnr_full: float
    ssim: float
    flip: float | None
    mask_iou: float

    def json(self) -> dict[str, float | None]:
        """Rounded values for JSON; values that are not finite become None."""
        return {k: None if v is None or not np.isfinite(v) else round(v, 5) for k, v in asdict(self).items()}


def score(rendered: F32, photo: F32, mask: F32) -> Scores:
    """All metrics of one view. Raises ValueError if the sizes differ or the mask is empty."""
    if rendered.shape[:2] != photo.shape[:2] or mask.shape != photo.shape[:2]:
        raise ValueError(f"sizes differ: rendered {rendered.shape}, photo {photo.shape}, mask {mask.shape}")
    if not (mask > 0.5).any():
        raise ValueError("the mask is empty")
    shown, truth = encoded(rendered[..., :3] * rendered[..., 3:]), encoded(photo * mask[..., None])
    return Scores(
        psnr_fg(rendered[..., :3], photo, mask),
        psnr_fg(matched(rendered, photo, mask)[..., :3], photo, mask),
        psnr(shown, truth),
        ssim(shown, truth),
        flip(truth, shown),
        iou(rendered[..., 3], mask),
    )


def encoded(linear: F32) -> F32:
    """sRGB-encoded values of linear ones, clipped to [0, 1]."""
    return np.asarray(srgb_from_linear(np.asarray(linear, np.float32).clip(0, 1)), np.float32)


def psnr(a: F32, b: F32) -> float:
    """-10 log10 of the mean squared difference of two encoded images, in dB; at most 100."""
    error = float(np.mean((a.astype(np.float64) - b) ** 2))
    return min(EQUAL, -10 * float(np.log10(max(error, 1e-10))))


def psnr_fg(rendered: F32, photo: F32, mask: F32) -> float:
    """PSNR of linear images over the pixels with mask > 0.5. The background can't raise it."""
    inside = mask > 0.5
    return psnr(encoded(rendered[inside]), encoded(photo[inside]))


def matched(rendered: F32, photo: F32, mask: F32) -> F32:
    """The render (H, W, 4) after the 3 x 3 colour matrix that fits its subject to the photo, by least squares in linear
    values. The exposure and white balance of a held-out photo are unknown. [NeuFace, evaluation protocol]"""
    inside = mask > 0.5
    known, wanted = (x[inside].astype(np.float64) for x in (rendered[..., :3], photo))
    matrix = np.linalg.lstsq(known, wanted, rcond=1e-6)[0]
    return np.concatenate([rendered[..., :3] @ matrix, rendered[..., 3:]], -1).astype(np.float32)


def ssim(a: F32, b: F32) -> float:
    """Structural similarity of two encoded images (H, W, 3), Gaussian window of sigma 1.5. [Wang et al. 2004]

    NaN for images smaller than the window (11 pixels).
    """
    from skimage import metrics

    if min(a.shape[:2]) < 11:
        return float("nan")
    compare: Any = metrics.structural_similarity
    return float(
        compare(a, b, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False)
    )


def flip(reference: F32, test: F32) -> float | None:
    """Mean FLIP of two encoded images (H, W, 3) [Andersson et al. 2020]; None if flip-evaluator is not installed.

    It is evaluated in the rectangle around what is not black in one of them: beyond the reach of its filters it is 0.
    """
    try:
        from flip_evaluator import evaluate
    except ImportError:
        return None
    lit = (reference != 0).any(2) | (test != 0).any(2)
    if not lit.any():
        return 0.0
    rows, columns = (_around(np.flatnonzero(lit.any(axis)), lit.shape[1 - axis]) for axis in (1, 0))
    some = [np.ascontiguousarray(x[rows, columns]) for x in (reference, test)]
    found = evaluate(*some, "LDR", True, False)[0]
    return float(found.sum(dtype=np.float64) / lit.size)


def _around(places: npt.NDArray[np.int64], size: int) -> slice:
    """From the first place to the last, and the reach of FLIP's filters beyond both, inside of a picture."""
    return slice(max(int(places[0]) - FLIP_REACH, 0), min(int(places[-1]) + FLIP_REACH + 1, size))


def iou(alpha: F32, mask: F32) -> float:
    """Intersection over union of two silhouettes (H, W), thresholded at 0.5."""
    a, b = alpha > 0.5, mask > 0.5
    return float((a & b).sum() / max((a | b).sum(), 1))


def mean_scores(scores: list[Scores]) -> dict[str, float | None]:
    """The mean of each metric over views; None if no view has it."""
    out: dict[str, float | None] = {}
    for name in Scores.__dataclass_fields__:
        values = [v for s in scores if (v := getattr(s, name)) is not None and np.isfinite(v)]
        out[name] = round(float(np.mean(values)), 5) if values else None
    return out
