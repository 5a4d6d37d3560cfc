"""Fine detail of the albedo from the photos: the high-frequency part that the field does not resolve.

Symbols
    a       albedo of the field; S = irradiance_ratio E(n) / pi, radiance of a surface of albedo 1 under its light
    g_v     specular radiance towards camera v
    a_v     albedo according to photo v: (A_v^-1 I_v - g_v) / S     [NeuFace eq. 4, 12, 16, 19] solved for it
    r_v     a_v - a, the residual
    F r     mean of r over the surface with a kernel of width WIDTH, over what photo v sees
    h       robust mean over photos of r_v - F r_v, s their root mean square difference from it, W their weight

    added = h / (1 + (s / DISAGREEMENT)^2) W / (W + HALF_WEIGHT)

The low band of each photo is removed before blending. So errors of the light, the lobe, the exposure and the shadows
do not enter the albedo, and there is no seam where the set of photos changes. Clipped pixels are ignored, as in the
fit. Less is added where photos disagree (ears, nostrils, a wrong surface) or hardly see the point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
import torch

from pipeline.fields.protocol import Field
from pipeline.lighting.moving import Standpoint
from pipeline.maths import brdf, sh
from pipeline.meshes import F32, F64, Mesh
from pipeline.smoothing import Smoother
from pipeline.threads import side_by_side
from stages.bake import detail_kernels as kernels
from stages.bake.detail_views import Photos

WIDTH = 0.004  # metres: what the field itself resolves
EDGES = 1.5  # mean edges of the mesh: least WIDTH, because the low band is stored at vertices
DISAGREEMENT = 0.015  # of albedo
HALF_WEIGHT = 0.1  # weight (1: one sharp photo from straight ahead) at which half of the detail is added
MIN_LIGHT = 0.1  # of the mean of S over all directions: darker places do not determine the albedo


@dataclass(frozen=True, slots=True)
class Points:
    """N points of the surface. x, n (N, 3); corner, weights (N, 3): vertices and barycentric weights; albedo, shade
    (N, 3): a, S."""

    x: F64
    n: F64
    corner: npt.NDArray[np.int32]
    weights: F32
    albedo: F32
    shade: F32


def joined(parts: Sequence[Points]) -> Points:
    """The points of several tiles as one set."""
    if len(parts) == 1:
        return parts[0]
    return Points(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Points)})


@dataclass(frozen=True, slots=True)
class Detail:
    """Data for the fine band. gloss (views, V, 3): g_v at the mesh's vertices; bands (V, views, 6): g_v and F r_v
    there; relative (views, V, 3): the light of each photo over the still one, (0, 0, 3) under a still light."""

    photos: Photos
    gloss: F32
    bands: F32
    relative: F32

    def added(self, p: Points) -> tuple[F32, F32]:
        """(N, 3) detail to add to the albedo, and (N,) weight: 1 for one sharp photo from straight ahead."""
        mean, support = np.zeros((len(p.x), 3), np.float32), np.zeros((len(p.x), 2), np.float32)
        photos, order = self.photos, np.argsort(p.corner[:, 0], kind="stable")
        kernels.fine(
            photos.cameras, photos.pixels, photos.depth, photos.clipped, order, p.x, p.n, p.corner, p.weights,
            self.bands, self.relative, p.albedo, p.shade, mean, support,
        )  # fmt: skip
        weight, spread = support.T
        trust = weight / (weight + HALF_WEIGHT) / (1 + (spread / DISAGREEMENT) ** 2)
        return np.asarray(mean * trust[:, None], np.float32), np.ascontiguousarray(weight)


def prepare(
    field: Field, mesh: Mesh, sparse: Points, photos: Photos, attenuation: str, step: Callable[[int, int], None]
) -> Detail:
    """Compute the low bands, from points about as dense as the vertices."""
    gloss, relative = _gloss(field, mesh, photos, attenuation), relative_light(field, mesh, photos.cameras[:, :30])
    x = mesh.vertices.astype(np.float64)[mesh.faces]
    edge = float(np.linalg.norm(x[:, 1] - x[:, 0], axis=1).mean())
    smooth = Smoother(mesh, max(WIDTH, EDGES * edge))
    bands = np.empty((len(mesh.vertices), len(gloss), 6), np.float32)

    def low_band(v: int) -> F64:
        values, cosines = np.zeros((len(sparse.x), 3), np.float32), np.zeros(len(sparse.x), np.float32)
        lit = sparse.shade
        if len(relative):
            lit = lit * np.einsum("nc,ncd->nd", sparse.weights, relative[v][sparse.corner])
        kernels.residual(
            photos.cameras, v, photos.pixels, photos.depth, photos.clipped, sparse.x, sparse.n, sparse.corner,
            sparse.weights, gloss[v], sparse.albedo, lit, values, cosines,
        )  # fmt: skip
        sums, total = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
        kernels.splat(sparse.corner, sparse.weights, values, cosines**2, sums, total)
        return smooth.mean(sums / np.maximum(total, 1e-9)[:, None], total)

    for v, low in enumerate(side_by_side(low_band, range(len(gloss)))):
        step(v, len(gloss))
        bands[:, v, :3], bands[:, v, 3:] = gloss[v], low
    return Detail(photos, gloss, bands, relative)


def relative_light(field: Field, mesh: Mesh, cameras: F64) -> F32:
    """(views, V, 3) irradiance in each photo over that of the still stand-in, for a light that moves; else (0, 0, 3).
    cameras (views, 30) as in detail_kernels."""
    moving = field.moving_light
    if moving is None:
        return np.zeros((0, 0, 3), np.float32)
    alike = np.ones((len(mesh.vertices), 3), np.float32)
    still, n = shade(field.light, mesh.normals, alike), np.ascontiguousarray(mesh.normals, np.float32)
    out = np.empty((len(cameras), len(n), 3), np.float32)
    for v, camera in enumerate(cameras):
        out[v] = lit_at_least(moving.irradiance(mesh.vertices, n, _standpoint(camera)), field.light) / still
    return out


def _standpoint(camera: F64) -> Standpoint:
    """Of a row of detail_kernels."""
    return Standpoint(camera[27:30], camera[:12].reshape(3, 4)[:, :3].T)


def lit_at_least(e: F32, light: F32) -> F32:
    """(N, 3) irradiance over pi, not below MIN_LIGHT of its mean over all normals: darker places do not determine the
    albedo. That mean is pi times that of the radiance, c_00 Y_00."""
    floor = MIN_LIGHT * float(light[0].mean()) / np.sqrt(4 * np.pi)
    return np.asarray(np.maximum(e / np.pi, max(floor, 1e-6)), np.float32)


def shade(light: F32, normals: F64 | F32, ratio: F32) -> F32:
    """(N, 3) S for normals (N, 3) and irradiance ratio (N, 3). Its lower limit avoids amplified noise in the dark."""
    coefficients = torch.from_numpy(np.asarray(light, np.float32))
    e = sh.irradiance(coefficients, torch.from_numpy(np.ascontiguousarray(normals, np.float32))).numpy()
    return lit_at_least(e * ratio, light)


def _gloss(field: Field, mesh: Mesh, photos: Photos, attenuation: str) -> F32:
    """(views, V, 3) g_v = rho c . B(wo, n) L(w_r). [NeuFace eq. 12]"""
    material = field.material(mesh.vertices)
    light, moving = torch.from_numpy(np.asarray(field.light, np.float32)), field.moving_light
    out = np.zeros((len(photos.cameras), len(mesh.vertices), 3), np.float32)
    for v, centre in enumerate(photos.cameras[:, 27:30]):
        away = centre - mesh.vertices
        wo = (away / np.linalg.norm(away, axis=1, keepdims=True)).astype(np.float32)
        rows = np.flatnonzero((wo * mesh.normals).sum(1) > 0)
        n, w = mesh.normals[rows], wo[rows]
        bound = material.rho[rows] * (material.coefficients[rows] * field.basis(w, n)).sum(1)
        width = material.inv_kappa[rows]
        if moving is None:
            mirror = brdf.reflect(torch.from_numpy(w), torch.from_numpy(n))
            incident = brdf.light_integral(mirror, torch.from_numpy(width), light, attenuation).numpy()
        else:
            incident = moving.reflected(mesh.vertices[rows], n, width, _standpoint(photos.cameras[v]), attenuation)
        out[v, rows] = bound[:, None] * incident
    return out
