"""Visibility of mesh points in the fitted photos."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera, CameraSet, FittedFace, Located, MaskSet
from pipeline.capture_artifacts import Capture
from pipeline.fitted_cameras import cameras_of
from pipeline.maths.smoothstep import smoothstep
from pipeline.meshes import F64, Mask, Mesh
from pipeline.ray_casting import RayCaster
from pipeline.transforms import inverse_rigid, matrix

LIFT = 2e-3  # of the mesh's size: rays start this far above it, against self-occlusion of facets
MIN_ALPHA = 0.5
FEW = 0.1, 0.3  # cosines at which a view counts as none, and as a whole one
KEPT = 200_000_000  # bytes of masks that stay in memory


@dataclass(frozen=True, slots=True)
class FittedPhoto:
    """A fitted photo and its camera; its mask, clipped pixels, labels and the pixels that count in the fit, if they
    exist; the parallel-polarised photo of its pair with its clipped pixels and its exposure over the photo's."""

    camera: Camera
    mask: Path | None
    photo: Path | None = None
    clipped: Path | None = None
    labels: Path | None = None
    asked: Path | None = None
    parallel: Path | None = None
    parallel_clipped: Path | None = None
    parallel_exposure: float = 1.0


def seen_by(
    fitted: FittedFace, poses: CameraSet, masks: Located[MaskSet], capture: Located[Capture]
) -> tuple[FittedPhoto, ...]:
    """The views that the field was fitted to, with the cameras that it was fitted with, in the order of its colour
    responses, without held-out views."""
    used = set(fitted.fitted_views) - {v.index for v in capture.artifact.views if v.holdout}
    cut = {m.index: m for m in masks.artifact.masks}
    shot = {v.index: v for v in capture.artifact.views}

    def view(camera: Camera) -> FittedPhoto:
        mask, photo = cut.get(camera.index), shot.get(camera.index)
        return FittedPhoto(
            camera,
            None if mask is None else masks.path(mask.mask),
            None if photo is None else capture.path(photo.image),
            None if photo is None or photo.clipped is None else capture.path(photo.clipped),
            None if mask is None or mask.labels is None else masks.path(mask.labels),
            None if mask is None or mask.asked is None else masks.path(mask.asked),
            None if photo is None or photo.parallel is None else capture.path(photo.parallel),
            None if photo is None or photo.parallel_clipped is None else capture.path(photo.parallel_clipped),
            1.0 if photo is None else photo.parallel_exposure,
        )

    return tuple(view(c) for c in cameras_of(poses, fitted).cameras if c.index in used)


class Occluder(RayCaster):
    """Whether a mesh occludes points."""

    def __init__(self, mesh: Mesh) -> None:
        super().__init__(mesh.vertices, mesh.faces)

    def distance(self, origin: F64, directions: F64) -> F64:
        """(N,) distance to the mesh along unit directions (N, 3) from one origin (3,), infinite for no hit."""
        return self.distances(np.broadcast_to(origin, directions.shape), directions)

    def blocks(self, origins: F64, directions: F64) -> Mask:
        """(N,) True where the ray from an origin (N, 3) along its direction (N, 3) hits the mesh."""
        out: Mask = self.first_faces(origins, directions) >= 0
        return out


def seen_weight(points: F64, normals: F64, views: Sequence[FittedPhoto], occluder: Occluder) -> F64:
    """(N,) sum of the cosines towards all views that see each point. points, normals (N, 3)."""
    total = np.zeros(len(points))
    for view in views:
        total += view_cosines(view, points, normals, occluder)[0]
    return total


@dataclass(frozen=True, slots=True)
class Sight:
    """How N points are seen. cosine (N,): the largest towards a view that sees the point, 0 if none does; photos (N,):
    number of views that see it, those between the cosines `FEW` in part."""

    cosine: F64
    photos: F64


def sight_of(points: F64, normals: F64, views: Sequence[FittedPhoto], occluder: Occluder) -> Sight:
    """points, normals (N, 3)."""
    best, photos = np.zeros(len(points)), np.zeros(len(points))
    for view in views:
        cosine = view_cosines(view, points, normals, occluder)[0]
        np.maximum(best, cosine, out=best)
        photos += smoothstep(cosine, *FEW)
    return Sight(best, photos)


def view_cosines(view: FittedPhoto, points: F64, normals: F64, occluder: Occluder) -> tuple[F64, F64]:
    """(N,) cosine towards the camera if the view sees the point, else 0; (N, 2) position in the photo, pixels, NaN for
    points that face away or lie outside of it. points, normals (N, 3)."""
    from pipeline.visibility_kernels import facing

    camera = view.camera
    cosine, uv = np.empty(len(points)), np.full((len(points), 2), np.nan)
    facing(_row(camera), np.ascontiguousarray(points), np.ascontiguousarray(normals), cosine, uv)
    live = np.flatnonzero(cosine)
    live = live[_counts(view, uv[live])]
    out = np.zeros(len(points))
    if len(live):
        away = matrix(camera.world_from_cam)[:3, 3] - points[live]
        toward = away / np.linalg.norm(away, axis=1, keepdims=True)
        start = points[live] + LIFT * occluder.span * normals[live]
        out[live] = np.where(occluder.blocks(start, toward), 0.0, cosine[live])
    return out, uv


def looks_into(view: FittedPhoto, points: F64, occluder: Occluder) -> tuple[Mask, Mask]:
    """(N,) which points (N, 3) lie in the photo's frame with nothing of the mesh before them, and (N,) where the photo
    shows the subject there, in pixels that count."""
    from pipeline.visibility_kernels import facing

    camera = view.camera
    toward = matrix(camera.world_from_cam)[:3, 3] - points
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    cosine, uv = np.empty(len(points)), np.full((len(points), 2), np.nan)
    facing(_row(camera), np.ascontiguousarray(points), toward, cosine, uv)
    into, shown = (np.zeros(len(points), np.bool_) for _ in range(2))
    live = np.flatnonzero(cosine)
    into[live] = ~occluder.blocks(points[live], toward[live])
    live = np.flatnonzero(into)
    shown[live] = _counts(view, uv[live])
    return into, shown


def _counts(view: FittedPhoto, uv: F64) -> Mask:
    """(N,) whether a photo shows the subject at positions uv (N, 2), in pixels that count: elsewhere the subject is not
    fitted, so that its colours there mean nothing."""
    out = np.ones(len(uv), np.bool_)
    for path in (view.mask, view.asked):
        if path is not None:
            out &= picked(mask_of(path), view.camera, uv)
    return out


def _row(camera: Camera) -> F64:
    """A camera's numbers in the order of visibility_kernels."""
    pose, lens = matrix(camera.world_from_cam), np.array(camera.distortion, np.float64)
    size = [camera.width, camera.height]
    return np.concatenate([inverse_rigid(pose)[:3].ravel(), matrix(camera.K)[:2].ravel(), lens, pose[:3, 3], size])


def picked(image: npt.NDArray[Any], camera: Camera, uv: F64) -> npt.NDArray[Any]:
    """(N, ...) values of a picture (H, W, ...) of the whole photo at positions uv (N, 2), pixels of the photo."""
    scale = np.array([image.shape[1] / camera.width, image.shape[0] / camera.height])
    column, row = np.minimum((uv * scale).astype(np.int64), [image.shape[1] - 1, image.shape[0] - 1]).T
    return np.asarray(image[row, column])


class _Masks:
    """What masks cover, one byte a pixel; the ones that were used last are kept, because every set of points asks all
    photos again."""

    def __init__(self, most: int) -> None:
        self._most, self._bytes, self._lock = most, 0, Lock()
        self._kept: OrderedDict[tuple[Path, int, int], Mask] = OrderedDict()

    def inside(self, path: Path) -> Mask:
        """(H, W) where the mask's alpha is above MIN_ALPHA."""
        from pipeline.images import read_alpha

        found = path.stat()
        key = path, found.st_mtime_ns, found.st_size
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        inside: Mask = read_alpha(path) > MIN_ALPHA
        with self._lock:
            if key not in self._kept:
                self._kept[key] = inside
                self._bytes += inside.nbytes
            while self._bytes > self._most:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return inside


_MASKS = _Masks(KEPT)


def mask_of(path: Path) -> Mask:
    """(H, W) what a mask covers."""
    return _MASKS.inside(path)
