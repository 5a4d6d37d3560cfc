"""Renders the exported asset on the CPU with the model's own equations, straight from its maps.

    L(wo) = a / pi max(E(n), 0) + (sum_j rho c_j B_j(n.wo)) max(sum_l A_l(1/kappa) L_l(w_r), 0)     [NeuFace eq. 12, 16]

Primary rays go through the exact cameras (distortion included). No shadows and no bounces: neither has the model.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch

from pipeline.maths import brdf
from pipeline.transforms import rays
from stages.usd.exported import ExportedAsset

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]

CHUNK = 1 << 16  # rays at once: 121 basis functions of 65,536 directions are 32 MB
EMBREE_SIZE = 100.0  # embree works in float32 with absolute tolerances: the mesh is scaled to about this size


@dataclass(frozen=True, slots=True)
class View:
    """A camera as the renderer needs it; K in pixels with the first pixel's centre at (0.5, 0.5)."""

    K: F64
    world_from_cam: F64
    width: int
    height: int
    distortion: F64 = field(default_factory=lambda: np.zeros(5))


@dataclass(frozen=True, slots=True)
class Hits:
    """Where rays met the mesh. ray, face (M,); weights (M, 3) barycentric."""

    ray: npt.NDArray[np.int64]
    face: npt.NDArray[np.int64]
    weights: F64


class Renderer:
    """Holds the ray tracing structure of one asset; `render` may be called for any number of views and lights."""

    def __init__(self, asset: ExportedAsset) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.asset = asset
        mesh = asset.mesh
        self._corners = mesh.vertices[mesh.faces].astype(np.float64)
        self._scale = EMBREE_SIZE / max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-9)
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._scene, (mesh.vertices * self._scale).astype(np.float32), mesh.faces)
        self._tangents = tangents(asset)

    def render(
        self, view: View, *, factor: int = 1, samples: int = 2, light: F32 | None = None, plain: bool = False
    ) -> F32:
        """(height / factor, width / factor, 4) linear Rec.709 RGBA, premultiplied.

        `factor`: one pixel for factor x factor photo pixels. `samples`: rays along each side of a pixel.
        `light`: other SH coefficients than the captured ones. `plain`: grey diffuse surface, to see the shape alone.
        """
        h, w = view.height // factor, view.width // factor
        out = np.zeros((h * w, 4), np.float64)
        coefficients = torch.from_numpy(np.asarray(self.asset.light if light is None else light, np.float32))
        rows = max(1, CHUNK // (w * samples * samples))
        for top in range(0, h, rows):
            ys = np.arange(top, min(top + rows, h))
            uv = _sample_positions(ys, w, samples) * factor
            origin, directions = rays(view.K, view.world_from_cam, view.distortion, uv)
            hits = self.trace(origin, directions)
            rgba = np.zeros((len(uv), 4))
            rgba[hits.ray, :3] = self.shade(hits, -directions[hits.ray], coefficients, plain)
            rgba[hits.ray, 3] = 1
            out[top * w : top * w + len(ys) * w] = rgba.reshape(-1, samples * samples, 4).mean(1)
        return out.reshape(h, w, 4).astype(np.float32)

    def trace(self, origin: F64, directions: F64) -> Hits:
        """First hits. The weights are calculated again in float64: embree's own are good to 1e-5 only."""
        starts = np.broadcast_to(origin * self._scale, directions.shape)
        face = np.asarray(
            self._scene.run(np.ascontiguousarray(starts, np.float32), np.ascontiguousarray(directions, np.float32)),
            np.int64,
        )
        ray = np.flatnonzero(face >= 0)
        face = face[ray]
        a, b, c = self._corners[face].transpose(1, 0, 2)
        d = directions[ray]
        e1, e2 = b - a, c - a
        p, t = np.cross(d, e2), origin - a
        determinant = (e1 * p).sum(1)
        safe = np.where(np.abs(determinant) > 1e-30, determinant, 1.0)  # a ray in the triangle's plane: weights clipped
        q = np.cross(t, e1)
        u, v = (t * p).sum(1) / safe, (d * q).sum(1) / safe
        weights = np.stack([1 - u - v, u, v], -1).clip(0, 1)
        weights /= weights.sum(1, keepdims=True)
        return Hits(ray, face, weights)

    def shade(self, hits: Hits, wo: F64, light: torch.Tensor, plain: bool = False) -> F64:
        """(M, 3) radiance towards wo (M, 3)."""
        mesh, asset = self.asset.mesh, self.asset
        uv = (mesh.uvs[mesh.uv_faces[hits.face]] * hits.weights[..., None]).sum(1)
        normal = _unit((mesh.normals[mesh.faces[hits.face]] * hits.weights[..., None]).sum(1))
        if asset.normal is not None:
            normal = self._bent(hits, normal, bilinear(asset.normal, uv))
        n = torch.from_numpy(normal.astype(np.float32))
        out = torch.from_numpy(np.full((len(n), 3), 0.5, np.float32) if plain else bilinear(asset.albedo, uv))
        colour = brdf.diffuse(out, n, light)
        if asset.irradiance_ratio is not None and not plain:
            colour = colour * torch.from_numpy(bilinear(asset.irradiance_ratio, uv))
        if not plain:
            toward = torch.from_numpy(wo.astype(np.float32))
            cosine = (normal * wo).sum(1).clip(0, 1)
            strength = (bilinear(asset.coefficients, uv) * lookup(asset.basis, cosine)).sum(1).clip(min=0)
            s = torch.from_numpy(bilinear(asset.inv_kappa, uv)[:, 0]).clamp(min=0)
            incident = brdf.light_integral(brdf.reflect(toward, n), s, light, asset.attenuation)
            colour = colour + torch.from_numpy(strength.astype(np.float32))[:, None] * incident
        return np.asarray(colour.numpy(), np.float64)

    def _bent(self, hits: Hits, normal: F64, local: F32) -> F64:
        """The normal map's normal (tangent space) in asset coordinates."""
        tangent = (self._tangents[hits.face] * hits.weights[..., None]).sum(1)
        sign = np.where(tangent[:, 3:] < 0, -1.0, 1.0)
        t = _unit(tangent[:, :3] - normal * (normal * tangent[:, :3]).sum(1, keepdims=True))
        b = np.cross(normal, t) * sign
        return _unit(local[:, :1] * t + local[:, 1:2] * b + local[:, 2:] * normal)


def tangents(asset: ExportedAsset) -> F64:
    """(F, 3, 4) direction of growing u at each triangle corner, averaged in its chart, and the chart's handedness."""
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


def bilinear(image: F32, uv: npt.NDArray[np.floating]) -> F32:
    """(N, C) values of (H, W, C) at uv (N, 2): texel centres at +0.5, v up, clamped at the border."""
    h, w = image.shape[:2]
    x = (uv[:, 0] * w - 0.5).clip(0, w - 1)
    y = ((1 - uv[:, 1]) * h - 0.5).clip(0, h - 1)
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    x1, y1 = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1)
    fx, fy = (x - x0)[:, None].astype(np.float32), (y - y0)[:, None].astype(np.float32)
    top = image[y0, x0] * (1 - fx) + image[y0, x1] * fx
    bottom = image[y1, x0] * (1 - fx) + image[y1, x1] * fx
    return np.asarray(top * (1 - fy) + bottom * fy, np.float32)


def lookup(table: F32, cosine: F64) -> F32:
    """(N, k) rows of the (W, k) table at n.v = (i + 0.5) / W, linear between, constant beyond the ends."""
    width = len(table)
    x = (cosine * width - 0.5).clip(0, width - 1)
    low = np.floor(x).astype(np.int64)
    f = (x - low)[:, None].astype(np.float32)
    return np.asarray(table[low] * (1 - f) + table[np.minimum(low + 1, width - 1)] * f, np.float32)


def orbit_view(radius: float, azimuth: float, size: int, centre: F64 | None = None, elevation: float = 0.0) -> View:
    """A camera that looks at `centre` (default the origin) and frames a sphere of `radius`; azimuth 0 is +Z."""
    back = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    distance = 6 * radius
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, -np.cross(back, right), -back], 1)
    pose[:3, 3] = (np.zeros(3) if centre is None else centre) + back * distance
    focal = 0.5 * size / np.tan(np.arcsin(1 / 6)) / 1.02
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return View(K, pose, size, size)


def _sample_positions(rows: npt.NDArray[np.int64], width: int, samples: int) -> F64:
    """(rows * width * samples^2, 2) positions, all samples of a pixel one after the other."""
    inside = (np.arange(samples) + 0.5) / samples
    v, u, dv, du = np.meshgrid(rows, np.arange(width), inside, inside, indexing="ij")
    return np.stack([u + du, v + dv], -1).reshape(-1, 2).astype(np.float64)


def _unit(x: npt.NDArray[np.floating]) -> F64:
    return np.asarray(x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12), np.float64)
