"""The texels of the mesh as points, what the cameras see of them, and what light reaches them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.meshes import F32, F64, Charts, Faces, Indices, Mesh, unit
from pipeline.ray_casting import RayCaster
from pipeline.tangents import any_across
from pipeline.transforms import inverse_rigid, matrix, project

U8 = npt.NDArray[np.uint8]
LIFT = 1e-3  # asset units (metres): rays start this far above the surface
AROUND = 1.2e-3  # the photos' blur: a texel this near to an edge of the silhouette shows what lies behind
GRAZING, MARGIN = 0.15, 2.0  # least n.v of a texel; pixels at the frame's border that are not used
SURE = 0.3  # least n.v of a texel, towards the camera that faces it best, whose fitted values are kept
DISC, RAYS = 0.016, 3  # lamps have an extent: shadows are traced to this many points on a ring of that radius
TURN = 0.4  # radians: the first of them
BEHIND = -0.1  # least n.l of a texel whose shadow is traced


@dataclass(frozen=True, slots=True)
class Points:
    """Covered texels of a square map. texel (T,) row * size + column; face (T,); weights (T, 3) barycentric; position,
    normal (T, 3) of the geometry."""

    size: int
    texel: Indices
    face: Indices
    weights: F64
    position: F64
    normal: F64


@dataclass(frozen=True, slots=True)
class Pairs:
    """Which camera sees which texel, sorted by texel. first (T + 1,): texel t has rows first[t] to first[t + 1]; texel,
    camera (P,); weight (P,) squared cosine towards the camera."""

    first: Indices
    texel: Indices
    camera: npt.NDArray[np.int32]
    weight: F64

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """(T,) whether any camera sees the texel."""
        return np.asarray(np.diff(self.first) > 0)

    @property
    def sure(self) -> npt.NDArray[np.bool_]:
        """(T,) whether a camera sees the texel well enough for its colour: at the rim of what is seen, grazing pixels
        show the background as well."""
        best = np.zeros(len(self.first) - 1)
        np.maximum.at(best, self.texel, self.weight)
        return np.asarray(best >= SURE**2)


def points_of(mesh: Mesh, charts: Charts, size: int) -> Points:
    """All texels of a size x size map that lie on the mesh."""
    from pipeline.raster import rasterise, texel_corners

    found = rasterise(texel_corners(charts, size), size, 0, size)
    weights = np.maximum(found.weights.astype(np.float64), 0)
    weights /= np.maximum(weights.sum(1, keepdims=True), 1e-12)
    corners = mesh.faces[found.face]
    position = (mesh.vertices.astype(np.float64)[corners] * weights[..., None]).sum(1)
    normal = (mesh.normals.astype(np.float64)[corners] * weights[..., None]).sum(1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return Points(size, found.texel, found.face, weights, position, normal)


def pairs_of(points: Points, cameras: Sequence[Camera], caster: RayCaster) -> Pairs:
    """Texels that each camera sees at rest, also when moved a little to every side."""
    rows = [_seen(points, c, caster) for c in cameras]
    texel = np.concatenate([r[0] for r in rows])
    camera = np.concatenate([np.full(len(r[0]), n, np.int32) for n, r in enumerate(rows)])
    order = np.lexsort((camera, texel))
    first = np.searchsorted(texel[order], np.arange(len(points.texel) + 1))
    return Pairs(first, texel[order], camera[order], np.concatenate([r[1] for r in rows])[order])


def _seen(points: Points, camera: Camera, caster: RayCaster) -> tuple[Indices, F64]:
    world_from_cam = matrix(camera.world_from_cam)
    eye = world_from_cam[:3, 3]
    away = unit(eye - points.position)
    cosine = (away * points.normal).sum(1)
    uv, depth = project(matrix(camera.K), inverse_rigid(world_from_cam), np.array(camera.distortion), points.position)
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & (uv > MARGIN).all(1) & (uv < np.array([camera.width, camera.height]) - MARGIN).all(1)
    live = np.flatnonzero((cosine > GRAZING) & inside)
    across = any_across(away[live])
    along = np.cross(away[live], across)
    hidden = np.zeros(len(live), np.bool_)
    for x, y in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        start = points.position[live] + 1.5 * LIFT * points.normal[live] + AROUND * (x * across + y * along)
        hidden |= caster.first_faces(start, unit(eye - start)) >= 0
    live = live[~hidden]
    return live, cosine[live] ** 2


def known_surface(mesh: Mesh, points: Points, seen: npt.NDArray[np.bool_]) -> Faces:
    """(F', 3) the faces that some camera sees, and those too small for a texel.

    Only they throw shadows: what no camera sees (shoulders cut by the frame, the back) is guessed by the fit, is mostly
    too large, and would keep light from what is seen.
    """
    count = np.bincount(points.face, minlength=len(mesh.faces))
    shown = np.bincount(points.face, seen.astype(np.float64), len(mesh.faces))
    return np.asarray(mesh.faces[(count == 0) | (shown > 0)], np.int32)


def arriving(points: Points, caster: RayCaster, target: F64, axis: F64 | None, rays: int = RAYS) -> F32:
    """(T,) share of the light of one lamp that reaches each texel. target (3,): the lamp's position, or with axis None
    its unit direction (distant). rays: on its disc."""
    n = points.normal
    distant = axis is None
    towards = np.broadcast_to(target, n.shape) if distant else target - points.position
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    live = np.flatnonzero((towards * n).sum(1) > BEHIND)
    start = points.position[live] + LIFT * n[live]
    out = np.zeros(len(n), np.float32)
    if axis is None:
        out[live] = caster.first_faces(start, towards[live]) < 0
        return out
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    along = np.cross(axis, across)
    for k in range(rays):
        turn = 2 * np.pi * k / rays + TURN
        on_disc = target + DISC * (np.cos(turn) * across + np.sin(turn) * along)
        out[live] += (caster.first_faces(start, unit(on_disc - start)) < 0).astype(np.float32) / rays
    return out


def arriving_of_all(
    points: Points, caster: RayCaster, lamps: F64, axes: F64, check: Callable[[], None], rays: int = RAYS
) -> U8:
    """(T, L) `arriving` of all lamps, 255 for all of the light."""
    out = np.zeros((len(points.texel), len(lamps)), np.uint8)
    for i, (lamp, axis) in enumerate(zip(lamps, axes, strict=True)):
        check()
        out[:, i] = np.round(255 * arriving(points, caster, lamp, axis, rays))
    return out
