"""A cornea as a convex mirror, against Fermat's principle, quadrature over the sphere and counted pixels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from pipeline.camera import PinholeCamera
from pipeline.eyes.mirror import Cornea, from_stored, intensity, reflected, stored, summed
from pipeline.meshes import unit
from pipeline.transforms import rigid

CENTRE, RADIUS = np.array([0.03, -0.01, 0.08]), 0.0078
EYE, LAMP = np.array([0.3, 0.1, 1.0]), np.array([[-0.6, 0.7, 0.9], [0.9, -0.2, 0.8], [0.3, 0.1, 1.3]])


def test_light_takes_the_shortest_way_by_the_sphere() -> None:
    """Oracle: Fermat. The path from lamp to eye over a point of the sphere is shortest at the reflection."""
    x, n = reflected(CENTRE, RADIUS, EYE, LAMP)
    np.testing.assert_allclose(np.linalg.norm(x - CENTRE, axis=1), RADIUS)
    for k, lamp in enumerate(LAMP):

        def length(angles: np.ndarray, lamp: np.ndarray = lamp) -> float:
            a, b = angles
            at = CENTRE + RADIUS * np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)])
            return float(np.linalg.norm(at - EYE) + np.linalg.norm(at - lamp))

        a, b = minimize(length, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-15}).x
        found = CENTRE + RADIUS * np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)])
        np.testing.assert_allclose(x[k], found, atol=2e-6)
    np.testing.assert_allclose((n * unit(EYE - x)).sum(1), (n * unit(LAMP - x)).sum(1), atol=1e-9)


@pytest.mark.parametrize("alpha", [0.01, 0.03, 0.08])
def test_the_reflection_is_as_bright_as_its_facets_together(alpha: float) -> None:
    """Oracle: GGX facets, integrated over the sphere; shadowing of facets and Fresnel's rise are left out."""
    lamp, strength = LAMP[:1], np.array([[4.0, 2.0, 1.0]])
    x, n = reflected(CENTRE, RADIUS, EYE, lamp)
    # a fine polar grid around n, finest at n
    t = np.linspace(0, 1, 1500) ** 3 * 1.2
    t = (t[1:] + t[:-1]) / 2, np.diff(t)
    turns = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    frame = np.linalg.svd(n)[2]
    axis = n[0]
    across, along = frame[1], frame[2]
    theta, phi = (g.ravel() for g in np.meshgrid(t[0], turns, indexing="ij"))
    width = np.repeat(t[1], len(turns))
    normal = np.cos(theta)[:, None] * axis
    normal = normal + np.sin(theta)[:, None] * (np.cos(phi)[:, None] * across + np.sin(phi)[:, None] * along)
    at = CENTRE + RADIUS * normal
    area = RADIUS**2 * np.sin(theta) * width * 2 * np.pi / len(turns)
    light, view = unit(lamp - at), unit(EYE - at)
    nh = (normal * unit(light + view)).sum(1)
    d = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)
    falls = strength / ((lamp - at) ** 2).sum(1, keepdims=True)
    front = ((normal * light).sum(1) > 0) & ((normal * view).sum(1) > 0)
    whole = (0.04 * d / 4 * area * front)[:, None] * falls  # f n.l n.v = F D / 4
    np.testing.assert_allclose(intensity(RADIUS, 0.04, x, lamp, strength)[0], whole.sum(0), rtol=0.02)


def test_extremes_of_the_intensity() -> None:
    x, _ = reflected(CENTRE, RADIUS, EYE, LAMP)
    one = np.ones((3, 3))
    assert (intensity(RADIUS, 0.0, x, LAMP, one) == 0).all() and (intensity(0.0, 1.0, x, LAMP, one) == 0).all()
    assert np.isfinite(intensity(RADIUS, 1.0, LAMP, LAMP, one)).all()  # a lamp on the cornea
    np.testing.assert_allclose(intensity(RADIUS, 0.03, x, LAMP, 1e6 * one), 1e6 * intensity(RADIUS, 0.03, x, LAMP, one))
    far, _ = reflected(CENTRE, RADIUS, 1e4 * unit(EYE[None])[0], 1e4 * unit(LAMP))
    np.testing.assert_allclose(far, reflected(CENTRE, RADIUS, 1e7 * unit(EYE[None])[0], 1e7 * unit(LAMP))[0], atol=1e-7)


def test_radiance_summed_over_pixels() -> None:
    """Oracle: a small disc that faces the camera covers as many pixels as rays through them hit it."""
    camera = PinholeCamera(
        np.array([[900.0, 0, 40], [0, 1100.0, 30], [0, 0, 1]]), rigid(np.eye(3), np.zeros(3)), 80, 60
    )
    at = np.array([[0.025, -0.015, 0.8]])
    side = 20
    rows, columns = np.mgrid[: 60 * side, : 80 * side]
    uv = (np.stack([columns.ravel(), rows.ravel()], 1) + 0.5) / side
    _, rays = camera.rays(uv)
    towards = unit(at)[0]
    far = np.linalg.norm(at) / (rays @ towards)  # of the plane through the point that faces the camera
    disc = 0.004
    hits = np.linalg.norm(rays * far[:, None] - at, axis=1) < disc
    counted = hits.sum() / side**2  # radiance 1, summed over pixels
    assert summed(camera, at)[0] * np.pi * disc**2 == pytest.approx(counted, rel=0.01)
    assert summed(camera, np.array([[0, 0, -1.0], [0, 0, 0]])).tolist() == [0, 0]


def test_a_glint_is_shared_as_the_lamps_around_show_it() -> None:
    normals = unit(np.array([[0.0, 0, 1], [0.1, 0, 1], [0, 0.5, 1]]))
    cornea = Cornea(CENTRE, RADIUS, 0.03, normals, np.array([1.0, 1, 0]))
    share = cornea.share(unit(np.array([[0.05, 0, 1.0], [0, 0.5, 1], [-1, 0, 0.1], [-0.36, 0, 1]])))
    assert share[3] < 0.01  # 20 degrees from the nearest
    assert share[0] > 0.9 and share[1] < 0.05 and share[2] == pytest.approx(0, abs=1e-6)
    assert Cornea(CENTRE, RADIUS, 0.03, np.zeros((0, 3)), np.zeros(0)).share(normals).tolist() == [0, 0, 0]


def test_stored_and_read() -> None:
    normals = unit(np.random.default_rng(0).normal(size=(7, 3)))
    cornea = Cornea(CENTRE, RADIUS, 0.0312, normals, np.array([1.0, 0, 1, 0, 1, 1, 0]))
    (same,) = from_stored(stored([cornea]))
    np.testing.assert_allclose(same.normals, normals, atol=1e-4)
    assert same.centre.tolist() == CENTRE.tolist() and same.radius == RADIUS and same.f0 == 0.0312
    assert same.seen.tolist() == cornea.seen.tolist() and from_stored(()) == ()
    with pytest.raises(KeyError):
        from_stored([{"centre": [0, 0, 0]}])
    with pytest.raises(ValueError):
        from_stored([stored([cornea])[0] | {"centre": [0, 0]}])
