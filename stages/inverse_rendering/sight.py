"""What the fitted model shows in a photo, beside the photo, for its registration."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import torch

from pipeline import transforms
from pipeline.colour import srgb_from_linear
from pipeline.fields.face import FaceModel
from pipeline.images import shrink_whole
from stages.inverse_rendering.ray_sampling import WHOLE, PhotoView, Rays, factor_for, image_rays
from stages.inverse_rendering.registration import SQUARE, Pair
from stages.inverse_rendering.registration_outline import outline_of
from stages.inverse_rendering.render import sample_shell, shade_shell

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
SIDE = 0.5  # of the fit's image side: the sight's. Registration is accurate to a small part of a pixel
AROUND = 13  # blocks: the model is rendered this far around the mask
STEEP = 6.0  # depth difference between neighbours, in blocks, that marks a depth edge
OPAQUE = 0.5  # least opacity of a surface: early in the fit it is soft
CHUNK = 65_536


def pair_of(model: FaceModel, view: PhotoView, response: F64, side: int, samples: int, device: str) -> Pair:
    """Photo and model on blocks of the photo. response: (3, 3) from the model's colours to the photo's; side: of the
    fit's photos, in pixels."""
    factor = factor_for(view.size, max(int(SIDE * side), 16))
    alpha, rgb = shrink_whole(view.alpha, factor), shrink_whole(view.rgb, factor)
    near = cv2.dilate((alpha > 1 - WHOLE).astype(np.uint8), np.ones((AROUND, AROUND), np.uint8)) > 0
    rays = image_rays(view, factor, device)
    index = torch.from_numpy(np.flatnonzero(near)).to(device)
    colour, opacity, x = _rendered(model, rays[index], samples)
    shown, solid, points = (
        np.zeros((*alpha.shape, 3)),
        np.zeros(alpha.shape, np.float32),
        np.full((*alpha.shape, 3), np.nan),
    )
    shown[near], solid[near], points[near] = colour @ response.T, opacity, x
    trusted = _trusted(view, factor)
    surface = _surface(view, solid, points, factor)
    usable = surface & trusted & (alpha > WHOLE)
    if view.clipped is not None:
        usable &= shrink_whole(view.clipped, factor) == 0
    photo, seen = (srgb_from_linear(np.asarray(c, np.float32).clip(0, 1)).mean(-1) for c in (rgb, shown))
    found = Pair(
        np.asarray(photo, np.float32), np.asarray(seen, np.float32), points, usable, view.K,
        transforms.inverse_rigid(view.world_from_cam), view.distortion, factor,
    )  # fmt: skip
    return replace(found, outline=outline_of(found, alpha, solid, points, surface, trusted & near, SQUARE))


def _rendered(model: FaceModel, rays: Rays, samples: int) -> tuple[F32, F32, F32]:
    """Linear colour (N, 3) and opacity (N,) of the first layer, and its surface points (N, 3), NaN where it is
    empty."""
    parts = [_chunk(model, rays[i : i + CHUNK], samples) for i in range(0, len(rays.d), CHUNK)]
    if not parts:
        return np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros((0, 3), np.float32)
    colour, opacity, x = (torch.cat(p).cpu().numpy() for p in zip(*parts, strict=True))
    return colour, opacity, x


def _chunk(model: FaceModel, rays: Rays, samples: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    colour, opacity = torch.zeros_like(rays.d), torch.zeros_like(rays.d[:, 0])
    x = torch.full_like(rays.d, float("nan"))
    with torch.no_grad():
        shell = sample_shell(model, rays, samples, None, None)
        if len(shell.kept):
            every = torch.arange(len(shell.kept), device=rays.d.device)
            colour[shell.kept] = shade_shell(model, shell, rays, every).total
            opacity[shell.kept] = -torch.expm1(-shell.tau)
            x[shell.kept] = shell.x
    return colour, opacity, x


def _trusted(view: PhotoView, factor: int) -> Bool:
    """(h, w) where the mask is right and the subject counts."""
    out = np.ones((view.size[1] // factor, view.size[0] // factor), np.bool_)
    if view.asked is not None:
        out &= shrink_whole(view.asked, factor) > WHOLE
    if view.doubtful is not None:
        out &= shrink_whole(view.doubtful.astype(np.float32), factor) == 0
    return np.asarray(out, np.bool_)


def _surface(view: PhotoView, opacity: F32, x: F64, factor: int) -> Bool:
    """(h, w) where the model shows a surface and no edge of depth."""
    away = np.linalg.norm(x - view.world_from_cam[:3, 3], axis=-1)
    there = (opacity > OPAQUE) & np.isfinite(away)
    if not there.any():
        return np.asarray(there, np.bool_)
    depth = np.where(there, away, 0).astype(np.float32)
    window = np.ones((3, 3), np.uint8)
    jump = cv2.dilate(depth, window) - cv2.erode(depth, window)
    block = factor * float(np.median(away[there])) / view.K[0, 0]
    return np.asarray(there & (jump < STEEP * block), np.bool_)
