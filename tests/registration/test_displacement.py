"""Displacement: where it counts, and how it fades."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from support.ball_head import RADIUS, ball_quads

from pipeline.registration import displacement as module
from pipeline.registration.displacement import AGREE, CLOSE, SPREAD, displacement


def rings_from(outside: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """(n,) number of quads to cross from each vertex to one outside, by a search from vertex to vertex."""
    away = np.where(outside, 0, np.iinfo(np.int64).max)
    for ring in range(1, len(away)):
        reached = [v for q in quads if (away[q] == ring - 1).any() for v in q if away[v] > ring]
        if not reached:
            break
        away[reached] = ring
    return away


def test_it_fades_by_a_third_with_each_ring_of_quads() -> None:
    n, quads = ball_quads(12)
    use = n[:, 1] < 0.4
    expected = np.minimum(rings_from(~use, quads), SPREAD + 1) / (SPREAD + 1)
    np.testing.assert_allclose(module._faded(use, quads), expected)
    assert set(np.round(expected * (SPREAD + 1)).astype(int)) == set(range(SPREAD + 2))


@pytest.mark.parametrize("unit", [1.0, 10.0])
@pytest.mark.parametrize(("beyond", "moves"), [(0.9, True), (1.1, False)])
def test_a_normal_that_meets_another_part_moves_nothing(unit: float, beyond: float, moves: bool) -> None:
    """t against the limit AGREE e + CLOSE, for a surface whose nearest place is e = 0.3 mm off."""
    n, quads = ball_quads(8)
    near = 3e-4 * unit
    t = beyond * (AGREE * near + CLOSE * unit)
    one = np.ones(len(n))
    scan = SimpleNamespace(
        along=lambda points, normals, reach: (t * one, one),
        pairs=lambda points, normals, reach: SimpleNamespace(distance=near * one),
        over=lambda points, normals, reach: 0 * one,
    )
    found, seen = displacement(RADIUS * unit * n, n, quads, np.ones(len(quads), bool), scan, unit)  # type: ignore[arg-type]
    np.testing.assert_allclose(found, t if moves else 0.0)
    assert (seen == (1.0 if moves else 0.0)).all()
