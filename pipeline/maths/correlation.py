"""Similarity of patches of photos, independent of brightness and contrast (NCC).

Symbols: patches (..., K) of K samples; floor is the standard deviation below which a patch is flat (sensor noise), in
the photos' unit.
"""

from __future__ import annotations

import torch
from torch import Tensor

FLOOR = 2e-3


def standardised(patches: Tensor, floor: float = FLOOR) -> Tensor:
    """Patches (..., K) with their mean removed and length 1, or less if their deviation is not far above `floor` > 0.

    The product of two of them is their normalised cross-correlation [Lewis, Fast Normalized Cross-Correlation, 1995],
    reduced towards 0 for flat patches, whose correlation would be that of the noise.
    """
    centred = patches - patches.mean(-1, keepdim=True)
    length = centred.square().sum(-1, keepdim=True).sqrt()
    unit: Tensor = centred / (length + floor * patches.shape[-1] ** 0.5)
    return unit


def agreement(patches: Tensor, seen: Tensor, floor: float = FLOOR) -> Tensor:
    """(N,) in [-1, 1]: mean correlation of the first view's patch with the better half of the other views'.

    patches (N, V, K); seen (N, V) bool, the seen ones first in each row. Only the better half, because a point may be
    occluded in some views. -2 where fewer than three views see the point.
    """
    unit = standardised(patches, floor)
    product = (unit[:, :1] * unit[:, 1:]).sum(-1)
    ranked = torch.where(seen[:, 1:], product, torch.full_like(product, -torch.inf)).sort(-1, descending=True)[0]
    others = seen[:, 1:].sum(-1)
    half = (others + 1) // 2
    take = torch.arange(ranked.shape[1], device=ranked.device) < half[:, None]
    mean = torch.where(take, ranked, torch.zeros_like(ranked)).sum(-1) / half.clamp(min=1)
    return torch.where(seen[:, 0] & (others >= 2), mean, torch.full_like(mean, -2.0))
