"""How alike patches of photos are, whatever each photo's brightness and contrast.

Symbols: patches (..., K) of K samples; floor is the standard deviation below which a patch counts as flat (the sensor's
noise), in the photos' own unit.
"""

from __future__ import annotations

import torch
from torch import Tensor

FLOOR = 2e-3


def standardised(patches: Tensor, floor: float = FLOOR) -> Tensor:
    """Patches (..., K) without their mean, of length 1; of less where their deviation is not far above `floor` > 0.

    The product of two of them is their normalised cross-correlation [Lewis, Fast Normalized Cross-Correlation, 1995],
    drawn towards 0 for flat patches, whose correlation would be the noise's.
    """
    centred = patches - patches.mean(-1, keepdim=True)
    length = centred.square().sum(-1, keepdim=True).sqrt()
    unit: Tensor = centred / (length + floor * patches.shape[-1] ** 0.5)
    return unit


def agreement(patches: Tensor, seen: Tensor, floor: float = FLOOR) -> Tensor:
    """(N,) in [-1, 1]: mean correlation of the first view's patch with the better half of the other views'.

    patches (N, V, K); seen (N, V) bool, the seen ones first in each row. The better half, because what hides a point
    from a few views must not hide it from the vote. -2 where fewer than three views see the point.
    """
    unit = standardised(patches, floor)
    product = (unit[:, :1] * unit[:, 1:]).sum(-1)
    ranked = torch.where(seen[:, 1:], product, torch.full_like(product, -torch.inf)).sort(-1, descending=True)[0]
    others = seen[:, 1:].sum(-1)
    half = (others + 1) // 2
    take = torch.arange(ranked.shape[1], device=ranked.device) < half[:, None]
    mean = torch.where(take, ranked, torch.zeros_like(ranked)).sum(-1) / half.clamp(min=1)
    return torch.where(seen[:, 0] & (others >= 2), mean, torch.full_like(mean, -2.0))
