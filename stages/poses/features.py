"""SIFT features of one photo, spread over the frame.

Skin has little contrast, so the detector's threshold is far below its usual value. The strongest features of each cell
of a grid are kept, so that a sharp background or the eyebrows do not use up the number of features.
Positions are in pixels of the full photo, first pixel's centre at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.colour import LUMA_OF_ENCODED, srgb_from_linear

F32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]

LAYERS, SIGMA = 3, 1.6  # Lowe's values
GRID = 8
OVERSAMPLING = 2  # detected features per kept one, so that each cell can be filled
NLM_STRENGTH, NLM_PATCH, NLM_WINDOW = 8.0, 5, 15  # levels of 255, pixels, pixels


@dataclass(frozen=True, slots=True)
class Effort:
    """Parameters of detection and matching. contrast: cv2's threshold (the default 0.04 detects almost nothing on
    skin). edge_ratio: largest elongation of a feature. ratio: Lowe's ratio test on distances. denoise: non-local means
    first. tilts: number of simulated oblique views, in steps of the square root of 2 (Morel, Yu, ASIFT, 2009).
    """

    contrast: float
    edge_ratio: float
    ratio: float
    denoise: bool
    tilts: int = 0


PLAIN = Effort(contrast=0.004, edge_ratio=10.0, ratio=0.85, denoise=False)
# second attempt, for noisy or small photos: edges of wrinkles and hair too; verification removes wrong matches
DENOISED = Effort(contrast=0.001, edge_ratio=20.0, ratio=0.9, denoise=True)
# last attempt, ten times slower: photos too far apart for SIFT, such as the next ring of cameras seen from above
ASIFT = Effort(contrast=0.001, edge_ratio=20.0, ratio=0.9, denoise=True, tilts=2)
MORE_ASIFT = 3  # times the features: a spot is detected under several tilts


@dataclass(frozen=True, slots=True)
class Features:
    """uv: (N, 2) float32, pixels of the full photo. descriptors: (N, 128) float32, unit length. Strongest first."""

    uv: F32
    descriptors: F32


def grey8(image: npt.NDArray[np.generic], max_edge: int) -> U8:
    """(H, W, C) as stored -> (h, w) 8-bit, encoded as sRGB, longest edge at most `max_edge`.

    Float pictures are linear, without a fixed white: their 99th percentile is mapped to white.
    """
    plane: F32 = np.asarray(image[..., :3], np.float32)
    if np.issubdtype(image.dtype, np.floating):
        white = max(float(np.quantile(plane, 0.99)), 1e-6)
        plane = np.asarray(srgb_from_linear((plane / white).clip(0, 1)) * 255, np.float32)
    elif image.dtype == np.uint16:
        plane = plane / np.float32(257)
    grey: F32 = plane[..., 0] if plane.shape[2] == 1 else plane @ np.array(LUMA_OF_ENCODED, np.float32)
    h, w = grey.shape
    scale = min(1.0, max_edge / max(h, w))
    if scale < 1:
        reduced = cv2.resize(grey, (round(w * scale), round(h * scale)), interpolation=cv2.INTER_AREA)
        grey = np.asarray(reduced, np.float32)
    return np.round(grey).clip(0, 255).astype(np.uint8)


def detect(
    grey: U8, size: tuple[int, int], max_features: int, effort: Effort = PLAIN, inside: U8 | None = None
) -> Features:
    """Features of a (possibly reduced) grey picture (h, w), in pixels of the photo of `size` (width, height).

    inside: (h, w) mask; features where it is 0 are left out.
    """
    if effort.denoise:
        grey = np.asarray(cv2.fastNlMeansDenoising(grey, None, NLM_STRENGTH, NLM_PATCH, NLM_WINDOW), np.uint8)
    sift = cv2.SIFT_create(  # type: ignore[attr-defined]
        max_features * OVERSAMPLING, LAYERS, effort.contrast, effort.edge_ratio, SIGMA, cv2.CV_32F, True
    )
    finder = cv2.AffineFeature.create(sift, effort.tilts, 0) if effort.tilts else sift
    keypoints, raw = finder.detectAndCompute(grey, inside)
    kept = _spread(keypoints, grey.shape, max_features)
    if not len(kept):
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    raw = np.asarray(raw, np.float32)[kept]
    root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-12))  # RootSIFT: unit length, Hellinger distance
    # cv2 puts the first pixel's centre at 0; the reduced picture's pixels are size / shape photo pixels wide
    stretch = np.array([size[0] / grey.shape[1], size[1] / grey.shape[0]])
    uv = (np.array([keypoints[i].pt for i in kept], np.float64) + 0.5) * stretch
    return Features(uv.astype(np.float32), root.astype(np.float32))


def _spread(keypoints: Sequence[cv2.KeyPoint], shape: tuple[int, ...], count: int) -> npt.NDArray[np.int64]:
    """Indices of at most `count` keypoints: the strongest of each grid cell, then the second of each cell, and so
    on."""
    if not keypoints:
        return np.zeros(0, np.int64)
    xy = np.array([k.pt for k in keypoints])
    response = np.array([k.response for k in keypoints])
    cell = (xy[:, 1] * GRID / shape[0]).astype(int).clip(0, GRID - 1) * GRID
    cell += (xy[:, 0] * GRID / shape[1]).astype(int).clip(0, GRID - 1)
    # ties are sorted by position, so that the order does not depend on the detector's threads
    order = np.lexsort((xy[:, 0], xy[:, 1], -response))
    rank = np.empty(len(order), int)
    for c in np.unique(cell):
        members = order[cell[order] == c]
        rank[members] = np.arange(len(members))
    kept = order[np.argsort(rank[order], kind="stable")][:count]
    return kept[np.argsort(-response[kept], kind="stable")]
