"""Pixels that the fit never draws, and how well a model shows them: what the trials are judged by.

Whole blocks of a photo are withheld, because a single pixel between fitted ones would be predicted by its neighbours
whatever the model is. A block is a square of the photo's longest side / BLOCKS, and one in ONE_IN of them is withheld,
on a lattice that each photo shifts: the same place of the surface is withheld in few photos at once and fitted in the
others, so that a block asks what a held-out view asks. The lattice is in image coordinates without the lens's
distortion, so that the blocks are the same at every resolution.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pipeline.colour import srgb_from_linear
from pipeline.fields.face import FaceModel
from stages.inverse_rendering.objective import calibrated_colours
from stages.inverse_rendering.ray_sampling import WHOLE, PhotoView, PixelTable
from stages.inverse_rendering.render import render_rays

F64 = npt.NDArray[np.float64]

BLOCKS = 32  # along the longest side of a photo: 16 pixels at 512
ONE_IN, ACROSS, PER_VIEW = 31, 7, 12  # of the blocks; steps of the lattice along a column, and from photo to photo
RAYS = 6000  # of all views together: less work than two steps of a draft
LEAST = 20  # pixels of a view that is judged
LEAST_SQUARE = 1e-10  # 100 dB


def withheld(table: PixelTable, views: Sequence[PhotoView]) -> Tensor:
    """(N,) whether each pixel of the table is in a withheld block. views: those of the table, in its order."""
    scale = [BLOCKS * v.K[0, 0] / max(v.size) for v in views]
    per_view = torch.tensor(scale, dtype=torch.float32, device=table.xy.device)
    view = table.view.long()
    at = torch.floor(table.xy * per_view[view, None]).long()
    return torch.remainder(at[:, 0] + ACROSS * at[:, 1] + PER_VIEW * view, ONE_IN) == 0


def judged_pixels(table: PixelTable, chosen: Tensor, count: int) -> Tensor:
    """Indices of withheld pixels that are wholly the subject's and not clipped, evenly from the views, sorted by view.
    chosen: (N,) of `withheld`; count: number of views."""
    exact = chosen & (table.alpha > WHOLE) & (table.bound == 0).all(-1)
    pool = torch.nonzero(exact).squeeze(-1)  # sorted by view, as the table is
    sizes = torch.bincount(table.view[pool].long(), minlength=count).tolist()
    most, parts = max(RAYS // max(count, 1), LEAST), []
    for part in pool.split(sizes):
        if len(part) >= LEAST:
            every = torch.linspace(0, len(part) - 1, min(len(part), most), device=part.device)
            parts.append(part[every.round().long()])
    return torch.cat(parts) if parts else pool[:0]


def psnr_by_view(model: FaceModel, table: PixelTable, pixels: Tensor, count: int, samples: int) -> F64:
    """(V,) PSNR in dB, sRGB, of a model in each view's pixels, without random numbers: NaN for a view without pixels,
    -inf where the model is not finite. pixels: of `judged_pixels`; count: V."""
    if not len(pixels):
        return np.full(count, np.nan)
    batch = table.at(pixels)
    with torch.no_grad():
        colour, _ = render_rays(model, batch.rays, samples)
        if model.spec.colour_matrices:
            colour = calibrated_colours(model.calibration(), batch.view, colour)
        square = ((srgb_from_linear(colour.clamp(0, 1)) - batch.target) ** 2).mean(-1)
    view, error = batch.view.cpu().numpy(), square.double().cpu().numpy()
    error[~np.isfinite(error)] = np.inf
    pixels_of, total = np.bincount(view, minlength=count), np.bincount(view, error, count)
    mean = np.divide(total, pixels_of, out=np.full(count, np.nan), where=pixels_of > 0)
    with np.errstate(invalid="ignore"):
        return np.asarray(-10 * np.log10(np.maximum(mean, LEAST_SQUARE)), np.float64)
