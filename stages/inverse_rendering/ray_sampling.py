"""Pixels of the photos as rays: selection, directions, target colours and random batches.

Symbols: a view's pixel at image position uv has the ray direction R (x, y, 1), with (x, y) its exactly undistorted
position on the z = 1 plane. Photos are never resampled to remove distortion; a smaller size is the mean over blocks.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pipeline import transforms
from pipeline.colour import srgb_from_linear
from pipeline.images import shrink_whole
from pipeline.maths.light_frame import Stations

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
Int8 = npt.NDArray[np.int8]
U8 = npt.NDArray[np.uint8]
NEAR_BAND = 0.05  # of the image side: all background pixels within this distance of the subject are used
FAR_EVERY = 16  # of the other background pixels one in so many is used, against floating artefacts
DARKEST = 1e-4  # smallest mean radiance for the initial light
WHOLE = 0.99  # alpha of a fully covered pixel
BELOW_LIMIT = 0.8  # of the largest clipped value: a channel below it is not clipped, if another channel is


@dataclass(frozen=True, slots=True)
class PhotoView:
    """A photo with its camera: rgb (H, W, 3) linear, alpha (H, W) in [0, 1], at the photo's size.

    K: (3, 3) pixels; world_from_cam: (4, 4); distortion: k1 k2 p1 p2 k3. clipped: (H, W) clipped share of each pixel,
    None if none is clipped. doubtful: (H, W) where the mask contradicts the other views; these pixels are not fitted;
    None if nowhere. asked: (H, W) in [0, 1], below 1 where the subject is beyond its extent; only 1 is fitted; None if
    all pixels count. skin: (H, W) bare skin of the face, None if unknown. mirror: (H, W, 3) the mirror reflection
    alone, of a polarised pair, whose photo shows none; None without a pair. second: of the second capture.
    """

    index: int
    rgb: F32
    alpha: F32
    K: F64
    world_from_cam: F64
    distortion: F64
    clipped: F32 | None = None
    doubtful: Bool | None = None
    asked: F32 | None = None
    skin: Bool | None = None
    mirror: F32 | None = None
    second: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.rgb.shape[1], self.rgb.shape[0]


@dataclass(frozen=True, slots=True)
class Rays:
    """N rays: origins and unit directions (N, 3). axes: (N, 3, 3) of their cameras, columns right, down and forward;
    only a light that moves with the camera needs them. second: (N,) whether they are of the second capture; None: none
    is."""

    o: Tensor
    d: Tensor
    axes: Tensor | None = None
    second: Tensor | None = None

    def __getitem__(self, chosen: Tensor | slice) -> Rays:
        """The chosen rays."""
        axes = None if self.axes is None else self.axes[chosen].contiguous()
        second = None if self.second is None else self.second[chosen].contiguous()
        return Rays(self.o[chosen].contiguous(), self.d[chosen].contiguous(), axes, second)

    @property
    def stations(self) -> Stations | None:
        """The rays' cameras, for a light that moves with them or differs between two captures."""
        return None if self.axes is None else Stations(self.o, self.axes, self.second)


@dataclass(frozen=True, slots=True)
class Batch:
    """Rays with their pixels: target (N, 3) sRGB-encoded, alpha (N,), view (N,) position in the fit.

    share: (N,) weight of a ray in the mask term, mean 1: inverse to the probability of its pixel. Without it the side
    that is drawn more often would shift the silhouette by beta ln(ratio). bound: (N, 3) int8, 1 where the target is
    only a lower limit, -1 where it is only an upper limit, else 0.
    xy: (N, 2) position on the z = 1 plane.
    """

    rays: Rays
    target: Tensor
    alpha: Tensor
    view: Tensor
    share: Tensor
    bound: Tensor
    xy: Tensor


def evenly_spaced(count: int, n: int) -> tuple[int, ...]:
    """n positions among `count` views; none for n = 0."""
    return tuple(int((i + 0.5) * count / n) for i in range(n))


def factor_for(size: tuple[int, int], side: int, *, exact: bool = False) -> int:
    """The smallest block size, in pixels, that reduces the longest side of (width, height) to at most `side`.

    exact: the largest block size up to that which divides the photo, for pictures that are compared with it.
    """
    f = max(-(-max(size) // side), 1)
    if exact:
        f = next(k for k in range(f, 0, -1) if size[0] % k == 0 and size[1] % k == 0)
    return f


def normalised_positions(view: PhotoView, factor: int) -> F32:
    """(H, W, 2) of (x, y) on the z = 1 plane, for blocks of factor x factor pixels."""
    w, h = view.size
    uv = transforms.pixel_centres(w, h, factor)
    xy = np.asarray(np.linalg.solve(view.K[:2, :2], (uv - view.K[:2, 2]).T).T, np.float64)
    return transforms.undistort(xy, view.distortion).astype(np.float32).reshape(h // factor, w // factor, 2)


def codes_at(view: PhotoView, xy: Tensor, codes: U8) -> U8:
    """(N,) label codes of a view's pixels. xy: (N, 2) on the z = 1 plane; codes: (H, W) at any size."""
    positions = np.asarray(xy.cpu().numpy(), np.float64)
    uv = transforms.distort(positions, view.distortion) @ view.K[:2, :2].T + view.K[:2, 2]
    height, width = codes.shape
    column = (uv[:, 0] * width / view.size[0]).astype(np.int64).clip(0, width - 1)
    row = (uv[:, 1] * height / view.size[1]).astype(np.int64).clip(0, height - 1)
    return np.asarray(codes[row, column], np.uint8)


class PixelTable:
    """The pixels of all fitted views at one resolution, for random batches."""

    def __init__(self, views: list[PhotoView], side: int, device: str) -> None:
        parts = [_pixels_of(view, n, factor_for(view.size, side)) for n, view in enumerate(views)]
        xy, target, alpha, which, kind, bound = (np.concatenate(p) for p in zip(*parts, strict=True))
        self.bound = torch.from_numpy(bound).to(device)
        self.xy, self.target = torch.from_numpy(xy).to(device), torch.from_numpy(target).to(device)
        self.alpha, self.view = torch.from_numpy(alpha).to(device), torch.from_numpy(which).to(device)
        self.inside = torch.from_numpy(np.flatnonzero(kind == 1)).to(device)
        self.outside = torch.from_numpy(np.flatnonzero(kind == 0)).to(device)
        self._all = self._pools = self.inside, self.outside
        two = any(v.second for v in views)
        self.second = torch.tensor([v.second for v in views], device=device) if two else None
        self.place(views)

    def place(self, views: list[PhotoView]) -> None:
        """Use the poses of these views from now on: the same photos, in the same order."""
        poses, device = np.stack([v.world_from_cam for v in views]).astype(np.float32), self.xy.device
        self.R = torch.from_numpy(np.ascontiguousarray(poses[:, :3, :3])).to(device)
        self.centre = torch.from_numpy(np.ascontiguousarray(poses[:, :3, 3])).to(device)

    def withhold(self, pixels: Tensor | None) -> None:
        """Never draw these pixels (N,) of the table, bool, from now on; None: all may be drawn again. `exclude` comes
        after it."""
        a, b = self._all
        self._pools = self._all if pixels is None else (a[~pixels[a]], b[~pixels[b]])

    def exclude(self, views: tuple[int, ...]) -> None:
        """Draw from all views except these (positions in the fit) from now on."""
        out = torch.tensor(views, dtype=self.view.dtype, device=self.view.device)
        self.inside, self.outside = (p[~torch.isin(self.view[p], out)] if views else p for p in self._pools)

    def only(self, views: tuple[int, ...]) -> PixelTable:
        """The same table, restricted to these views."""
        out = copy.copy(self)
        these = torch.tensor(views, dtype=self.view.dtype, device=self.view.device)
        out.inside, out.outside = (p[torch.isin(self.view[p], these)] for p in self._pools)
        return out

    def mean_colour(self) -> Tensor:
        """(3,) mean linear radiance of the subject over all photos, at least DARKEST, so that the initial light is not
        zero."""
        if not len(self.inside):
            return torch.full((3,), DARKEST, device=self.target.device)
        s = self.target[self.inside[:: max(len(self.inside) // 100_000, 1)]].float()
        return (((s + 0.055) / 1.055).clamp(min=0) ** 2.4).mean(0).clamp(min=DARKEST)

    def draw(self, n: int, outside_share: float, seed: int) -> Batch:
        """A random batch of n rays that depends on the seed only. outside_share: share of background pixels."""
        generator = torch.Generator().manual_seed(seed)
        n_out = int(n * outside_share) if len(self.outside) else 0
        picks, shares = [], []
        for pool, k in ((self.inside, n - n_out), (self.outside, n_out)):
            if k and len(pool):
                picks.append(pool[torch.randint(len(pool), (k,), generator=generator).to(pool.device)])
                shares.append(torch.full((k,), len(pool) / k, device=pool.device))
        if not picks:  # photos of nothing
            picks, shares = [torch.zeros(0, dtype=torch.int64, device=self.view.device)], [self.alpha[:0]]
        i, share = torch.cat(picks), torch.cat(shares)
        return self.at(i, share / share.mean())

    def at(self, i: Tensor, share: Tensor | None = None) -> Batch:
        """The batch of the pixels i (N,) of the table. share: see Batch; 1 if None."""
        view = self.view[i].long()
        share = torch.ones_like(self.alpha[i]) if share is None else share
        rays, target = self._rays(self.xy[i], view), self.target[i].float()
        return Batch(rays, target, self.alpha[i], view, share, self.bound[i], self.xy[i])

    def _rays(self, xy: Tensor, view: Tensor) -> Rays:
        local = torch.cat([xy, torch.ones_like(xy[:, :1])], -1)
        d = torch.einsum("nij,nj->ni", self.R[view], local)
        second = None if self.second is None else self.second[view]
        return Rays(self.centre[view], d / d.norm(dim=-1, keepdim=True), self.R[view], second)


def _pixels_of(view: PhotoView, n: int, factor: int) -> tuple[npt.NDArray[Any], ...]:
    """Candidate pixels of one view: (x, y), encoded target, alpha, view number, 1 inside or 0 outside, bound."""
    alpha, rgb = shrink_whole(view.alpha, factor), shrink_whole(view.rgb, factor)
    encoded = srgb_from_linear(rgb).astype(np.float16)
    xy = normalised_positions(view, factor)
    reach = 2 * max(int(max(alpha.shape) * NEAR_BAND), 2) + 1
    near = cv2.dilate((alpha > 0.01).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    inside = alpha > 0.5
    far = np.zeros_like(near)
    far.reshape(-1)[n % FAR_EVERY :: FAR_EVERY] = True
    take = inside | near | far
    if view.doubtful is not None:
        take &= shrink_whole(view.doubtful.astype(np.float32), factor) == 0
    if view.asked is not None:
        take &= shrink_whole(view.asked, factor) > WHOLE
    bound = bounds_of(rgb, None if view.clipped is None else shrink_whole(view.clipped, factor))
    count = int(take.sum())
    number, kind = np.full(count, n, np.int16), inside[take].astype(np.int8)
    return xy[take], encoded[take], alpha[take], number, kind, bound[take]


def bounds_of(rgb: F32, clipped: F32 | None) -> Int8:
    """(H, W, 3) 1 where a block's mean rgb (H, W, 3) is only a lower limit, -1 where it is only an upper limit, else 0.

    clipped: (H, W) clipped share of each block. The mean of values of which some are clipped is a lower limit of the
    true mean. A channel of a wholly clipped block that is far below the photo's limit is not clipped itself. A mean of
    0 is that of values below the sensor's smallest.
    """
    bound = np.where(rgb <= 0, -1, 0).astype(np.int8)
    if clipped is None or not (clipped > 0).any():
        return bound
    limit = float(rgb[clipped > 0].max())
    known = (clipped >= WHOLE)[..., None] & (rgb < BELOW_LIMIT * limit)
    bound[(clipped > 0)[..., None] & ~known] = 1
    return bound


def image_rays(view: PhotoView, factor: int, device: str) -> Rays:
    """Rays of every block of a view, row by row."""
    xy = torch.from_numpy(normalised_positions(view, factor).reshape(-1, 2)).to(device)
    R = torch.from_numpy(view.world_from_cam[:3, :3].astype(np.float32)).to(device)
    d = torch.cat([xy, torch.ones_like(xy[:, :1])], -1) @ R.T
    o = torch.from_numpy(view.world_from_cam[:3, 3].astype(np.float32)).to(device).expand_as(d)
    second = torch.ones(len(d), dtype=torch.bool, device=device) if view.second else None
    return Rays(o, d / d.norm(dim=-1, keepdim=True), R.expand(len(d), 3, 3), second)
