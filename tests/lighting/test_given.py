"""A measured light as spherical harmonics, against closed forms and scipy's harmonics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from pipeline.errors import StageError
from pipeline.images import write_exr
from pipeline.lighting.given import read_latlong, sh_of_lamps, sh_of_latlong
from pipeline.maths.latlong import latlong_directions

ORDER = 10
HALF = [np.pi, 2 * np.pi / 3, np.pi / 4, 0, -np.pi / 24, 0, np.pi / 64]  # Lambda_l of max(cos, 0)


def harmonic(l: int, m: int, d: np.ndarray) -> np.ndarray:  # noqa: E741
    """Y_lm by scipy's complex harmonics, which have the Condon-Shortley phase."""
    polar, azimuth = np.arccos(np.clip(d[..., 2], -1, 1)), np.arctan2(d[..., 1], d[..., 0])
    if m == 0:
        return np.real(sph_harm_y(l, 0, polar, azimuth))
    found = np.sqrt(2) * (-1.0) ** m * sph_harm_y(l, abs(m), polar, azimuth)
    return np.real(found) if m > 0 else np.imag(found)


def picture(radiance, height: int = 128) -> np.ndarray:
    """A lat-long picture of a function of directions (H, 2 H, 3) -> (H, 2 H)."""
    values = radiance(latlong_directions(2 * height, height))
    return np.repeat(values[..., None], 3, 2).astype(np.float32) * np.array([1, 2, 0.5], np.float32)


def test_an_even_light_has_band_zero_alone() -> None:
    found = sh_of_latlong(picture(lambda d: np.ones(d.shape[:2])), ORDER, np.eye(3))
    np.testing.assert_allclose(found[0], np.sqrt(4 * np.pi) * np.array([1, 2, 0.5]), rtol=1e-6)
    np.testing.assert_allclose(found[1:], 0, atol=2e-3)


@pytest.mark.parametrize(("l", "m"), [(1, -1), (1, 0), (1, 1), (2, -2), (3, 1), (7, -5), (10, 10)])
def test_a_harmonic_comes_back_as_itself(l: int, m: int) -> None:  # noqa: E741
    """Oracle: scipy's harmonics; those of a picture may be negative."""
    found = sh_of_latlong(picture(lambda d: harmonic(l, m, d)), ORDER, np.eye(3))[:, 0]
    expected = np.zeros(121)
    expected[l * (l + 1) + m] = 1
    np.testing.assert_allclose(found, expected, atol=3e-3)


def test_a_cosine_lobe_is_the_clamped_cosine() -> None:
    """Oracle: its coefficients in closed form, Lambda_l sqrt((2 l + 1) / 4 pi) about an axis."""
    axis = np.array([0.48, 0.6, 0.64])
    found = sh_of_latlong(picture(lambda d: np.maximum(d @ axis, 0)), 6, np.eye(3))[:, 0]
    expected = [HALF[l] * harmonic(l, m, axis) for l in range(7) for m in range(-l, l + 1)]  # noqa: E741
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_one_coefficient_by_scipys_quadrature() -> None:
    """Oracle: adaptive quadrature of a smooth light against Y_21, which is the picture's only x z term."""

    def light(d: np.ndarray) -> np.ndarray:
        return np.exp(1.5 * d[..., 0] + 0.5 * d[..., 2])

    def integrand(polar: float, azimuth: float) -> float:
        d = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
        return float(light(d) * harmonic(2, 1, d) * np.sin(polar))

    expected = dblquad(integrand, 0, 2 * np.pi, 0, np.pi, epsabs=1e-6, epsrel=1e-6)[0]
    assert sh_of_latlong(picture(light), 2, np.eye(3))[7, 0] == pytest.approx(expected, rel=2e-3)


def test_the_convention_of_the_picture() -> None:
    """Row 0 is +Y, the centre column is +Z, and columns grow towards -X."""
    for row, column, axis in ((0, 10, [0, 1, 0]), (32, 64, [0, 0, 1]), (32, 96, [-1, 0, 0]), (32, 0, [0, 0, -1])):
        image = np.zeros((64, 128, 3), np.float32)
        image[row, column] = 1
        c = sh_of_latlong(image, 1, np.eye(3))[:, 0]
        towards = c[[3, 1, 2]] / np.linalg.norm(c[1:])
        assert towards @ axis > 0.99


def test_a_picture_in_a_turned_frame() -> None:
    """A light of asset direction a stands at world direction R a."""
    turn = Rotation.from_euler("xyz", [20, -50, 110], degrees=True).as_matrix()
    a = np.array([0.6, 0.0, 0.8])
    image = picture(lambda d: np.exp(20 * (d @ (turn @ a) - 1)))
    c = sh_of_latlong(image, 1, turn)[:, 0]
    np.testing.assert_allclose(c[[3, 1, 2]] / np.linalg.norm(c[1:]), a, atol=2e-3)
    long = np.concatenate([image[:, :37], image[:, 37:]], 1)
    np.testing.assert_array_equal(sh_of_latlong(long, 1, turn)[:, 0], c)


def test_many_lamps_are_their_sum_and_an_even_sphere_of_them_is_even() -> None:
    rng = np.random.default_rng(0)
    d = rng.normal(size=(40, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    e = rng.uniform(0, 2, (40, 3))
    each = sum(sh_of_lamps(d[i : i + 1], e[i : i + 1], 4) for i in range(40))
    np.testing.assert_allclose(sh_of_lamps(d, e, 4), each, atol=1e-12)
    cube = np.concatenate([np.eye(3), -np.eye(3)])
    found = sh_of_lamps(cube, np.full((6, 3), 4 * np.pi / 6), 3)
    np.testing.assert_allclose(found[0], np.sqrt(4 * np.pi))
    np.testing.assert_allclose(found[1:], 0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda x: x[:, :40], "40 x 32"),
        (lambda x: np.where(np.arange(64)[None, :, None] == 3, np.nan, x), "not a number"),
        (lambda x: x - 2, "negative"),
        (lambda x: x * 0, "black"),
    ],
)
def test_a_file_that_is_no_light_is_named(tmp_path: Path, change, told: str) -> None:
    path = tmp_path / "env.exr"
    write_exr(path, np.asarray(change(np.ones((32, 64, 3), np.float32)), np.float32))
    with pytest.raises(StageError, match=told):
        read_latlong(path)


def test_no_file_and_another_format_are_named(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="no such file"):
        read_latlong(tmp_path / "env.exr")
    (tmp_path / "env.jpg").write_bytes(b"x")
    with pytest.raises(StageError, match="a .jpg file"):
        read_latlong(tmp_path / "env.jpg")
