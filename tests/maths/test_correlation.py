"""Correlation of patches against numpy's, and at its ends."""

from __future__ import annotations

import numpy as np
import torch

from pipeline.maths.correlation import agreement, standardised


def patches(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_product_is_the_correlation_coefficient() -> None:
    x = patches(2, 49)
    got = float((standardised(x[0], 0.0) * standardised(x[1], 0.0)).sum())
    assert abs(got - np.corrcoef(x.numpy())[0, 1]) < 1e-12


def test_gain_and_offset_do_not_matter() -> None:
    x = patches(3, 1, 25).expand(3, 4, 25) * torch.tensor([1.0, 0.5, 2.0, 1.3])[:, None] + torch.rand(3, 4, 1)
    seen = torch.ones(3, 4, dtype=torch.bool)
    assert torch.allclose(agreement(x, seen, 0.0), torch.ones(3, dtype=torch.float64), atol=1e-9)


def test_flat_patches_say_nothing() -> None:
    """Patches of one noise far below the floor correlate perfectly, and count for nothing; zeros are finite."""
    noise = 1e-5 * patches(1, 1, 25).expand(1, 3, 25)
    seen = torch.ones(1, 3, dtype=torch.bool)
    assert 0 <= float(agreement(noise, seen)) < 1e-3
    assert float(agreement(torch.zeros(1, 3, 25), seen)) == 0.0


def test_the_better_half_votes() -> None:
    """One view that is hidden does not spoil it; views that do not see the point never count."""
    x = patches(1, 1, 49).repeat(1, 5, 1)
    x[:, 3] = 1 - x[:, 0]  # the opposite: correlation -1
    everyone = torch.ones(1, 5, dtype=torch.bool)
    assert float(agreement(x, everyone)) > 0.95
    only = torch.tensor([[True, True, True, False, False]])
    x[:, 3:] = torch.nan
    assert float(agreement(x, only)) > 0.95
    for n in range(3):
        assert float(agreement(x, torch.arange(5)[None] < n)) == -2.0
