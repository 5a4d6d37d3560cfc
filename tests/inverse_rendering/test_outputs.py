"""The outputs of a fit."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.colour import as_photographed


def test_a_response_acts_on_colours_alone() -> None:
    """Against the product written out, pixel by pixel."""
    rng = np.random.default_rng(1)
    rgba, response = rng.random((2, 3, 4), np.float32), rng.random((3, 3))
    out = as_photographed(rgba, response.tolist())
    for y, x in np.ndindex(2, 3):
        for k in range(3):
            assert out[y, x, k] == pytest.approx(sum(response[k, j] * rgba[y, x, j] for j in range(3)), rel=1e-5)
    assert np.array_equal(out[..., 3], rgba[..., 3])
    assert not np.shares_memory(out, rgba)
