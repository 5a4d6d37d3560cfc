"""The reflection lobe and the light at a point, against formulas written out here."""

from __future__ import annotations

import numpy as np
import pytest

from stages.reflectance.lobe_kernels import geometry, lobe, specular
from stages.reflectance.sample_kernels import cubic


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


def test_geometry_is_that_of_vectors() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        point, light, eye = rng.normal(size=(3, 3))
        normal, axis = unit(rng.normal(size=3)), unit(rng.normal(size=3))
        e, nl, nv, nh, vh = geometry(point, normal, light, axis, eye)
        towards, view = unit(light - point), unit(eye - point)
        half = unit(towards + view)
        assert e == pytest.approx(max(-towards @ axis, 0) / np.sum((light - point) ** 2))
        assert (nl, nv, nh, vh) == pytest.approx(
            (normal @ towards, normal @ view, normal @ half, view @ half), abs=1e-9
        )


@pytest.mark.parametrize("alpha", [0.1, 0.3, 1.0])
def test_the_distribution_has_unit_projected_area(alpha) -> None:
    """Oracle: int D (n.h) dh = 1 over the hemisphere. The lobe at nl = nv = vh = 1 is D / 4 (no shadowing is left)."""
    cosine = (np.arange(200_000) + 0.5) / 200_000
    d = np.array([4 * lobe(alpha, 1.0, 1.0, c, 1.0) for c in cosine])
    assert 2 * np.pi * np.mean(d * cosine) == pytest.approx(1, rel=2e-3)


def test_the_lobe_is_reciprocal_and_rises_to_the_rim() -> None:
    assert lobe(0.2, 0.3, 0.8, 0.9, 0.7) == pytest.approx(lobe(0.2, 0.8, 0.3, 0.9, 0.7))
    assert lobe(0.2, 0.5, 0.5, 0.9, 0.0) == pytest.approx(25 * lobe(0.2, 0.5, 0.5, 0.9, 1.0))  # F: 1 against F0 = .04


def test_specular_reflects_no_more_than_arrives() -> None:
    """Oracle: energy. F0 of .04 in one lobe reflects about .04 of the light from straight above, seen all around."""
    rng = np.random.default_rng(1)
    views = rng.normal(size=(200_000, 3))
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    views = views[views[:, 2] > 0.01]
    half = views + [0, 0, 1]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    values = [
        specular(np.array([0.04]), np.array([0.2]), 1.0, v[2], h[2], v @ h) for v, h in zip(views, half, strict=True)
    ]
    reflected = 2 * np.pi * np.mean(np.array(values) * views[:, 2])
    assert 0.035 < reflected < 0.045


def test_specular_at_the_extremes() -> None:
    weights, alphas = np.array([0.1, 0.0, 0.1]), np.array([0.3, 0.1, 0.02])
    assert specular(weights, alphas, -0.2, 0.5, 0.9, 0.5) == 0
    assert specular(0 * weights, alphas, 0.5, 0.5, 1.0, 0.5) == 0
    mirror = specular(weights, alphas, 1.0, 1.0, 1.0, 1.0)
    assert np.isfinite(mirror) and mirror > 10
    assert np.isfinite(specular(weights, alphas, 1e-9, -0.3, 0.0, 0.0))


def test_pictures_are_interpolated_as_their_polynomials() -> None:
    """Oracle: a plane is met exactly, and a pixel's centre gives the pixel; outside, the border's value."""
    y, x = np.mgrid[0:12, 0:10] + 0.5
    plane = np.stack([2 * x + 3 * y, x - y, 0 * x + 5], -1).astype(np.float32)
    at = np.array([[3.5, 4.5], [4.1, 6.7], [5.99, 2.01]])
    out = np.empty((3, 3), np.float32)
    cubic(plane, at, out)
    np.testing.assert_allclose(
        out, np.stack([2 * at[:, 0] + 3 * at[:, 1], at[:, 0] - at[:, 1], 0 * at[:, 0] + 5], -1), atol=1e-4
    )
    far = np.empty((2, 3), np.float32)
    cubic(plane, np.array([[-50.0, -50.0], [99.0, 99.0]]), far)
    np.testing.assert_allclose(far, plane[[0, -1], [0, -1]])
