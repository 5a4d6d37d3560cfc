"""Where the second of two captures lies in the asset coordinates of the first: a similarity, from outlines.

    A point of a visual hull that lies on its outline in a photo of the other capture lies on the contour of that
    photo's mask.

Symbols: M = first_from_second, 4x4; a body is what one capture knows of the subject without its photos' colours.
The similarity is that of the captures' common world where both have given cameras and their outlines agree there; else
the candidate with the best agreement (the landmarks of the face, the captures' own asset coordinates turned about the
vertical), refined by Gauss-Newton steps on the distances above, in both directions.

Agreement of a pair: the mean over views of the intersection over union of two silhouettes, that of the other capture's
hull and that of the view's own hull. A hull is too large in directions that none of its photos faces: a view that none
of the other capture's cameras is near shows only whether the other hull contains its silhouette.

Source: registration by outlines as in Wong and Cipolla, Structure and motion from silhouettes (2001).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pipeline.artifacts import Camera, Extent
from pipeline.extent import GROWN, bounds, signed, within
from pipeline.hull import Cloud, Hull, cloud, hull_bounds, render_silhouette, visual_hull
from pipeline.silhouettes import Silhouette, outside, silhouette
from pipeline.transforms import apply, inverse_rigid, matrix, project, scale_of, similarity, umeyama

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

CELLS = 80  # voxels along a hull's longest side
VIEWS = 16  # of each capture, at most
SIDE = 200  # pixels: longer side of the compared silhouettes
NEAR = 25.0  # degrees between two cameras' directions within which their hulls can be compared
SURE = 0.97  # agreement of the common world from which nothing else is tried: two captures of one head have .99
SAME = 0.01  # of agreement that the common world may lack to the refined similarity
TURNS = 12  # about the vertical, where nothing else is known
COARSE = 4  # every how many views candidates are compared by
RIM, ROUNDS = 240, 8  # outline points of a view; searches for the outline, at most
SETTLED = 5e-4  # of the body's size: a smaller step is the last
BEYOND = 0.15  # of the head's length: points nearer to an extent's border than this are no outline
COMMON = "the common world"
LOOSE = 0.01  # of the body's size: residuals of outlines up to which they count in full
FEW = 40  # outline points that determine a similarity


@dataclass(frozen=True, slots=True)
class Body:
    """cameras, alphas (H, W): fitted views. hull: their visual hull within the extent. world: asset coordinates to the
    capture's world, None for solved cameras. landmarks (468, 3) of the face, None without."""

    cameras: list[Camera]
    alphas: list[F32]
    hull: Cloud
    extent: Extent | None
    world: F64 | None
    landmarks: F64 | None

    @property
    def size(self) -> float:
        """Longest side of the hull, asset units."""
        return float(np.ptp(self.hull.shell, axis=0).max())


@dataclass(frozen=True, slots=True)
class Placed:
    """first_from_second; where it comes from; agreement in [0, 1]; that of the common world, None without one;
    landmarks: median distance of the faces' landmarks over the length of the head, None without faces."""

    matrix: F64
    source: str
    agreement: float
    of_world: float | None
    landmarks: float | None


def body_of(
    cameras: Sequence[Camera], alphas: Sequence[F32], roi_radius: float, extent: Extent | None, world: F64 | None,
    landmarks: F64 | None,
) -> Body:  # fmt: skip
    """A body of at most VIEWS views, whose hull all views make. Raises StageError if the hull is empty."""

    def kept(hull: Hull) -> Hull:
        return hull if extent is None else within(hull, extent)

    reach = None if extent is None else bounds(extent, GROWN * extent.head)
    lo, hi = hull_bounds(cameras, alphas, roi_radius, keep=kept, reach=reach)
    hull = kept(visual_hull(cameras, alphas, lo, hi, float((hi - lo).max()) / CELLS))
    some = np.unique(np.linspace(0, len(cameras) - 1, VIEWS).round().astype(int))
    return Body([cameras[i] for i in some], [alphas[i] for i in some], cloud(hull), extent, world, landmarks)


def place(first: Body, second: Body, *, wanted: str = "auto", check: Callable[[], None] = lambda: None) -> Placed:
    """Where the second body lies. wanted: `auto`; `world`: the common world, as it is; `outlines`: registered, even if
    the captures have a common world that fits."""
    world = None
    if first.world is not None and second.world is not None:
        world = np.linalg.inv(first.world) @ second.world
    at_world = None if world is None else agreement(first, second, world)
    if world is not None and at_world is not None and (wanted == "world" or (wanted == "auto" and at_world >= SURE)):
        best = world, COMMON, at_world
    else:
        best = _registered(first, second, world, check)
        if wanted == "auto" and world is not None and at_world is not None and at_world >= best[2] - SAME:
            best = world, COMMON, at_world
    return Placed(*best, at_world, landmark_distance(first, second, best[0]))


def _registered(first: Body, second: Body, world: F64 | None, check: Callable[[], None]) -> tuple[F64, str, float]:
    """The best candidate, refined, what it began with, and its agreement."""
    found = candidates(first, second, world)
    few = [replace(b, cameras=b.cameras[::COARSE], alphas=b.alphas[::COARSE]) for b in (first, second)]
    scored = []
    for m, name in found if len(found) > 1 else ():
        check()
        scored.append((agreement(few[0], few[1], m), m, name))
    _, m, name = max(scored, key=lambda s: s[0]) if scored else (0.0, *found[0])
    for _ in range(ROUNDS):
        check()
        before, m = m, refined(first, second, m)
        moved = apply(m, second.hull.shell) - apply(before, second.hull.shell)
        if float(np.linalg.norm(moved, axis=1).max()) < SETTLED * first.size:
            break
    return m, f"outlines, beginning with {name}", agreement(first, second, m)


def candidates(first: Body, second: Body, world: F64 | None) -> list[tuple[F64, str]]:
    """Similarities to begin with, and their names."""
    out = [] if world is None else [(world, COMMON)]
    if first.landmarks is not None and second.landmarks is not None:
        out.append((umeyama(second.landmarks, first.landmarks), "the landmarks of the faces"))
        return out
    (a, ra), (b, rb) = (_middle(body.hull.inside) for body in (first, second))
    for k in range(TURNS):
        turn = Rotation.from_rotvec([0.0, 2 * np.pi * k / TURNS, 0.0]).as_matrix()
        scale = ra / rb
        out.append((similarity(scale, turn, a - scale * turn @ b), f"a turn of {360 * k // TURNS} degrees"))
    return out


def _middle(points: F64) -> tuple[F64, float]:
    """Mean (3,) of points and their root mean square distance from it."""
    mean = points.mean(0)
    return mean, float(np.sqrt(((points - mean) ** 2).sum(1).mean()))


def landmark_distance(first: Body, second: Body, first_from_second: F64) -> float | None:
    """Median distance of the landmarks over the length of the face; None where one capture has no face."""
    if first.landmarks is None or second.landmarks is None:
        return None
    away = np.linalg.norm(apply(first_from_second, second.landmarks) - first.landmarks, axis=1)
    return float(np.median(away)) / float(np.ptp(first.landmarks, axis=0).max())


# ------------------------------------------------------------------ agreement of silhouettes
def agreement(first: Body, second: Body, first_from_second: F64) -> float:
    """In [0, 1]; 0 where no view compares anything."""
    back = np.asarray(np.linalg.inv(first_from_second), np.float64)
    values = [*_views(first, second, first_from_second), *_views(second, first, back)]
    return float(np.mean(values)) if values else 0.0


def _views(own: Body, other: Body, own_from_other: F64) -> list[float]:
    """The agreement in each view of `own`."""
    theirs = _moved(_common(other, own, own_from_other), own_from_other)
    ours = _common(own, other, np.asarray(np.linalg.inv(own_from_other), np.float64))
    if not len(theirs.shell) or not len(ours.shell):
        return [0.0]
    toward = _directions([apply(own_from_other, _centre(c)[None])[0] for c in other.cameras], ours)
    out = []
    for camera, direction in zip(own.cameras, _directions([_centre(c) for c in own.cameras], ours), strict=True):
        w, h = camera.width, camera.height
        f = SIDE / max(w, h)
        shape = max(2, round(h * f)), max(2, round(w * f))
        a, b = (render_silhouette(c, camera, *shape) >= 0.5 for c in (ours, theirs))
        if not a.any():
            continue
        near = float((toward @ direction).max()) >= np.cos(np.radians(NEAR))
        whole = (a | b) if near else a
        out.append(float((a & b).sum() / whole.sum()))
    return out


def _common(body: Body, other: Body, other_from_body: F64) -> Cloud:
    """The part of a body's hull that lies in the other's extent too."""
    if other.extent is None:
        return body.hull
    keep = [signed(other.extent, apply(other_from_body, p)) <= 0 for p in (body.hull.shell, body.hull.inside)]
    return Cloud(body.hull.shell[keep[0]], body.hull.inside[keep[1]], body.hull.cell)


def _moved(points: Cloud, m: F64) -> Cloud:
    return Cloud(apply(m, points.shell), apply(m, points.inside), points.cell * scale_of(m))


def _centre(camera: Camera) -> F64:
    return matrix(camera.world_from_cam)[:3, 3]


def _directions(centres: Sequence[F64], around: Cloud) -> F64:
    """(N, 3) unit vectors from the middle of a hull to cameras."""
    away = np.array(centres, np.float64) - around.inside.mean(0)
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12), np.float64)


# ------------------------------------------------------------------ registration by outlines
@dataclass(frozen=True, slots=True)
class Rim:
    """Outline points (N, 3) of one body, in its coordinates, in a view of the other; the view's mask."""

    points: F64
    mask: Silhouette


def refined(first: Body, second: Body, first_from_second: F64) -> F64:
    """One search for the outlines, and the similarity that brings them onto the masks; the same where there are too
    few."""
    m = np.asarray(first_from_second, np.float64)
    back = np.asarray(np.linalg.inv(m), np.float64)
    ahead = [rim for i in range(len(first.cameras)) if (rim := rim_in(second, first, i, m)) is not None]
    behind = [rim for i in range(len(second.cameras)) if (rim := rim_in(first, second, i, back)) is not None]
    if sum(len(r.points) for r in (*ahead, *behind)) < FEW:
        return m
    middle, size = first.hull.inside.mean(0), first.size

    def changed(x: F64) -> F64:
        scale, turn = float(np.exp(x[6])), Rotation.from_rotvec(x[:3]).as_matrix()
        change = similarity(scale, turn, middle + size * x[3:6] - scale * turn @ middle)
        return np.asarray(change @ m, np.float64)

    def residuals(x: F64) -> F64:
        now = changed(x)
        other, scale = np.asarray(np.linalg.inv(now), np.float64), scale_of(now)
        parts = [outside(r.mask, apply(now, r.points), 0.0)[0] for r in ahead]
        parts += [scale * outside(r.mask, apply(other, r.points), 0.0)[0] for r in behind]
        return np.asarray(np.concatenate(parts) / size, np.float64)

    found = least_squares(residuals, np.zeros(7), loss="soft_l1", f_scale=LOOSE, diff_step=1e-4, max_nfev=20)
    return changed(np.asarray(found.x, np.float64))


def rim_in(body: Body, other: Body, number: int, other_from_body: F64) -> Rim | None:
    """The outline of a body in a view of the other; None if it has none there, or no camera of the body's is near: its
    hull is too large there."""
    import cv2

    camera, alpha = other.cameras[number], other.alphas[number]
    shell = apply(other_from_body, body.hull.shell)
    around = _moved(body.hull, other_from_body)
    toward = _directions([apply(other_from_body, _centre(c)[None])[0] for c in body.cameras], around)
    own = _directions([_centre(camera)], around)[0]
    if float((toward @ own).max()) < np.cos(np.radians(NEAR)):
        return None
    uv, z = project(matrix(camera.K), inverse_rigid(matrix(camera.world_from_cam)), np.array(camera.distortion), shell)
    f = SIDE / max(camera.width, camera.height)
    w, h = max(2, round(camera.width * f)), max(2, round(camera.height * f))
    inside = render_silhouette(around, camera, h, w) >= 0.5
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    edge = max(contours, key=len)[:, 0].astype(np.float64)
    edge = edge[(edge > 1).all(1) & (edge[:, 0] < w - 2) & (edge[:, 1] < h - 2)]
    edge = edge[:: max(len(edge) // RIM, 1)]
    at = np.where(z[:, None] > 0, uv * (w / camera.width, h / camera.height) - 0.5, 1e9)
    from scipy.spatial import cKDTree

    away, which = cKDTree(np.nan_to_num(at, nan=1e9)).query(edge)
    points = body.hull.shell[np.unique(which[away < 2])]
    points = points[_inner(body.extent, points) & _inner(other.extent, apply(other_from_body, points))]
    if not len(points):
        return None
    mask = silhouette(camera, alpha, around.inside.mean(0), around.cell)
    seen = outside(mask, apply(other_from_body, points), 0.0)[1]
    return Rim(points[seen], mask) if seen.any() else None


def _inner(extent: Extent | None, points: F64) -> Bool:
    """Points that are not near the border of an extent, where a hull ends although the subject does not."""
    if extent is None:
        return np.ones(len(points), np.bool_)
    return np.asarray(signed(extent, points) < -BEYOND * extent.head, np.bool_)
