"""Whether a part of a visual hull that one mask lacks is the subject.

A hull is an upper limit of the subject. Where a mask lacks what the hull of the others has, either of the two may be
wrong: beside a shoulder that leaves most frames, a hull has parts that no photo could carve. Two things tell:

- Other masks need the part: without it, the hull no longer covers them.
- Nearly all views have the part in their frames, so that many directions could have carved it, and did not. A part that
  lies before or behind the rest of the subject in the other views is needed by none of them: a notch in the neck of a
  statue.

Measured: of the parts that single masks lacked, a statue's neck is in the frame of .98 to 1 of 58 views; empty space
beside the shoulders of two persons in that of .41 to .50 of 29 and 34 views (medians over the voxels).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.hull import BAND_CELLS, Hull, cloud, render_silhouette
from pipeline.transforms import inverse_rigid, matrix, project

F32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]
LEAST = 0.01  # of a mask: the largest region that it loses; noise of its outline is smaller
MASKS = 2  # that lose so much: one may be wrong itself
KNOWN = 0.9  # of the views: they have the part in their frames
MARGIN = 1.0  # voxels by which a silhouette of the hull may be wrong
# Of a silhouette: what a mask lacks is larger. One view may rightly carve a concavity: 1 % at a shoulder (head scan).
MISSING = 0.02
CUBE = 1.6  # half-edge of a hull's cube in radii of the region of interest


def voxels_at(hull: Hull, camera: Camera, where: Bool) -> Bool:
    """(X, Y, Z) voxels inside the hull whose centres project into `where`, (h, w) of the camera's whole frame."""
    inside = hull.level <= 0
    uv, z = project(matrix(camera.K), inverse_rigid(matrix(camera.world_from_cam)),
                    np.array(camera.distortion), hull.centres(inside))  # fmt: skip
    h, w = where.shape
    at = np.floor(np.nan_to_num(uv, nan=-1.0) * (w / camera.width, h / camera.height))
    seen = (z > 0) & (at >= 0).all(1) & (at < (w, h)).all(1)
    column, row = at[seen].astype(np.intp).T
    hit = np.zeros(len(uv), np.bool_)
    hit[seen] = where[row, column]
    out = np.zeros(hull.level.shape, np.bool_)
    out[inside] = hit
    return out


def masks_in_need(
    hull: Hull, part: Bool, cameras: Sequence[Camera], alphas: Sequence[F32], shown: Sequence[Bool] | None = None
) -> Iterator[int]:
    """Positions of the masks, found one by one, that the hull covers less without a part of it: by a region that is
    larger than LEAST of the mask and lies more than MARGIN voxels beside what is left. part: (X, Y, Z). alphas:
    (h, w) each, small. shown: the hull's silhouettes (h, w), if they are known."""
    if not part.any():
        return
    rest = replace(
        hull, level=np.where(part, np.float32(BAND_CELLS * hull.cell), hull.level), occupied=hull.occupied & ~part
    )
    whole, left = cloud(hull), cloud(rest) if (rest.level <= 0).any() else None
    for i, (camera, alpha) in enumerate(zip(cameras, alphas, strict=True)):
        (h, w), inside = alpha.shape, alpha >= 0.5
        covered = (render_silhouette(whole, camera, h, w) >= 0.5) if shown is None else shown[i]
        if left is not None:
            still = render_silhouette(left, camera, h, w) >= 0.5
            covered = covered & ~grown(still, margin_of(camera, w, hull.cell, MARGIN))
        if regions(covered & inside, LEAST * inside.sum()):
            yield i


def is_subject(hull: Hull, part: Bool, cameras: Sequence[Camera], alphas: Sequence[F32]) -> bool:
    """Whether nearly all views have the part in their frames, or at least MASKS masks need it. part: (X, Y, Z) voxels
    inside the hull, which these views carved."""
    if not part.any():
        return False
    known = float(np.median(hull.seen[part])) >= KNOWN * len(cameras)
    return known or len(list(islice(masks_in_need(hull, part, cameras, alphas), MASKS))) >= MASKS


def margin_of(camera: Camera, width: int, cell: float, voxels: float) -> int:
    """Pixels of a picture `width` wide that this many voxels at the origin cover, at least 1. cell: asset units."""
    depth = abs(float(inverse_rigid(matrix(camera.world_from_cam))[2, 3]))
    K = matrix(camera.K)
    pixels = float(np.sqrt(K[0, 0] * K[1, 1])) / max(depth, 1e-9)
    return max(1, round(voxels * pixels * cell * width / camera.width))


def grown(mask: Bool, radius: int) -> Bool:
    """(h, w) dilation of a mask by `radius` pixels; there is no mask beyond the frame."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc)) > 0


def regions(mask: Bool, least: float) -> list[Bool]:
    """The connected regions (h, w) of a mask with more than `least` pixels."""
    count, label, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return [np.asarray(label == k) for k in range(1, count) if facts[k, cv2.CC_STAT_AREA] > least]


def clearly_lacking(shown: Bool, inside: Bool, margin: int) -> list[Bool]:
    """The regions (h, w) that a hull's silhouette clearly shows and a mask clearly lacks, each up to the mask's edge.

    shown, inside: (h, w). margin: pixels by which either may be wrong."""
    clear = ~grown(~shown, margin) & ~grown(inside, margin)
    large = regions(clear, MISSING * max(int(shown.sum()), 1))
    return [np.asarray(grown(region, 2 * margin) & shown & ~inside) for region in large]
