"""The studio light: an orthonormal basis, coefficients that are its projection, positive everywhere."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.demo import light

F64 = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def quadrature() -> tuple[F64, F64]:
    """Directions (N, 3) and weights (N,), exact for products of two harmonics of degree 10."""
    z, weight = np.polynomial.legendre.leggauss(16)
    phi = np.arange(32) * 2 * np.pi / 32
    z, phi = (x.ravel() for x in np.meshgrid(z, phi, indexing="ij"))
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1)
    return directions, np.repeat(weight, 32) * 2 * np.pi / 32


def test_basis_is_orthonormal(quadrature: tuple[F64, F64]) -> None:
    directions, weight = quadrature
    basis = light.real_basis(directions)
    np.testing.assert_allclose(basis.T @ (weight[:, None] * basis), np.eye(121), atol=1e-12)


def test_first_degree_is_y_z_x(quadrature: tuple[F64, F64]) -> None:
    directions, _ = quadrature
    expected = np.sqrt(3 / (4 * np.pi)) * directions[:, [1, 2, 0]]
    np.testing.assert_allclose(light.real_basis(directions)[:, 1:4], expected, atol=1e-13)


def test_coefficients_are_the_projection_of_the_radiance(quadrature: tuple[F64, F64]) -> None:
    directions, weight = quadrature
    coefficients = light.studio_coefficients()
    assert coefficients.shape == (121, 3)
    projected = light.real_basis(directions).T @ (weight[:, None] * light.radiance(coefficients, directions))
    np.testing.assert_allclose(projected, coefficients, atol=1e-11)


def test_kernel_is_positive_and_preserves_the_mean() -> None:
    bands = light.kernel_bands()
    assert bands[0] == 1.0 and (np.diff(bands) < 0).all() and bands[-1] > 0
    t = np.linspace(-1, 1, 2001)
    kernel = np.polynomial.legendre.legval(t, (2 * np.arange(11) + 1) * bands)
    assert kernel.min() > -1e-9


def test_light_is_positive_everywhere_and_near_white() -> None:
    directions = light.lat_long_directions(180).reshape(-1, 3)
    radiance = light.radiance(light.studio_coefficients(), directions)
    assert radiance.min() > 0.9 * min(light.FILL)
    mean = radiance.mean(axis=0)
    np.testing.assert_allclose(mean / mean.mean(), 1.0, atol=0.05)


def test_flux_is_that_of_the_boxes() -> None:
    """Smoothing moves light about but makes none: compare with the boxes' own solid angles."""
    total = 4 * np.pi * np.asarray(light.FILL)
    for box in light.STUDIO:
        a, b = np.tan(box.width / 2), np.tan(box.height / 2)
        solid_angle = 4 * np.arcsin(a * b / np.sqrt((1 + a * a) * (1 + b * b)))
        total = total + solid_angle * np.asarray(box.radiance)
    np.testing.assert_allclose(np.sqrt(4 * np.pi) * light.studio_coefficients()[0], total, rtol=1e-3)


def test_lat_long_starts_at_plus_y_and_grows_towards_minus_x() -> None:
    directions = light.lat_long_directions(64)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    assert (directions[0, :, 1] > 0.999).all()
    assert directions[32, 64, 2] > 0.99, "the centre looks along +Z"
    assert directions[32, 96, 0] < -0.99, "a quarter to the right is -X"
    assert directions[32, 32, 0] > 0.99


def test_brightest_light_comes_from_the_key_box() -> None:
    picture = light.lat_long(light.studio_coefficients(), 64).mean(axis=-1)
    row, column = np.unravel_index(np.argmax(picture), picture.shape)
    key = np.asarray(light.STUDIO[0].towards) / np.linalg.norm(light.STUDIO[0].towards)
    assert light.lat_long_directions(64)[row, column] @ key > 0.97
