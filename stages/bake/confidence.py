"""How well the photos saw each texel.

Symbols: w = sum over fitted views of max(cos, 0) V, with V = 1 where the view sees the point (inside the photo, inside
its mask, nothing in between) and cos between the normal and the direction to the camera.

    confidence = 1 - 2^-w

so that one photo from straight ahead gives 0.5, four give 0.94, and none gives 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline import raster
from pipeline.artifacts import Camera, CameraSet, Capture, FittedFace, Located, MaskSet
from pipeline.meshes import F32, F64, Charts, Mask, Mesh
from pipeline.nearest import filled
from pipeline.transforms import inverse_rigid, matrix, project

SIZE = 512  # texels: visibility has no finer detail than the photos' geometry, and rays cost
EMBREE_SIZE = 100.0  # embree has absolute tolerances: the mesh is scaled to about this size
LIFT = 2e-3  # of the mesh's size: rays start this far above it, so that facets don't shade themselves
OPAQUE = 0.5


@dataclass(frozen=True, slots=True)
class View:
    """A fitted photo, its camera and, if there is one, its mask."""

    camera: Camera
    mask: Path | None
    photo: Path | None = None


def seen_by(
    fitted: FittedFace, poses: CameraSet, masks: Located[MaskSet], capture: Located[Capture]
) -> tuple[View, ...]:
    """The views that the field was fitted to, in the order of its colour responses. None that was held out."""
    used = set(fitted.fitted_views) - {v.index for v in capture.artifact.views if v.holdout}
    alpha = {m.index: masks.path(m.mask) for m in masks.artifact.masks}
    photo = {v.index: capture.path(v.image) for v in capture.artifact.views}
    return tuple(View(c, alpha.get(c.index), photo.get(c.index)) for c in poses.cameras if c.index in used)


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
        starts = np.broadcast_to((origin * self._scale).astype(np.float32), directions.shape)
        found = self._scene.run(np.ascontiguousarray(starts), np.ascontiguousarray(directions, np.float32), output=True)
        return np.where(found["primID"] >= 0, found["tfar"].astype(np.float64) / self._scale, np.inf)

    def blocks(self, origins: F64, directions: F64) -> Mask:
        """(N,) True where a ray meets the mesh."""
        o = np.ascontiguousarray(origins * self._scale, np.float32)
        found = np.asarray(self._scene.run(o, np.ascontiguousarray(directions, np.float32)))
        out: Mask = found >= 0
        return out


def seen_weight(points: F64, normals: F64, views: Sequence[View], occluder: Occluder) -> F64:
    """(N,) w: the cosines towards all views that see each point, summed."""
    total = np.zeros(len(points))
    for view in views:
        total += weight_of(view, points, normals, occluder)
    return total


def confidence(mesh: Mesh, charts: Charts, views: Sequence[View], size: int, step: Callable[[int, int], None]) -> F32:
    """(S, S) confidence at S = min(size, SIZE), gutters filled from the nearest chart."""
    small = min(size, SIZE)
    hits = raster.rasterise(raster.texel_corners(charts, small), small, 0, small)
    weights = hits.weights.astype(np.float64)[..., None]
    points = (mesh.vertices.astype(np.float64)[mesh.faces[hits.face]] * weights).sum(1)
    normals = (mesh.normals.astype(np.float64)[mesh.faces[hits.face]] * weights).sum(1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    occluder = Occluder(mesh)
    total = np.zeros(len(points))
    for i, view in enumerate(views):
        step(i, len(views))
        total += weight_of(view, points, normals, occluder)
    covered = np.zeros(small * small, np.bool_)
    covered[hits.texel] = True
    image = np.zeros(small * small, np.float32)
    image[hits.texel] = 1 - 2.0**-total
    return filled(image.reshape(small, small), covered.reshape(small, small))


def weight_of(view: View, points: F64, normals: F64, occluder: Occluder) -> F64:
    """(N,) cosine towards the camera where the view sees the point, else 0."""
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
        live = live[_inside(view.mask, camera, uv[live])]
    start = points[live] + LIFT * occluder.span * normals[live]
    out = np.zeros(len(points))
    if len(live):
        out[live] = np.where(occluder.blocks(start, toward[live]), 0.0, cosine[live])
    return out


def _inside(mask: Path, camera: Camera, uv: F64) -> Mask:
    from pipeline.images import read_alpha

    alpha = read_alpha(mask)
    scale = np.array([alpha.shape[1] / camera.width, alpha.shape[0] / camera.height])
    column, row = np.minimum((uv * scale).astype(np.int64), [alpha.shape[1] - 1, alpha.shape[0] - 1]).T
    out: Mask = alpha[row, column] > OPAQUE
    return out
