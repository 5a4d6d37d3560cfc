"""Observations: surface points with their colours in all photos, for cross-validation and light estimation.

Symbols: P points x with normals n; an observation is one of M pairs (point, view) in which the view sees the point:
c (M, 3) the photo's linear colour there, wo (M, 3) towards the camera. Points are the hits of random rays of the
photos, so their density follows that of the views.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pipeline import transforms
from pipeline.fields.parts import Geometry
from pipeline.images import shrink_whole
from pipeline.maths import sh
from pipeline.maths.sdf import unit
from pipeline.maths.tracing import box_interval
from stages.inverse_rendering.ray_sampling import WHOLE, PhotoView, Rays, factor_for

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
MIN_COSINE = 0.35  # at grazing angles a pixel covers too much surface
CLEARANCE_CELLS = 2.5  # tolerance of the occlusion test
SIDE = 256  # pixels: coarse enough for a surface with an error of a millimetre


@dataclass(frozen=True, slots=True)
class Picture:
    """A photo reduced by `factor`: rgb (h, w, 3) linear, alpha (h, w). view: photo and camera at the original size.
    skin (h, w): the face's skin without its border, None without labels."""

    view: PhotoView
    factor: int
    rgb: F32
    alpha: F32
    skin: Mask | None = None


@dataclass(frozen=True, slots=True)
class Observations:
    """x, n: (P, 3) points and normals. point, view: (M,) indices of point and view. colour, wo: (M, 3). skin: (M,)
    whether the photo shows the face's skin there, None if nothing is known."""

    x: Tensor
    n: Tensor
    point: I64
    view: I64
    colour: F64
    wo: F64
    skin: Mask | None = None

    @property
    def normal(self) -> F64:
        """n of each observation (M, 3)."""
        return np.asarray(self.n.double().cpu().numpy()[self.point], np.float64)

    @property
    def on_skin(self) -> Mask:
        """(P,) points that most of the photos that see them show as the face's skin."""
        if self.skin is None:
            return np.zeros(len(self.x), np.bool_)
        seen, as_skin = (np.bincount(self.point, w, len(self.x)) for w in (None, self.skin.astype(np.float64)))
        return np.asarray(as_skin > seen / 2)

    @property
    def cosine(self) -> F64:
        """n . wo, (M,)."""
        return np.asarray((self.normal * self.wo).sum(1), np.float64)

    @property
    def mirror(self) -> F64:
        """w_r (M, 3)."""
        return np.asarray(2 * self.cosine[:, None] * self.normal - self.wo, np.float64)


def point_means(point: I64, values: F64, counts: F64) -> F64:
    """(P,) or (P, C) mean of values (M,) or (M, C) over the observations of each point, whose number is counts (P,)."""
    columns = values.reshape(len(values), -1).T
    total = np.stack([np.bincount(point, column, len(counts)) for column in columns], -1)
    return np.asarray((total / counts[:, None]).reshape(-1, *values.shape[1:]), np.float64)


def lobe_basis(direction: F64, falls: F64) -> F64:
    """A_l Y_lm (M, (L + 1)^2) at directions (M, 3). falls: A_l of each lobe (M, L + 1), or of all lobes (1, L + 1)."""
    order = falls.shape[1] - 1
    spread = np.repeat(falls, 2 * np.arange(order + 1) + 1, axis=1)
    return np.asarray(sh.sh_basis(torch.from_numpy(direction), order).numpy() * spread, np.float64)


def pictures(views: list[PhotoView], side: int = SIDE) -> list[Picture]:
    """All photos at about `side` pixels."""
    out = []
    for view in views:
        f = factor_for(view.size, side)
        out.append(Picture(view, f, shrink_whole(view.rgb, f), shrink_whole(view.alpha, f), skin_inside(view, f)))
    return out


def skin_inside(view: PhotoView, factor: int) -> Mask | None:
    """(h, w) the face's skin in a photo reduced by `factor`, without the pixels at its border; None without labels."""
    if view.skin is None:
        return None
    whole = (shrink_whole(view.skin.astype(np.float32), factor) == 1).astype(np.uint8)
    return np.asarray(cv2.erode(whole, np.ones((3, 3), np.uint8)) > 0)


def surface_points(geometry: Geometry, rays: Rays) -> tuple[Tensor, Tensor]:
    """x and unit n (P, 3) where rays hit the surface, without the rays that miss it."""
    x, n, _ = surface_hits(geometry, rays, torch.zeros(len(rays.d), device=rays.d.device))
    return x, n


def surface_hits(geometry: Geometry, rays: Rays, names: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same, with the names (N,) of the rays that hit."""
    with torch.no_grad():
        near, far = box_interval(rays.o, rays.d, *geometry.box())
        t, hit, _ = geometry.trace(rays.o, rays.d, near, far)
        found = hit & (far > near)
        x = (rays.o + t[:, None] * rays.d)[found]
        return x, unit(geometry(x)[1]), names[found]


def observe(geometry: Geometry, shots: list[Picture], x: Tensor, n: Tensor) -> Observations:
    """Observations of points x with normals n (P, 3) in all photos: inside frame and mask, not at a grazing angle, not
    occluded."""
    points, normals = (a.detach().cpu().double().numpy() for a in (x, n))
    parts = [_seen_by(geometry, shot, points, normals, x) for shot in shots]
    view = np.concatenate([np.full(len(p[0]), i, np.int64) for i, p in enumerate(parts)])
    point, colour, wo, skin = (np.concatenate([p[k] for p in parts]) for k in range(4))
    return Observations(x, n, point.astype(np.int64), view, colour, wo, skin.astype(np.bool_))


def _seen_by(geometry: Geometry, shot: Picture, points: F64, normals: F64, x: Tensor) -> tuple[I64, F64, F64, Mask]:
    """Indices of the points that one photo sees, their colours there, the directions to the camera, and whether they
    are skin."""
    view = shot.view
    centre = view.world_from_cam[:3, 3]
    away = centre - points
    distance = np.linalg.norm(away, axis=1)
    wo = away / distance[:, None]
    uv, depth = transforms.project(view.K, transforms.inverse_rigid(view.world_from_cam), view.distortion, points)
    at = np.nan_to_num(uv / shot.factor - 0.5, nan=-1.0)
    h, w = shot.alpha.shape
    inside = (depth > 0) & (at >= 0).all(1) & (at[:, 0] < w - 1) & (at[:, 1] < h - 1)
    chosen = np.flatnonzero(inside & ((wo * normals).sum(1) > MIN_COSINE))
    value, least = _look_up(shot, at[chosen])
    chosen, value = chosen[least > WHOLE], value[least > WHOLE]
    free = unoccluded(geometry, centre, wo[chosen], distance[chosen], x)
    column, row = np.round(at[chosen[free]]).astype(np.int64).T
    skin = np.zeros(len(row), np.bool_) if shot.skin is None else shot.skin[row, column]
    return chosen[free], value[free], wo[chosen[free]], skin


def _look_up(shot: Picture, at: F64) -> tuple[F64, F64]:
    """Bilinear colour (N, 3) at pixel positions, and the least alpha of the four pixels."""
    low = np.floor(at).astype(np.int64)
    f = at - low
    value, least = np.zeros((len(at), 3)), np.ones(len(at))
    for dx in (0, 1):
        for dy in (0, 1):
            i, j = low[:, 1] + dy, low[:, 0] + dx
            weight = (f[:, 0] if dx else 1 - f[:, 0]) * (f[:, 1] if dy else 1 - f[:, 1])
            value += weight[:, None] * shot.rgb[i, j]
            least = np.minimum(least, shot.alpha[i, j])
    return value, least


def unoccluded(geometry: Geometry, centre: F64, wo: F64, distance: F64, x: Tensor) -> npt.NDArray[np.bool_]:
    """(N,) whether the points are not occluded. centre: (3,) of the camera; wo (N, 3); distance (N,)."""
    d = torch.from_numpy(-wo).to(x)
    o = torch.from_numpy(centre).to(x).expand_as(d).contiguous()
    reach = torch.from_numpy(distance).to(x) - CLEARANCE_CELLS * geometry.cell
    near, far = box_interval(o, d, *geometry.box())
    _, hit, _ = geometry.trace(o, d.contiguous(), near, torch.minimum(far, reach).contiguous())
    return np.asarray((~hit).cpu().numpy(), bool)
