"""Displacement under hair: nothing outwards, and inwards where the skin would come through."""

from __future__ import annotations

import numpy as np
import pytest
from support.ball_head import RADIUS, ball_quads, ball_scan

from pipeline.registration.displacement import REACH, displacement
from pipeline.registration.scan import Scan


@pytest.mark.parametrize(("thick", "wanted"), [(0.002, 0.0), (0.0005, -0.0015), (-0.009, -REACH)])
def test_under_hair(thick: float, wanted: float) -> None:
    """Hair is the upper half, `thick` off the head, 2 mm over its skin at least; below, the scan is 1 mm off."""
    n, quads = ball_quads(24)
    at = ball_scan(RADIUS)
    hair = at.vertices[:, 1] > 0
    moved = at.vertices * np.where(hair, 1 + thick / RADIUS, 1 + 0.001 / RADIUS)[:, None].astype(np.float32)
    scan = Scan(type(at)(moved, at.normals, at.faces), (~hair).astype(float), np.where(hair, 0.002, 0.0))
    found, seen = displacement(RADIUS * n, n, quads, np.ones(len(quads), bool), scan, 1.0)
    top, bottom = n[:, 1] > 0.3, n[:, 1] < -0.3
    if thick > -REACH:
        np.testing.assert_allclose(found[top], wanted, atol=1e-4)
    else:
        assert (found[top] >= -REACH - 1e-9).all()
    np.testing.assert_allclose(found[bottom], 0.001, atol=1e-4)
    assert not seen[top].any() and seen[bottom].all()
