"""Which places of a mesh the fitted photos see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera, CameraSet, Capture, FittedFace, Located, MaskSet
from pipeline.meshes import F64, Mask, Mesh
from pipeline.transforms import inverse_rigid, matrix, project

EMBREE_SIZE = 100.0  # embree has absolute tolerances: the mesh is scaled to about this size
LIFT = 2e-3  # of the mesh's size: rays start this far above it, so that facets don't shade themselves
OPAQUE = 0.5


@dataclass(frozen=True, slots=True)
class View:
    """A fitted photo, its camera and, if there are such, its mask, its clipped pixels and its labels."""

    camera: Camera
    mask: Path | None
    photo: Path | None = None
    clipped: Path | None = None
    labels: Path | None = None


def seen_by(
    fitted: FittedFace, poses: CameraSet, masks: Located[MaskSet], capture: Located[Capture]
) -> tuple[View, ...]:
    """The views that the field was fitted to, in the order of its colour responses. None that was held out."""
    used = set(fitted.fitted_views) - {v.index for v in capture.artifact.views if v.holdout}
    cut = {m.index: m for m in masks.artifact.masks}
    shot = {v.index: v for v in capture.artifact.views}

    def view(camera: Camera) -> View:
        mask, photo = cut.get(camera.index), shot.get(camera.index)
        return View(
            camera,
            None if mask is None else masks.path(mask.mask),
            None if photo is None else capture.path(photo.image),
            None if photo is None or photo.clipped is None else capture.path(photo.clipped),
            None if mask is None or mask.labels is None else masks.path(mask.labels),
        )

    return tuple(view(c) for c in poses.cameras if c.index in used)


class Occluder:
    """Whether the mesh is in the way. Embree, single precision."""

    def __init__(self, mesh: Mesh) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.span = max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-9)
        self._scale = EMBREE_SIZE / self.span
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._scene, (mesh.vertices * self._scale).astype(np.float32), mesh.faces)

    def distance(self, origin: F64, directions: F64) -> F64:
        """(N,) to the mesh along unit directions (N, 3) from one origin (3,); infinite where they miss it."""
        return self.distances(np.broadcast_to(origin, directions.shape), directions)

    def distances(self, origins: F64, directions: F64) -> F64:
        """(N,) to the mesh along unit directions (N, 3), each from its own origin (N, 3); infinite where they miss."""
        starts = np.ascontiguousarray((origins * self._scale).astype(np.float32))
        found = self._scene.run(starts, np.ascontiguousarray(directions, np.float32), output=True)
        return np.where(found["primID"] >= 0, found["tfar"].astype(np.float64) / self._scale, np.inf)

    def blocks(self, origins: F64, directions: F64) -> Mask:
        """(N,) True where a ray meets the mesh."""
        o = np.ascontiguousarray(origins * self._scale, np.float32)
        found = np.asarray(self._scene.run(o, np.ascontiguousarray(directions, np.float32)))
        out: Mask = found >= 0
        return out


def seen_weight(points: F64, normals: F64, views: Sequence[View], occluder: Occluder) -> F64:
    """(N,) the cosines towards all views that see each point, summed."""
    total = np.zeros(len(points))
    for view in views:
        total += view_cosines(view, points, normals, occluder)[0]
    return total


def view_cosines(view: View, points: F64, normals: F64, occluder: Occluder) -> tuple[F64, F64]:
    """(N,) cosine towards the camera where the view sees the point, else 0; (N, 2) where in the photo, in pixels."""
    camera = view.camera
    world_from_cam = matrix(camera.world_from_cam)
    away = world_from_cam[:3, 3] - points
    toward = away / np.linalg.norm(away, axis=1, keepdims=True)
    cosine = (toward * normals).sum(1)
    uv, depth = project(matrix(camera.K), inverse_rigid(world_from_cam), np.array(camera.distortion), points)
    with np.errstate(invalid="ignore"):
        framed = (depth > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    live = np.flatnonzero((cosine > 0) & framed)
    if view.mask is not None:
        live = live[picked(_alpha(view.mask), camera, uv[live]) > OPAQUE]
    start = points[live] + LIFT * occluder.span * normals[live]
    out = np.zeros(len(points))
    if len(live):
        out[live] = np.where(occluder.blocks(start, toward[live]), 0.0, cosine[live])
    return out, uv


def picked(image: npt.NDArray[Any], camera: Camera, uv: F64) -> npt.NDArray[Any]:
    """(N, ...) values of a picture (H, W, ...) of the whole photo, at its positions (N, 2) inside the frame."""
    scale = np.array([image.shape[1] / camera.width, image.shape[0] / camera.height])
    column, row = np.minimum((uv * scale).astype(np.int64), [image.shape[1] - 1, image.shape[0] - 1]).T
    return np.asarray(image[row, column])


def _alpha(mask: Path) -> npt.NDArray[np.float32]:
    from pipeline.images import read_alpha

    return read_alpha(mask)
