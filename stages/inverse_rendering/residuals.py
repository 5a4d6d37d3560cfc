"""Errors of the finished fit in the fitted photos, on a sample of each photo's pixels. It has its own random generators
and does not change the fit.

Symbols: c the photo's colour, A_n I the rendered one with the photo's colour response [NeuFace eq. 19], e their
difference in sRGB.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from pipeline.colour import linear_from_srgb, srgb_from_linear
from pipeline.fields.face import FaceModel
from stages.inverse_rendering.objective import calibrated_colours
from stages.inverse_rendering.ray_sampling import U8, WHOLE, Batch, PhotoView, PixelTable, codes_at
from stages.inverse_rendering.stereo import photo_noise
from stages.inverse_rendering.systems import render_any

PIXELS = 60_000  # of all photos' subjects together: about a second on two cores
MAX_PIXELS, MIN_PIXELS = 2000, 300  # of one photo: its PSNR is then accurate to about 0.2 and 0.5 dB
SEED = 40_961
DARK = 1e-6  # mean radiance below which a photo is black
HALF = 0.5  # smallest opacity of a covered pixel


@dataclass(frozen=True, slots=True)
class LabelError:
    """pixels: number of compared pixels of one label. square: their mean squared error, sRGB."""

    pixels: int
    square: float


@dataclass(frozen=True, slots=True)
class ViewError:
    """Errors of one photo. square: mean squared error over its subject's pixels, sRGB. covered: the same over pixels
    where the model is not empty, so that a mask that includes too much does not count as a wrong photo. relative: RMS
    of the linear residual over the mean linear radiance. missing: share of the subject's pixels where the model is
    empty. beyond: share of the background's pixels, near the subject, where it is not. noise: standard deviation of the
    photo's noise, sRGB, at the fit's size. labels: errors by label name, if the photo has labels.
    """

    index: int
    pixels: int
    square: float
    relative: float
    missing: float
    beyond: float
    noise: float
    covered: float
    labels: Mapping[str, LabelError] = field(default_factory=dict)

    @property
    def psnr(self) -> float:
        """PSNR of the covered pixels in dB, at most 100."""
        return decibels(self.covered)


def decibels(square: float) -> float:
    """-10 log10 of a mean squared error, at most 100."""
    return float(-10 * np.log10(max(square, 1e-10)))


def view_errors(
    model: FaceModel,
    table: PixelTable,
    views: Sequence[PhotoView],
    side: int,
    samples: int,
    labels: Sequence[U8 | None] = (),
    names: Sequence[str] = (),
) -> tuple[ViewError, ...]:
    """The errors of every view with subject pixels in the table. table: all views at `side` pixels. labels: (H, W)
    codes of each view at any size, or None; names: of the codes."""
    most = min(max(PIXELS // max(len(views), 1), MIN_PIXELS), MAX_PIXELS)
    inside = _sample(table, table.inside, len(views), most, SEED)
    inside = [pool[(table.alpha[pool] > WHOLE) & (table.bound[pool] == 0).all(-1)] for pool in inside]
    outside = _sample(table, table.outside, len(views), most // 4, SEED + 1)
    outside = [pool[table.alpha[pool] < 1 - WHOLE] for pool in outside]
    if not any(len(pool) for pool in inside):
        return ()
    batch = table.at(torch.cat(inside))
    colour, opacity = _rendered(model, batch, samples)
    target = batch.target.float()
    square = ((srgb_from_linear(colour.clamp(0, 1)) - target) ** 2).mean(-1).double()
    truth = linear_from_srgb(target)
    linear = ((colour - truth) ** 2).mean(-1).double()
    there = _rendered(model, table.at(torch.cat(outside)), samples)[1] > HALF
    first, behind, out = 0, 0, []
    for n, view in enumerate(views):
        own, beside = slice(first, first + len(inside[n])), slice(behind, behind + len(outside[n]))
        first, behind = own.stop, beside.stop
        if not len(inside[n]):
            continue
        full = opacity[own] >= HALF
        out.append(
            ViewError(
                index=view.index,
                pixels=len(inside[n]),
                square=float(square[own].mean()),
                relative=float(linear[own].mean().sqrt() / truth[own].mean().clamp(min=DARK)),
                missing=1 - float(full.double().mean()),
                beyond=float(there[beside].double().mean()) if len(outside[n]) else 0.0,
                noise=photo_noise(view, side),
                covered=float(square[own][full if bool(full.any()) else slice(None)].mean()),
                labels=_by_label(view, table.xy[inside[n]], square[own], labels[n], names) if labels else {},
            )
        )
    return tuple(out)


def _rendered(model: FaceModel, batch: Batch, samples: int) -> tuple[Tensor, Tensor]:
    """Linear colour (N, 3) with the photos' colour responses, and opacity (N,)."""
    with torch.no_grad():
        colour, opacity = render_any(model, batch.rays, samples)
        if model.spec.colour_matrices:
            colour = calibrated_colours(model.calibration(), batch.view, colour)
    return colour, opacity


def _sample(table: PixelTable, pool: Tensor, count: int, most: int, seed: int) -> list[Tensor]:
    """At most `most` random pixels of a pool, which is sorted by view, for each of `count` views; with its own
    generator."""
    generator = torch.Generator().manual_seed(seed)
    of = table.view[pool].long()
    ends = torch.searchsorted(of, torch.arange(count + 1, device=of.device)).tolist()
    out = []
    for first, last in zip(ends[:-1], ends[1:], strict=True):
        if last - first > most:
            out.append(pool[first + torch.randint(last - first, (most,), generator=generator).to(pool.device)])
        else:
            out.append(pool[first:last])
    return out


def _by_label(
    view: PhotoView, xy: Tensor, square: Tensor, codes: U8 | None, names: Sequence[str]
) -> dict[str, LabelError]:
    """Errors of a view's pixels by label name. xy: (N, 2) on the z = 1 plane; square: (N,) squared errors."""
    if codes is None:
        return {}
    found, errors = codes_at(view, xy, codes), square.cpu().numpy()
    here = (int(c) for c in np.unique(found) if 0 < c < len(names))
    return {names[c]: LabelError(int((found == c).sum()), float(errors[found == c].mean())) for c in here}
