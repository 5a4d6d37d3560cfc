"""Which pixels count: background, and the subject inside its extent. The others are neither fitted nor scored.

A subject pixel counts if the first surface on its ray is inside the extent, also at a short distance behind it. The
surface is the visual hull of all masks; its points are drawn with a z-buffer, about one point per pixel. Where the
subject is beside the hull (hair, a mask that others contradict), the hull's nearest point decides. Far from any point
it is decided by whether the ray meets the centre of the head, so that a head that the hull lacks is still scored. In a
photo with a detected face that decides before the hull does: photos from below a chin leave pieces of hull before it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from pipeline.artifacts import Camera, Extent
from pipeline.extent import ASKED, BELOW, HEAD_BELOW, HEAD_RADIUS, bounds, core, head_extent, signed
from pipeline.faces.landmarks3d import HeadFrame
from pipeline.hull import Hull, surface_points, visual_hull
from pipeline.transforms import F64, inverse_rigid, matrix, pixel_centres, project, rays
from stages.masks.hull_consistency import CUBE, WRONG_SHARE, tolerated
from stages.masks.judge import open_share
from stages.masks.region import F32, Bool

CELLS = 96  # along the cube in which the hull is carved: 6 mm on a head
BEYOND = 1.25  # half-edge of that cube in radii of the extent, because the space just beyond is needed too
POINT = 1.6  # cells per pixel of the picture that points are drawn into, so that there are no gaps
THICK = 0.2  # h, the head's size: excess thickness of a hull where few photos see it; a second test this far behind
COARSE = 48  # cells along the cube in which the volumes inside and beyond the extent are compared
BUST = (
    1.25  # largest volume beyond over volume inside of a subject that is kept whole (head scans .9, a seated man 1.8)
)
MAX_OPEN = 0.2  # of the edge of the region of interest, above the neck, inside the hull: 0 to .02 all around
NEAR = 0.15  # h: largest distance beside the hull at which its nearest point decides
MIN_ALPHA = 0.01  # alpha of background is below
NOTHING = 1e-3  # of the subject's pixels: if fewer are left out, all pixels count


def whole_hull(cameras: Sequence[Camera], alphas: Sequence[F32], extent: Extent) -> Hull:
    """The visual hull of all masks in and around the extent; a few masks may be wrong. alphas: (h, w) of the voting
    views.

    A voxel needs only one view: shoulders are outside of most frames, and without them pixels beyond the cut would be
    taken for pixels above it."""
    lo, hi = bounds(extent)
    middle, half = 0.5 * (lo + hi), 0.5 * BEYOND * float((hi - lo).max())
    return visual_hull(cameras, alphas, middle - half, middle + half, 2 * half / CELLS, min_views=1,
                       max_outside=tolerated(len(cameras)), outside_share=WRONG_SHARE)  # fmt: skip


def cut_by_head(hull: Hull, cameras: Sequence[Camera], face: F64) -> Hull:
    """A hull that the photos leave open, without what no person with this face fills. face: (468, 3) landmarks."""
    from pipeline.registration.carve import carved_hull
    from pipeline.registration.identity_fit import placed_on_face
    from pipeline.template.load import load_template

    template = load_template()
    head = placed_on_face(template, face)
    centres = np.stack([matrix(c.world_from_cam)[:3, 3] for c in cameras])
    return hull if head is None else carved_hull(hull, template, head, centres)


def kept_whole(cameras: Sequence[Camera], alphas: Sequence[F32], frame: HeadFrame, roi_radius: float) -> bool:
    """Whether the subject is a bust, which is kept whole: a head scan that ends in its shoulders."""
    return share_beyond(cameras, alphas, head_extent(frame, HEAD_BELOW, HEAD_RADIUS), roi_radius) <= BUST


def share_beyond(cameras: Sequence[Camera], alphas: Sequence[F32], extent: Extent, roi_radius: float) -> float:
    """Volume of the hull of the masks (h, w) beyond the extent over that inside it, within CUBE `roi_radius`. Infinite
    for a hull that the photos leave open, as on an arc in front of a face: how far it goes on is unknown."""
    edge = CUBE * roi_radius
    hull = visual_hull(cameras, alphas, [-edge] * 3, [edge] * 3, 2 * edge / COARSE, min_views=min(3, len(cameras)),
                       max_outside=tolerated(len(cameras)), outside_share=WRONG_SHARE)  # fmt: skip
    if open_share(hull, roi_radius) > MAX_OPEN:
        return float("inf")
    beyond = signed(extent, hull.centres(hull.occupied)) > 0
    return float(beyond.sum() / max(int((~beyond).sum()), 1))


def asked(camera: Camera, alpha: F32, extent: Extent, points: F64, face_seen: bool = False) -> F32 | None:
    """(H, W) in [0, 1], at the size of alpha (H, W): 1 for pixels that count. None if all do.

    points: (N, 3) on the surface of the hull. face_seen: a face was detected in the photo, so nothing hides the
    head."""
    depth = _inside(camera, extent, points, face_seen)
    h, w = alpha.shape
    fine = np.asarray(cv2.resize(depth, (w, h), interpolation=cv2.INTER_LINEAR), np.float32)
    subject = alpha > MIN_ALPHA
    out = np.where(subject, (fine + 0.5).clip(0, 1), np.float32(1)).astype(np.float32)
    return out if (out < 0.5).sum() > NOTHING * max(int((alpha >= 0.5).sum()), 1) else None


def _inside(camera: Camera, extent: Extent, points: F64, face_seen: bool) -> F32:
    """(h, w) a small picture: distance of the first surface inside the extent, in pixels of the photo."""
    K, d = matrix(camera.K), np.array(camera.distortion, np.float64)
    uv, z = project(K, inverse_rigid(matrix(camera.world_from_cam)), d, points)
    middle, radius = core(extent)
    away = float(np.linalg.norm(matrix(camera.world_from_cam)[:3, 3] - middle))
    unit = away / float(np.sqrt(K[0, 0] * K[1, 1]))  # asset units per pixel of the photo, about
    factor = min(1.0, unit / (POINT * _spacing(extent)))
    w, h = max(2, round(camera.width * factor)), max(2, round(camera.height * factor))
    value = np.full((h, w), np.nan, np.float32)
    good = (z > 1e-9) & np.isfinite(uv).all(1)
    at = np.floor(np.where(good[:, None], uv, -1) * (w / camera.width, h / camera.height)).astype(np.int64)
    good &= (at >= 0).all(1) & (at[:, 0] < w) & (at[:, 1] < h)
    order = np.flatnonzero(good)[np.argsort(-z[good], kind="stable")]
    ahead = points[order] - matrix(camera.world_from_cam)[:3, 3]
    ahead *= THICK * extent.head / np.linalg.norm(ahead, axis=1, keepdims=True)
    depths = [signed(extent, points[order] + step, -ASKED * extent.head) for step in (0.0, ahead)]
    value[at[order, 1], at[order, 0]] = -np.maximum(*depths)
    meets = _meets(camera, w, h, middle, radius)
    high = np.zeros((h, w), bool)
    high[at[order, 1], at[order, 0]] = _above(extent, points[order])
    value[meets & (high | face_seen)] = extent.head  # the head itself: its hull may have a gap
    whole = _filled(value, meets, NEAR * extent.head * factor / unit)
    return np.asarray(cv2.medianBlur(whole, 3) / np.float32(unit), np.float32)  # removes specks of missing points


def _spacing(extent: Extent) -> float:
    """Edge of the hull's cells, asset units."""
    return 2 * BEYOND * max(extent.radii) / CELLS


def _meets(camera: Camera, width: int, height: int, middle: F64, radius: float) -> Bool:
    """(height, width) pixels whose ray passes through a ball with centre `middle` (3,)."""
    uv = pixel_centres(width, height) * (camera.width / width, camera.height / height)
    origin, direction = rays(matrix(camera.K), matrix(camera.world_from_cam), np.array(camera.distortion), uv)
    along = direction @ (middle - origin)
    off = np.linalg.norm(origin + along[:, None] * direction - middle, axis=1)
    return np.asarray(((off <= radius) & (along > 0)).reshape(height, width))


def _filled(value: F32, meets: Bool, near: float) -> F32:
    """Fill the pixels without a point (NaN): from the nearest pixel with one within `near` pixels, else from
    `meets`."""
    known = np.isfinite(value)
    far = np.where(meets, np.float32(1), np.float32(-1))
    if not known.any():
        return far
    distance, label = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 5,
                                                      labelType=cv2.DIST_LABEL_PIXEL)  # fmt: skip
    of_label = np.zeros(int(label.max()) + 1, np.float32)
    of_label[label[known]] = value[known]
    return np.where(distance <= near, of_label[label], far).astype(np.float32)


def outline_points(hull: Hull, extent: Extent) -> F64:
    """(N, 3) points on the hull's surface, without those above the chin and outside of the ellipsoid: in front of a
    face that was photographed from one side, the hull has empty tips. Below the chin are shoulders."""
    points = np.asarray(surface_points(hull), np.float64)
    return points[
        ~_above(extent, points) | (signed(extent.model_copy(update={"cuts": ()}), points, -ASKED * extent.head) <= 0)
    ]


def _above(extent: Extent, points: F64) -> Bool:
    """(N,) points above the chin."""
    out = np.ones(len(points), bool)
    for plane in extent.cuts:
        out &= points @ np.asarray(plane.normal) < plane.offset - BELOW * extent.head
    return out
