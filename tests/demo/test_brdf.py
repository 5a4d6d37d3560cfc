"""Sampled reflection against brute-force quadrature written here from the textbook formulas."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import qmc

from pipeline.demo import brdf, light, skin

F64 = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]

NORMAL = np.array([0.36, 0.48, 0.8])
TANGENT = np.array([0.8, -0.6, 0.0])
BITANGENT = np.cross(NORMAL, TANGENT)
F0 = 0.04


@pytest.fixture(scope="module")
def coefficients() -> F64:
    return light.studio_coefficients()


@pytest.fixture(scope="module")
def table(coefficients: F64) -> F32:
    return brdf.cube_table(lambda w: light.radiance(coefficients, w), 96)


def eye(cosine: float) -> F64:
    return np.asarray(cosine * NORMAL + np.sqrt(1 - cosine**2) * (0.6 * TANGENT + 0.8 * BITANGENT))


def shaded(albedo: float, f0: float, width: float, cosine: float, table: F32, samples: int = 1 << 12) -> F64:
    """Sampled radiance (3,) of one point, averaged over a few turns of the net."""
    turns = np.random.default_rng(1).random((8, 2))
    rows = len(turns)
    net = qmc.Sobol(2, scramble=False).random(samples)
    out, _ = brdf.shade(
        np.tile(NORMAL, (rows, 1)), np.tile(eye(cosine), (rows, 1)), np.full((rows, 3), albedo),
        np.full(rows, f0), np.full(rows, width), turns, net, table,
    )  # fmt: skip
    return np.asarray(out.mean(axis=0))


def hemisphere(rows: int) -> tuple[F64, F64]:
    """World directions (N, 3) over the hemisphere of NORMAL, and their cosine-free weights (N,)."""
    z, weight = np.polynomial.legendre.leggauss(rows)
    z, weight = 0.5 * (z + 1), 0.5 * weight
    phi = (np.arange(4 * rows) + 0.5) * 2 * np.pi / (4 * rows)
    zz, pp = (x.ravel() for x in np.meshgrid(z, phi, indexing="ij"))
    ring = np.sqrt(1 - zz**2)[:, None]
    world = ring * (np.cos(pp)[:, None] * TANGENT + np.sin(pp)[:, None] * BITANGENT) + zz[:, None] * NORMAL
    return world, np.repeat(weight, 4 * rows) * 2 * np.pi / (4 * rows)


@cache
def lit_hemisphere() -> tuple[F64, F64, F64]:
    """A fine hemisphere (N, 3), its weights (N,) and the studio's radiance there (N, 3)."""
    wi, weight = hemisphere(120)
    return wi, weight, light.radiance(light.studio_coefficients(), wi)


def masking(cos_o: F64 | float, cos_i: F64, width: float) -> F64:
    """Height-correlated Smith G2, in the form with tangents."""

    def fold(c: F64 | float) -> F64:
        return np.asarray(np.sqrt(1 + width**2 * (1 / np.asarray(c) ** 2 - 1)))

    return np.asarray(2 / (fold(cos_o) + fold(cos_i)))


def schlick(f0: float, c: F64) -> F64:
    return np.asarray(f0 + (1 - f0) * (1 - c) ** 5)


def specular_by_directions(f0: float, width: float, cosine: float) -> F64:
    """int F D G2 / (4 cos_o cos_i) L cos_i dw_i over the hemisphere of wi."""
    wi, weight, incident = lit_hemisphere()
    wo = eye(cosine)
    h = wi + wo
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    nh, ni, oh = h @ NORMAL, wi @ NORMAL, h @ wo
    d = width**2 / (np.pi * (nh**2 * (width**2 - 1) + 1) ** 2)
    value = schlick(f0, oh) * d * masking(cosine, ni, width) / (4 * cosine)
    return np.asarray((weight * value) @ incident)


def specular_by_normals(f0: float, width: float, cosine: float, coefficients: F64) -> F64:
    """int F G2 (wo.h) / (cos_o cos_h) L (D cos_h) dw_h, for lobes too sharp for a grid over wi.

    With tan^2 = width^2 u / (1 - u) the measure D cos_h dw_h is du dphi / 2 pi.
    """
    u, weight = np.polynomial.legendre.leggauss(48)
    phi = (np.arange(96) + 0.5) * 2 * np.pi / 96
    uu, pp = (x.ravel() for x in np.meshgrid(0.5 * (u + 1), phi, indexing="ij"))
    tan = width * np.sqrt(uu / (1 - uu))
    nh = 1 / np.sqrt(1 + tan**2)
    h = nh[:, None] * NORMAL + (tan * nh)[:, None] * (np.cos(pp)[:, None] * TANGENT + np.sin(pp)[:, None] * BITANGENT)
    wo = eye(cosine)
    oh = h @ wo
    wi = 2 * oh[:, None] * h - wo
    ni = wi @ NORMAL
    seen = (oh > 0) & (ni > 1e-9)
    value = np.zeros_like(oh)
    value[seen] = (schlick(f0, oh) * oh / (cosine * nh))[seen] * masking(cosine, ni[seen], width)
    each = np.repeat(0.5 * weight, 96) / 96
    return np.asarray((each * value) @ light.radiance(coefficients, wi))


@pytest.mark.parametrize("cosine", [1.0, 0.7, 0.25, 0.05])
@pytest.mark.parametrize("width", [0.16, 0.3, 1.0])
def test_specular_is_the_integral_over_the_hemisphere(width: float, cosine: float, table: F32) -> None:
    expected = specular_by_directions(F0, width, cosine)
    np.testing.assert_allclose(shaded(0.0, F0, width, cosine, table), expected, rtol=6e-3)


@pytest.mark.parametrize("cosine", [1.0, 0.5, 0.05])
@pytest.mark.parametrize("width", [0.001, 0.01, 0.09])
def test_sharp_specular_is_the_integral_over_normals(
    width: float, cosine: float, coefficients: F64, table: F32
) -> None:
    expected = specular_by_normals(F0, width, cosine, coefficients)
    np.testing.assert_allclose(shaded(0.0, F0, width, cosine, table), expected, rtol=6e-3)


def test_the_two_quadratures_agree(coefficients: F64) -> None:
    by_directions = specular_by_directions(F0, 0.2, 0.5)
    by_normals = specular_by_normals(F0, 0.2, 0.5, coefficients)
    np.testing.assert_allclose(by_directions, by_normals, rtol=2e-3)


def test_mirror_limit_reflects_the_light(coefficients: F64, table: F32) -> None:
    wo = eye(0.6)
    mirrored = 2 * (wo @ NORMAL) * NORMAL - wo
    expected = schlick(F0, np.array(0.6)) * light.radiance(coefficients, mirrored[None])[0]
    np.testing.assert_allclose(shaded(0.0, F0, 1e-4, 0.6, table), expected, rtol=2e-3)


def test_diffuse_is_the_cosine_weighted_mean(coefficients: F64, table: F32) -> None:
    wi, weight = hemisphere(60)
    irradiance = (weight * (wi @ NORMAL)) @ light.radiance(coefficients, wi)
    diffuse = shaded(0.8, F0, 0.2, 0.6, table) - shaded(0.0, F0, 0.2, 0.6, table)
    np.testing.assert_allclose(diffuse, 0.8 / np.pi * irradiance, rtol=2e-3)


@pytest.mark.parametrize("cosine", [1.0, 0.3, 0.02])
@pytest.mark.parametrize("width", [1e-3, 0.09, 0.3, 1.0])
def test_white_furnace_gives_back_no_more_than_it_gets(width: float, cosine: float) -> None:
    white = np.ones((6, 3, 3, 3), dtype=np.float32)
    perfect = shaded(0.0, 1.0, width, cosine, white, samples=1024)
    assert (perfect <= 1.0 + 1e-9).all()
    assert width > 0.01 or (perfect > 0.97).all(), "a mirror keeps nothing"


def test_skin_keeps_energy_up_to_75_degrees() -> None:
    """The lobes are added uncoupled, so this is a property of the materials, not of the formula."""
    white = np.ones((6, 3, 3, 3), dtype=np.float32)
    for roughness in skin.ROUGHNESS_RANGE:
        whole = shaded(float(skin.BASE.max()), skin.F0_RANGE[1], roughness**2, np.cos(np.radians(75)), white)
        assert (whole < 1.0).all()


def test_lookup_finds_every_face() -> None:
    table = brdf.cube_table(lambda w: w, 64)
    directions = np.random.default_rng(0).normal(size=(5000, 3))
    directions = np.concatenate([directions, np.eye(3), -np.eye(3), [[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0]]])
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(brdf.look_up_many(table, directions), unit, atol=3e-4)


def test_lookup_is_the_light(coefficients: F64, table: F32) -> None:
    directions = light.lat_long_directions(48).reshape(-1, 3)
    expected = light.radiance(coefficients, directions)
    np.testing.assert_allclose(brdf.look_up_many(table, directions), expected, rtol=4e-3)


def test_single_samples_add_up_to_the_fused_loop(table: F32) -> None:
    rng = np.random.default_rng(5)
    normal = rng.normal(size=(50, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    to_eye = normal + 0.5 * rng.normal(size=(50, 3))
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    albedo, f0, width, shift = rng.random((50, 3)), np.full(50, 0.04), np.full(50, 0.2), rng.random((50, 2))
    net = qmc.Sobol(2, scramble=False).random(16)
    total = np.zeros((50, 3))
    for point in net:
        diffuse, specular, weight = brdf.sample_directions(normal, to_eye, f0, width, shift, point)
        total += albedo * brdf.look_up_many(table, diffuse)
        total += weight[:, None] * brdf.look_up_many(table, specular)
    fused, _ = brdf.shade(normal, to_eye, albedo, f0, width, shift, net, table)
    np.testing.assert_allclose(total / 16, fused, rtol=1e-6)


def test_both_parts_add_up_to_the_radiance(table: F32) -> None:
    rng = np.random.default_rng(6)
    normal = np.tile([0.0, 0.0, 1.0], (20, 1))
    to_eye = normal + 0.5 * rng.normal(size=(20, 3))
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    albedo, width, shift = rng.random((20, 3)), np.full(20, 0.2), rng.random((20, 2))
    net = qmc.Sobol(2, scramble=False).random(16)

    def of(albedo: F64, f0: float) -> tuple[F64, F64]:
        return brdf.shade(normal, to_eye, albedo, np.full(20, f0), width, shift, net, table)

    whole, specular = of(albedo, 0.04)
    diffuse = whole - specular
    black, alone = of(np.zeros_like(albedo), 0.04)
    np.testing.assert_allclose(black, specular, rtol=1e-12)
    np.testing.assert_array_equal(alone, specular)
    np.testing.assert_allclose(of(2 * albedo, 0.04)[0] - whole, diffuse, rtol=1e-9)
    rim, mirror = of(albedo, 0.0), of(albedo, 1.0)
    np.testing.assert_allclose(rim[0] - rim[1], diffuse, rtol=1e-9)  # the lobes are not coupled
    assert (mirror[1] > specular).all() and (specular > rim[1]).all()
