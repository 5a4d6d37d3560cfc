"""A normal and an albedo for every pixel of a camera, from that camera's pictures under one light at a time alone.

The fit of `split.py`, with one camera: what the lights say of a pixel hardly depends on where on its ray the surface
lies (the lamps are far), so that the normals are right to a few degrees where the surface is wrong by a centimetre.
Seen from several cameras, the same point of the skin has the same normal and the same albedo: that is what
`agree.py` looks for and `reshape.py` builds the surface from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.artifacts import Camera
from pipeline.camera import PinholeCamera
from pipeline.meshes import Mesh
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64, inverse_rigid, pixel_centres, project
from stages.reflectance.relight import barycentric
from stages.reflectance.rig import Rig
from stages.reflectance.samples import Step, gather
from stages.reflectance.split import FIRST_STEPS, STEPS, WIDTHS, TexelFit
from stages.reflectance.texels import Pairs, Points, arriving_of_all

WIDTH = 192  # columns of a map
FLATTEST = 0.08  # least n.v of a pixel
PRIOR = 0.002  # weight of the surface's normal: it may be far off
DARKEST = 0.02  # albedos below are taken as this before the logarithm
KNOWN = 0.6  # of the four pixels around a point, by their weights


@dataclass(frozen=True, slots=True)
class AnswerMap:
    """What the lights say in one camera. camera: of the map's size, at rest; values (H, W, 7): unit normal, logarithm
    of the albedo, 1; all 0 where nothing was fitted."""

    camera: PinholeCamera
    values: F64

    def at(self, points: F64) -> tuple[F64, F64, F64]:
        """At points (N, 3): unit normals (N, 3), logarithms of the albedo (N, 3), and (N,) 1 where the map knows
        them, else 0. Bilinear between known pixels."""
        found = self._between(points)
        share = found[:, 6]
        normal = found[:, :3] / np.maximum(np.linalg.norm(found[:, :3], axis=1, keepdims=True), 1e-9)
        return normal, found[:, 3:6] / np.maximum(share, 1e-9)[:, None], (share > KNOWN).astype(np.float64)

    def _between(self, points: F64) -> F64:
        camera, (height, width) = self.camera, self.values.shape[:2]
        uv, depth = project(camera.K, inverse_rigid(camera.world_from_cam), camera.distortion, points)
        uv = np.where((depth[:, None] > 0) & np.isfinite(uv), uv - 0.5, -2)
        corner = np.floor(uv)
        out = np.zeros((len(points), self.values.shape[2]))
        for dx in (0, 1):
            for dy in (0, 1):
                at = corner + (dx, dy)
                inside = np.asarray(((at >= 0) & (at < (width, height))).all(1), np.bool_)
                column, row = np.where(inside[:, None], at, 0).astype(np.int64).T
                weight = (1 - np.abs(uv - at)).prod(1) * inside
                out += weight[:, None] * self.values[row, column]
        return out


def view_of(camera: Camera, width: int) -> PinholeCamera:
    """A camera at rest with `width` columns."""
    return PinholeCamera.of(camera).scaled(width)


def answer_maps(
    mesh: Mesh, rig: Rig, pictures: Mapping[tuple[int, int], Path], scratch: Path, check: Callable[[], None], step: Step
) -> list[AnswerMap]:
    """A map for each camera of the rig. pictures: as for `gather`; scratch: folder for samples, which are removed."""
    caster = RayCaster(mesh.vertices, mesh.faces)
    blocker = RayCaster(mesh.vertices, mesh.faces[_shown(mesh, rig, caster)])
    out = []
    for c, camera in enumerate(rig.cameras):
        step(c, len(rig.cameras), "normals of each camera")
        view, alone = view_of(camera, min(WIDTH, camera.width)), replace(rig, cameras=(camera,))
        points, weight = _pixels(mesh, view, caster)
        values = np.zeros((view.height * view.width, 7))
        if len(points.texel):
            own = {(0, i): path for (n, i), path in pictures.items() if n == c}
            values[points.texel] = _fitted(points, weight, alone, own, blocker, scratch / f"camera_{c}.npy", check)
        out.append(AnswerMap(view, values.reshape(view.height, view.width, 7)))
    return out


def _shown(mesh: Mesh, rig: Rig, caster: RayCaster) -> np.ndarray:
    """(F,) faces that some camera sees. Only they throw shadows, as in `texels.known_surface`."""
    seen = np.zeros(len(mesh.faces), np.bool_)
    for camera in rig.cameras:
        view = view_of(camera, min(2 * WIDTH, camera.width))
        eye, rays = view.rays(pixel_centres(view.width, view.height))
        face = caster.first_faces(np.broadcast_to(eye, rays.shape), rays)
        seen[face[face >= 0]] = True
    return seen


def _pixels(mesh: Mesh, view: PinholeCamera, caster: RayCaster) -> tuple[Points, F64]:
    """The pixels that show the mesh, as points on it; their texel is the pixel's number. Their n.v squared."""
    eye, rays = view.rays(pixel_centres(view.width, view.height))
    far, face = caster.hits(np.broadcast_to(eye, rays.shape), rays)
    pixel = np.flatnonzero(face >= 0)
    position, corners = eye + far[pixel, None] * rays[pixel], mesh.faces[face[pixel]]
    weights = barycentric(mesh.vertices.astype(np.float64)[corners], position)
    normal = (mesh.normals.astype(np.float64)[corners] * weights[..., None]).sum(1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    cosine = -(normal * rays[pixel]).sum(1)
    live = np.flatnonzero(cosine > FLATTEST)
    points = Points(view.width, pixel[live], face[pixel][live], weights[live], position[live], normal[live])
    return points, cosine[live] ** 2


def _fitted(
    points: Points,
    weight: F64,
    rig: Rig,
    pictures: Mapping[tuple[int, int], Path],
    blocker: RayCaster,
    path: Path,
    check: Callable[[], None],
) -> F64:
    """(T, 7) values of pixels: see `AnswerMap`."""
    count = len(points.texel)
    every = np.arange(count)
    pairs = Pairs(np.arange(count + 1), every, np.zeros(count, np.int32), weight)
    table = gather(path, points, pairs, rig, pictures, lambda done, total, message: check())
    lamps, axes = rig.lamps()
    arrives = arriving_of_all(points, blocker, lamps, axes, check, rays=1)
    alphas = np.array([w[1] for w in WIDTHS])
    work = TexelFit(points, pairs, table, rig, arrives, every)
    work.fit(alphas, FIRST_STEPS, PRIOR)
    work.start_again_from_brightest(alphas)
    work.see(alphas)
    error = work.fit(alphas, STEPS, PRIOR)
    path.with_suffix(".done").unlink()
    path.unlink()
    known = (error > 0)[:, None]
    values = np.concatenate([work.normals, np.log(np.maximum(work.albedo, DARKEST)), np.ones((count, 1))], 1)
    return np.asarray(np.where(known & np.isfinite(values).all(1, keepdims=True), values, 0.0), np.float64)
