"""Renders the exported asset on the CPU from its maps, with the equations of the model.

    L(wo) = a / pi max(E(n), 0) + (sum_j rho c_j B_j(n.wo)) max(sum_l A_l(1/kappa) L_l(w_r), 0)     [NeuFace eq. 12, 16]

Primary rays use the exact cameras, including distortion. Under spherical harmonics, such as the captured light, there
are no shadows and no interreflections, as in the fitted model, and a is the albedo times the occlusion. Under any other
light (stages.usd.render.relight) both are traced.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
import torch

from pipeline.camera import PinholeCamera
from pipeline.map_lookup import bilinear, lookup
from pipeline.maths import brdf
from pipeline.ray_casting import RayCaster
from pipeline.transforms import inverse_rigid, project, rays
from stages.usd.render import kernels
from stages.usd.render.exported import ExportedAsset

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]

CHUNK = 1 << 18  # rays at once
EDGE_SAMPLES = 8  # rays along each side of the filter of a pixel on the silhouette
EDGE_REACH = 2.0  # pixels: width of its triangle filter, similar to the blur of a photo's lens and sensor


@dataclass(frozen=True, slots=True)
class Hits:
    """Hits of rays with the mesh. ray, face (M,): indices; weights (M, 3) barycentric."""

    ray: npt.NDArray[np.int64]
    face: npt.NDArray[np.int64]
    weights: F64


@dataclass(frozen=True, slots=True)
class Points:
    """Surface points to shade.

    ray (M,); wo, normal (M, 3) unit; uv (M, 2); corner, weights (M, 3): vertices of their triangles.
    """

    ray: npt.NDArray[np.int64]
    wo: F64
    normal: F64
    uv: F32
    corner: I32
    weights: F32


@dataclass(frozen=True, slots=True)
class Filter:
    """Samples of a pixel: offsets (S, 2) from its corner in pixels, and weights (S,) that sum to 1."""

    offsets: F64
    weights: F32


class Light(Protocol):
    """Computes the radiance (M, 3) towards wo at points of one asset."""

    def shade(self, renderer: Renderer, points: Points) -> F64: ...


@runtime_checkable
class CarriedLight(Protocol):
    """A light that moves with the camera: each picture has its own."""

    def of(self, view: PinholeCamera) -> Light: ...


@dataclass(frozen=True, slots=True)
class Harmonics:
    """The model's closed form. coefficients ((L + 1)^2, 3); `plain`: grey diffuse surface, to show only the shape."""

    coefficients: F32
    plain: bool = False

    def shade(self, renderer: Renderer, points: Points) -> F64:
        """(M, 3) radiance. [NeuFace eq. 12] + [NeuFace eq. 16]"""
        asset, light = renderer.asset, torch.from_numpy(np.asarray(self.coefficients, np.float32))
        n = torch.from_numpy(points.normal.astype(np.float32))
        albedo = np.full((len(n), 3), 0.5, np.float32) if self.plain else renderer.at(renderer.fitted_albedo, points.uv)
        colour = brdf.diffuse(torch.from_numpy(albedo), n, light)
        if not self.plain:
            s = torch.from_numpy(renderer.at(asset.inv_kappa, points.uv)[:, 0]).clamp(min=0)
            toward = torch.from_numpy(points.wo.astype(np.float32))
            incident = brdf.light_integral(brdf.reflect(toward, n), s, light, asset.attenuation)
            colour = colour + torch.from_numpy(renderer.strength(points))[:, None] * incident
        return np.asarray(colour.numpy(), np.float64)


class Renderer:
    """Renders one asset; `render` may be called for any number of views and lights."""

    def __init__(self, asset: ExportedAsset) -> None:
        self.asset = asset
        mesh = asset.mesh
        self._corners = mesh.vertices[mesh.faces].astype(np.float64)
        self._caster = RayCaster(mesh.vertices, mesh.faces)
        self._tangents = tangents(asset).astype(np.float32)
        self._normals = mesh.normals[mesh.faces].astype(np.float32)
        self._uvs = mesh.uvs[mesh.uv_faces].astype(np.float32)
        own = asset.albedo if asset.neuface_albedo is None else asset.neuface_albedo
        self.fitted_albedo = own if asset.occlusion is None else own * asset.occlusion

    def render(
        self,
        view: PinholeCamera,
        *,
        factor: int = 1,
        samples: int = 2,
        light: F32 | Light | CarriedLight | None = None,
        plain: bool = False,
    ) -> F32:
        """(height / factor, width / factor, 4) linear Rec.709 RGBA, premultiplied.

        `factor`: one pixel for factor x factor photo pixels. `samples`: rays along each side of a pixel; 0: one ray,
        and on the silhouette the mean over a triangle filter, as soft as in a photo. `light`: SH coefficients in place
        of the captured ones, or any Light. `plain`: grey diffuse surface, to show only the shape.
        """
        if isinstance(light, CarriedLight):
            light = light.of(view)
        if light is None or isinstance(light, np.ndarray):
            light = Harmonics(self.asset.light if light is None else light, plain)
        h, w = view.height // factor, view.width // factor
        out = np.zeros((h * w, 4), np.float32)
        reached = self._reached(view, w, h, factor)
        out[reached] = self._pixels(view, reached, w, factor, _square(max(samples, 1)), light)
        if samples == 0:
            edge = np.flatnonzero(_borders(out[:, 3].reshape(h, w)).ravel())
            out[edge] = self._pixels(view, edge, w, factor, _triangle(EDGE_SAMPLES, EDGE_REACH), light)
        return out.reshape(h, w, 4)

    def _reached(self, view: PinholeCamera, width: int, height: int, factor: int) -> npt.NDArray[np.int64]:
        """Pixels in the mesh's bounding rectangle; all pixels if part of the mesh is beside or behind the camera."""
        points = self.asset.mesh.vertices.astype(np.float64)
        distances = points @ view.world_from_cam[:3, 2] - view.world_from_cam[:3, 2] @ view.world_from_cam[:3, 3]
        if distances.min() <= 0 or np.any(view.distortion):
            return np.arange(width * height)
        uv = project(view.K, inverse_rigid(view.world_from_cam), view.distortion, points)[0] / factor
        first = np.floor(uv.min(0)).astype(int).clip(0, [width, height])
        last = np.ceil(uv.max(0)).astype(int).clip(0, [width, height])
        rows, columns = np.arange(first[1], last[1]), np.arange(first[0], last[0])
        return np.asarray((rows[:, None] * width + columns).ravel(), np.int64)

    def _pixels(
        self, view: PinholeCamera, pixel: npt.NDArray[np.int64], width: int, factor: int, filtered: Filter, light: Light
    ) -> F32:
        """(N, 4) RGBA of pixels (N,), given by row * width + column."""
        out = np.zeros((len(pixel), 4), np.float32)
        count = len(filtered.weights)
        step = max(1, CHUNK // count)
        for first in range(0, len(pixel), step):
            some = pixel[first : first + step]
            uv = _sample_positions(some, width, filtered) * factor
            origin, directions = rays(view.K, view.world_from_cam, view.distortion, uv)
            points = self.points(origin, directions)
            rgba = np.zeros((len(uv), 4), np.float32)
            if len(points.ray):
                rgba[points.ray, :3] = light.shade(self, points)
                rgba[points.ray, 3] = 1
            out[first : first + len(some)] = np.einsum("nsc,s->nc", rgba.reshape(-1, count, 4), filtered.weights)
        return out

    def trace(self, origin: F64, directions: F64) -> Hits:
        """First hits of rays from origin (3,) along directions (N, 3)."""
        face = self._caster.first_faces(np.broadcast_to(origin, directions.shape), directions)
        ray = np.flatnonzero(face >= 0)
        weights = np.empty((len(ray), 3))
        kernels.hit_weights(self._corners, face[ray], origin, directions[ray], weights)
        return Hits(ray, face[ray], weights)

    def points(self, origin: F64, directions: F64) -> Points:
        """The surface points that the rays hit, with the normals of the normal map."""
        hits, mesh = self.trace(origin, directions), self.asset.mesh
        w = hits.weights.astype(np.float32)
        uv, smooth = (np.einsum("nic,ni->nc", a[hits.face], w) for a in (self._uvs, self._normals))
        normal = _unit(smooth)
        if self.asset.normal is not None:
            normal = self._bent(hits.face, w, normal, self.at(self.asset.normal, uv))
        return Points(hits.ray, -directions[hits.ray], normal, uv, mesh.faces[hits.face], w)

    def at(self, image: F32, uv: npt.NDArray[np.floating]) -> F32:
        """(N, C) values of a map (H, W, C) of the asset at uv (N, 2)."""
        return bilinear(image, uv, self.asset.tiles)

    def strength(self, points: Points) -> F32:
        """(M,) rho c . B(n.wo): the factor of the light in the lobe."""
        cosine = (points.normal * points.wo).sum(1).clip(0, 1)
        table = lookup(self.asset.basis, cosine)
        return np.asarray((self.at(self.asset.coefficients, points.uv) * table).sum(1).clip(min=0), np.float32)

    def _bent(self, face: npt.NDArray[np.int64], weights: F32, normal: F64, local: F32) -> F64:
        """(M, 3) normals of the normal map, in asset coordinates."""
        tangent = np.einsum("nic,ni->nc", self._tangents[face], weights)
        sign = np.where(tangent[:, 3:] < 0, -1.0, 1.0)
        t = _unit(tangent[:, :3] - normal * (normal * tangent[:, :3]).sum(1, keepdims=True))
        b = np.cross(normal, t) * sign
        return _unit(local[:, :1] * t + local[:, 1:2] * b + local[:, 2:] * normal)


def vertex_values(image: F32, renderer: Renderer) -> F64:
    """(V, C) values of a map (H, W, C) at the vertices; at a seam, from one of its sides."""
    mesh = renderer.asset.mesh
    uv = np.zeros((len(mesh.vertices), 2), np.float32)
    uv[mesh.faces] = mesh.uvs[mesh.uv_faces]
    return renderer.at(image, uv).astype(np.float64)


def _borders(alpha: F32) -> npt.NDArray[np.bool_]:
    """(H, W) pixels with one of eight neighbours on the other side of the silhouette."""
    import cv2

    solid, ring = (alpha > 0).astype(np.uint8), np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(solid, ring) != cv2.erode(solid, ring))


def tangents(asset: ExportedAsset) -> F64:
    """(F, 3, 4) direction of growing u at each triangle corner, averaged in its chart; the chart's handedness."""
    mesh = asset.mesh
    x, t = mesh.vertices[mesh.faces].astype(np.float64), mesh.uvs[mesh.uv_faces].astype(np.float64)
    e1, e2, d1, d2 = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0], t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    along_u = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * np.sign(area)[:, None]
    along_u = _unit(along_u) * np.linalg.norm(np.cross(e1, e2), axis=1)[:, None]
    total = np.zeros((len(mesh.uvs), 3))
    for corner in range(3):
        np.add.at(total, mesh.uv_faces[:, corner], along_u)
    sign = np.broadcast_to(np.where(area < 0, -1.0, 1.0)[:, None, None], (len(area), 3, 1))
    return np.concatenate([_unit(total)[mesh.uv_faces], sign], -1)


def _square(samples: int) -> Filter:
    """Box filter of one pixel: samples x samples positions of equal weight."""
    inside = (np.arange(samples) + 0.5) / samples
    return _separable(inside, np.ones(samples))


def _triangle(samples: int, reach: float) -> Filter:
    """Triangle filter: samples x samples positions over `reach` pixels around the centre, 0 at its ends."""
    away = ((np.arange(samples) + 0.5) / samples - 0.5) * reach
    return _separable(0.5 + away, 1 - np.abs(away) / (0.5 * reach))


def _separable(position: F64, weight: F64) -> Filter:
    du, dv = (a.ravel() for a in np.meshgrid(position, position))
    weights = np.outer(weight, weight).ravel() / weight.sum() ** 2
    return Filter(np.stack([du, dv], -1), weights.astype(np.float32))


def _sample_positions(pixel: npt.NDArray[np.int64], width: int, filtered: Filter) -> F64:
    """(N * S, 2) image positions, all samples of a pixel one after the other."""
    corner = np.stack([pixel % width, pixel // width], -1)
    return (corner[:, None] + filtered.offsets).reshape(-1, 2).astype(np.float64)


def _unit(x: npt.NDArray[np.floating]) -> F64:
    length = np.sqrt(np.einsum("...c,...c->...", x, x))[..., None]
    return np.asarray(x / np.maximum(length, 1e-12), np.float64)
