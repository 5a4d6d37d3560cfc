"""Moves the surface to the depth that the optical flow from the model's pictures to the photos tells.

A step of the fit sees a photo's colours a pixel around the place where the model shows a point. Hair before a forehead,
on an arc of photos, starts millimetres off, and its picture is off by pixels. The albedo becomes the mean of pictures
that are shifted against each other, and no gradient leads back. Optical flow finds such shifts.

Symbols: f_v flow in pixels, from the model's picture to the photo, at a place x of the surface; J_v = d pixel / d x
(2, 3); g_v gradient of the model's picture; T_v = g g^T / (|g|^2 + FLAT^2), because flow is told across edges only; u
displacement of what x shows; d = n . u depth. About each place, over all views,

    (sum J^T T J / (ALIKE s^2) + 1 / EXPECTED^2) u = sum J^T T f / (ALIKE s^2)

The part of u along the surface is the texture's and is left to the fit. Cauchy's weights, ROUNDS times. d counts as
far as the views have taken the prior's variance along n away. Each half of them tells d alone: S = mean d_1 d_2 and
N = mean (d_1 - d_2)^2 / 4 about a place give the share S / (S + N) of d that is used, as in refine_poses.py. Nothing
moves out of the masks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from pipeline.fields.face import FaceModel
from pipeline.fields.geometry import GridSdf, grid_of
from pipeline.transforms import projection_slope
from stages.inverse_rendering.footprint import surface_of
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView, evenly_spaced
from stages.inverse_rendering.refine_poses import response_of
from stages.inverse_rendering.registration import Pair
from stages.inverse_rendering.sight import pair_of
from stages.inverse_rendering.weakly_seen import MISSED, band, on_surface, outside

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
FOLLOW_AT = (0.54, 0.75)  # shares of the fit: the model is sharp, and has time left; the first before a smoothing
POINTS = 20_000  # of the surface
MOST_VIEWS, LEAST_VIEWS = 32, 6
NEAR, NEIGHBOURS = 0.006, 40  # metres: standard deviation of the window about a place; places in it at most
FLAT = 0.01  # sRGB a block: gradient of the picture that tells half of what a strong one does
BORDER = 4  # blocks from what may not be compared
TURNED_BACK, FARTHEST = 1.0, 8.0  # blocks: flow there and back; largest flow
NOISE, ALIKE = 0.5, 27.0  # s in blocks; blocks whose flow is alike
EXPECTED, MOST = 0.005, 0.01  # metres
ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Flow:
    """Of one view at M blocks: x (M, 3), J (M, 2, 3) and f (M, 2) in blocks, g (M, 2) gradient of the picture."""

    x: F64
    J: F64
    f: F64
    g: F64


@dataclass(frozen=True, slots=True)
class Depth:
    """At N places: d (N,) asset units, outward positive, with what is not confirmed taken away; used (N,): share."""

    d: F64
    used: F64


def flow_of(pair: Pair) -> Flow:
    """The flow of a photo where it may be compared and is the same there and back."""
    usable = pair.usable & np.isfinite(pair.x).all(-1) & np.isfinite(pair.photo) & np.isfinite(pair.model)
    inner = cv2.erode(usable.astype(np.uint8), np.ones((2 * BORDER + 1,) * 2, np.uint8), borderValue=0) > 0
    model, photo = (np.where(usable, k, 0).astype(np.float32) for k in (pair.model, pair.photo))
    first, second = (np.rint(255 * np.clip(k, 0, 1)).astype(np.uint8) for k in (model, photo))
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]
    there, back = flow.calc(first, second, None), flow.calc(second, first, None)
    down, right = np.gradient(cv2.GaussianBlur(model, (0, 0), 1.0))
    h, w = usable.shape
    at = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).astype(np.float32) + there
    returned = there + cv2.remap(back, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    keep = inner & (np.linalg.norm(returned, axis=-1) < TURNED_BACK) & (np.linalg.norm(there, axis=-1) < FARTHEST)
    x = np.asarray(pair.x[keep], np.float64)
    J = projection_slope(pair.K, pair.cam_from_world, pair.distortion, x) / pair.factor
    return Flow(x, J, there[keep].astype(np.float64), np.stack([right[keep], down[keep]], -1).astype(np.float64))


def depth(flows: Sequence[Flow], x: F64, n: F64) -> Depth:
    """d at places x with unit normals n, (N, 3)."""
    tree = cKDTree(x)
    near, place = _window(tree), [tree.query(f.x)[1] for f in flows]
    first, second = (_along(n, *_solved(flows[k::2], place[k::2], near)) for k in (0, 1))
    signal, noise = near @ (first * second), near @ ((first - second) ** 2) / 4
    used = np.maximum(signal, 0) / np.maximum(np.maximum(signal, 0) + noise, 1e-30)
    total = np.asarray(near.sum(1)).ravel()
    d = near @ (0.5 * (first + second)) / total * used
    return Depth(np.clip(d, -MOST, MOST), used)


def _window(places: cKDTree) -> csr_array:
    """(N, N) Gaussian weights of the places about each place."""
    n = len(places.data)
    count = min(NEIGHBOURS, n)
    far, index = places.query(places.data, k=count, workers=-1)
    weight = np.exp(-0.5 * (far / NEAR) ** 2)
    return csr_array((weight.ravel(), (np.repeat(np.arange(n), count), index.ravel())), shape=(n, n))


def _along(n: F64, u: F64, spread: F64) -> F64:
    """(N,) n . u, times the share of the prior's variance along n that the views have taken away: what one view tells
    of a depth is as well a shift along the surface. spread (N, 3, 3): covariance of u."""
    left = np.einsum("ni,nij,nj->n", n, spread, n) / EXPECTED**2
    return np.asarray((u * n).sum(1) * (1 - left).clip(0, 1), np.float64)


def _solved(flows: Sequence[Flow], place: Sequence[I64], near: csr_array) -> tuple[F64, F64]:
    """u (N, 3) and its covariance (N, 3, 3). place: number of the nearest place of each flow's blocks."""
    count = near.shape[0]
    u, spread = np.zeros((count, 3)), np.zeros((count, 3, 3))
    for _ in range(ROUNDS):
        A, b = np.zeros((count, 9)), np.zeros((count, 3))
        for f, at in zip(flows, place, strict=True):
            off = np.einsum("mij,mj->mi", f.J, u[at]) - f.f
            weight = 1 / (1 + (off**2).sum(1) / (2 * NOISE) ** 2) / (ALIKE * NOISE**2)
            row = np.einsum("mi,mij->mj", f.g, f.J)
            told = weight / ((f.g**2).sum(1) + FLAT**2)
            square = (row[:, :, None] * row[:, None, :]).reshape(-1, 9) * told[:, None]
            right = row * (told * (f.g * f.f).sum(1))[:, None]
            for k in range(9):
                A[:, k] += np.bincount(at, square[:, k], count)
            for k in range(3):
                b[:, k] += np.bincount(at, right[:, k], count)
        spread = np.linalg.inv((near @ A).reshape(-1, 3, 3) + np.eye(3) / EXPECTED**2)
        u = np.einsum("nij,nj->ni", spread, near @ b)
    return u, spread


def follow_flow(model: FaceModel, views: Sequence[PhotoView], side: int, samples: int, device: str) -> float:
    """Move the zero set of the model's grid, in place, by the flow to photos that are evenly spaced over the views.

    side: of the fit's photos in pixels. Returns what 95 % of the surface moved by at most, asset units."""
    chosen = evenly_spaced(len(views), min(MOST_VIEWS, len(views)))

    def pair(k: int) -> Pair:
        return pair_of(model, views[chosen[k]], response_of(model, chosen[k]), side, samples, device)

    return move_surface(grid_of(model.geometry), [views[i] for i in chosen], pair, side)


def move_surface(grid: GridSdf, views: Sequence[PhotoView], pairs: Callable[[int], Pair], side: int) -> float:
    """Move the zero set, in place. pairs: the sight of the view of a number. Returns what 95 % of the surface moved by
    at most, asset units."""
    if len(views) < LEAST_VIEWS:
        return 0.0
    start = Start(grid.values.detach().cpu().numpy(), grid.lo.cpu().numpy(), grid.cell)
    x, n = on_surface(grid, surface_of(start, POINTS)[0])
    if not len(x):
        return 0.0
    d = depth([flow_of(pairs(i)) for i in range(len(views))], x, n).d
    grown = np.flatnonzero(d > 0)
    d[grown[outside(views, x[grown] + d[grown, None] * n[grown], side) >= MISSED]] = 0
    node = np.argwhere(band(start.values, grid.cell))
    nearest = cKDTree(x).query(start.lo + grid.cell * node, workers=-1)[1]
    values = start.values.copy()
    values[tuple(node.T)] -= d[nearest].astype(np.float32)
    grid.replace(torch.from_numpy(values))
    return float(np.percentile(np.abs(d), 95))
