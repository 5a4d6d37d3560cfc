"""Lamps, shadows, bounces and the relit asset against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from support.render_stand_ins import asset, fine_ball, sphere_points
from support.synthetic_asset import RADIUS, ball

from pipeline.errors import StageError
from pipeline.lighting.median_cut import Lamps, checked_environment, lamps
from pipeline.lighting.transport import DARKEST, Transport, occlusion
from pipeline.maths.ggx_width import KAPPA_RANGE
from pipeline.maths.latlong import latlong_directions, latlong_weights
from stages.usd.render.camera import orbit_camera
from stages.usd.render.relight import Environment, table_of
from stages.usd.render.render import Renderer, kernels
from stages.usd.write.maps import vertex_image


def sky(width: int = 64) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.2, 1, (width // 2, width, 3)).astype(np.float32)


@pytest.mark.parametrize("count", [1, 7, 200])
def test_lamps_carry_all_the_light(count: int) -> None:
    found, image = lamps(sky(), count), sky()
    assert len(found.flux) == count
    np.testing.assert_allclose(found.flux.sum(0), (image * latlong_weights(64, 32)[..., None]).sum((0, 1)), rtol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(found.directions, axis=1), 1, atol=1e-5)


def test_lamps_irradiance_is_the_pictures() -> None:
    image = sky(128)
    n = latlong_directions(8, 4).reshape(-1, 3)
    cosine = np.maximum(np.einsum("ni,hwi->nhw", n, latlong_directions(128, 64)), 0)
    wanted = np.einsum("nhw,hwc,h->nc", cosine, image.astype(np.float64), latlong_weights(128, 64)[:, 0])
    found = lamps(image, 384)
    np.testing.assert_allclose(np.maximum(n @ found.directions.T, 0) @ found.flux, wanted, rtol=0.01)


def test_a_sun_becomes_a_lamp_of_its_own() -> None:
    image = np.full((64, 128, 3), 0.01, np.float32)
    image[20, 70] = 5000
    found = lamps(image, 40)
    k = int(found.flux[:, 0].argmax())
    assert found.directions[k] @ latlong_directions(128, 64)[20, 70] > 0.9999
    assert found.spread[k] < 1e-3 < np.median(found.spread)


@pytest.mark.parametrize(
    "image", [np.zeros((8, 16, 3)), np.full((8, 16, 3), -1.0), np.full((8, 16, 3), np.nan), np.ones((8, 8, 3))]
)
def test_unusable_lights_are_refused(image: np.ndarray) -> None:
    with pytest.raises(StageError, match="environment map can't be used"):
        checked_environment(image.astype(np.float32), "x.exr")


def test_infinite_suns_are_bounded() -> None:
    image = np.ones((8, 16, 3), np.float32)
    image[2, 3] = np.inf
    found, bounded = lamps(checked_environment(image, "x.hdr"), 20), np.ones((8, 16, 3), np.float32)
    bounded[2, 3] = 65504  # what 16 bits hold
    whole = (bounded * latlong_weights(16, 8)[..., None]).sum((0, 1))
    np.testing.assert_allclose(found.flux.sum(0), whole, rtol=1e-4)
    assert found.directions[found.flux[:, 0].argmax()] @ latlong_directions(16, 8)[2, 3] > 0.999


def test_a_bright_window_leaves_lamps_to_the_dim_sky() -> None:
    """Nearly all of the light comes from a two-hundredth of the sphere; half of the cuts are of the rest."""
    image = np.full((64, 128, 3), 1e-3, np.float32)
    image[28:36, 60:68] = 100.0
    found = lamps(image, 64)
    dim = found.flux[:, 1] / found.solid < 1
    assert 20 <= dim.sum() <= 44 and found.solid[dim].max() < 0.1 * 4 * np.pi
    assert found.flux[~dim].sum() > 0.95 * found.flux.sum() and found.solid[~dim].sum() < 0.1 * 4 * np.pi


def test_nothing_is_in_the_way_on_a_convex_body() -> None:
    mesh = ball(48, 24, height=1.0)
    transport = Transport(mesh["vertices"], mesh["normals"], mesh["faces"])
    found = lamps(sky(), 64)
    seen = transport.visibility(found.directions)
    facing = transport.normals @ found.directions.T > 0.1
    assert seen[facing].mean() > 0.999
    assert transport.indirect(np.ones((len(transport.normals), 3)), np.ones((len(transport.normals), 3))).max() < 0.01


def bowl(columns: int = 96, rings: int = 48) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The lower half of a sphere seen from inside: vertices, inward normals, faces."""
    polar = np.linspace(1e-3, np.pi / 2, rings)
    turn = 2 * np.pi * np.arange(columns) / columns
    p, t = np.meshgrid(polar, turn, indexing="ij")
    out = np.stack([np.sin(p) * np.cos(t), -np.cos(p), np.sin(p) * np.sin(t)], -1).reshape(-1, 3)
    at = lambda r, c: r * columns + c % columns  # noqa: E731
    faces = []
    for r in range(rings - 1):
        for c in range(columns):
            faces += [[at(r, c), at(r + 1, c), at(r + 1, c + 1)], [at(r, c), at(r + 1, c + 1), at(r, c + 1)]]
    return out.astype(np.float32), (-out).astype(np.float32), np.array(faces, np.int32)


@pytest.mark.parametrize(("columns", "off"), [(32, 2.0), pytest.param(96, 1.0, marks=pytest.mark.slow)])
def test_a_bowl_sees_half_the_sky_and_throws_light_back(columns: int, off: float) -> None:
    """Within a sphere every place sees every other alike, so that each place of a half sphere sees the opening with
    half its cosine-weighted directions: D = E / 2, and k bounces give D (a / 2)^k. off: of a bowl with large facets."""
    vertices, normals, faces = bowl(columns, columns // 2)
    transport = Transport(vertices, normals, faces)
    found = lamps(np.ones((64, 128, 3), np.float32), 384)
    direct = transport.direct(transport.visibility(found.directions), found.directions, found.flux)
    inner = slice(0, columns * columns * 5 // 12)  # the rim's own vertices are half outside
    assert direct[inner].mean() == pytest.approx(np.pi / 2, rel=0.02 * off)
    albedo = 0.6
    bounced = transport.indirect(np.full_like(direct, np.pi / 2), np.full_like(direct, albedo))
    wanted = np.pi / 2 * sum((albedo / 2) ** k for k in range(1, 5))
    assert bounced[inner].mean() == pytest.approx(wanted, rel=0.03 * off)
    share = occlusion(transport, found, np.full_like(direct, np.pi), np.full_like(direct, 0.3), lambda: None)
    true = 0.3 / share[inner].mean()  # the albedo whose bowl looks like 0.3 in the open: a (1/2) / (1 - a/2) = 0.3
    assert true * 0.5 / (1 - true / 2) == pytest.approx(0.3, rel=0.04 * off)
    assert share.min() >= DARKEST


def test_compiled_lamps_are_the_formula() -> None:
    rng = np.random.default_rng(5)
    unit = lambda x: (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)  # noqa: E731
    n, m = unit(rng.normal(size=(50, 3))), unit(rng.normal(size=(50, 3)))
    s = rng.uniform(1 / KAPPA_RANGE[1], 1 / KAPPA_RANGE[0], 50).astype(np.float32)
    corner = rng.integers(0, 9, (50, 3)).astype(np.int32)
    w = rng.dirichlet(np.ones(3), 50).astype(np.float32)
    seen = rng.integers(0, 2, (9, 30)).astype(np.uint8)
    d, flux, spread = unit(rng.normal(size=(30, 3))), rng.uniform(0, 1, (30, 3)), rng.uniform(0, 0.02, 30)
    diffuse, specular = np.empty((50, 3), np.float32), np.empty((50, 3), np.float32)
    lit = Lamps(d, flux.astype(np.float32), spread.astype(np.float32), np.zeros(30, np.float32))
    kernels.under_lamps(n, m, s, corner, w, seen, table_of(lit), diffuse, specular)
    share = (w[:, :, None] * seen[corner]).sum(1)
    np.testing.assert_allclose(diffuse, (share * np.maximum(n @ d.T, 0)) @ flux, rtol=1e-3, atol=1e-5)
    kappa = 1 / (s[:, None] + spread)
    lobe = kappa / (2 * np.pi * (1 - np.exp(-2 / s[:, None]))) * np.exp(kappa * (m @ d.T - 1))
    np.testing.assert_allclose(specular, (share * lobe) @ flux, rtol=0.03, atol=2e-3)


@pytest.mark.slow
def test_a_ball_in_even_light_is_its_albedo_and_its_lobe() -> None:
    """Radiance 1 from everywhere: a / pi * pi + rho c . B."""
    made = asset(coefficients=np.full((8, 8, 1), 0.1, np.float32), inv_kappa=np.full((8, 8, 1), 0.1, np.float32))
    renderer = Renderer(made)
    light = Environment(renderer, np.ones((32, 64, 3), np.float32), "even", 512)
    view = orbit_camera(RADIUS, 0.4, 48)
    image = renderer.render(view, samples=1, light=light)
    facing = sphere_points(view, 48)[2]
    # lobes that reach below the horizon lose what the ball itself blocks there; the middle does not
    middle = facing & (np.hypot(*(np.mgrid[:48, :48] - 23.5)) < 10)
    np.testing.assert_allclose(image[middle][:, :3], 0.4 + 0.1, rtol=0.03)


def test_a_sun_lights_by_the_cosine_and_leaves_the_other_side_dark() -> None:
    image = np.zeros((64, 128, 3), np.float32)
    image[32, 64] = 1000.0
    sun, flux = latlong_directions(128, 64)[32, 64], 1000 * latlong_weights(128, 64)[32, 0]
    renderer = Renderer(asset())
    light = Environment(renderer, image, "sun", 8)
    for azimuth in (0.0, np.pi):
        view = orbit_camera(RADIUS, azimuth, 48)
        shown = renderer.render(view, samples=1, light=light)
        n, _, inside = sphere_points(view, 48)
        wanted = 0.4 / np.pi * flux * np.maximum(n @ sun, 0)
        clear = inside & (np.abs(n @ sun) > 0.1)
        np.testing.assert_allclose(shown[clear][:, 0], wanted[clear], rtol=0.03, atol=2e-3)


def test_vertex_values_fill_the_texture() -> None:
    mesh = fine_ball()
    image = vertex_image(mesh, mesh.vertices.astype(np.float64), 128)
    assert image.shape == (128, 128, 3)
    v, u = 1 - (np.arange(128) + 0.5) / 128, (np.arange(128) + 0.5) / 128
    polar = np.pi * ((v - 0.02) / 0.96 - 0.5)
    wanted = RADIUS * np.sin(polar)[10:118, None] * np.ones((1, len(u)))
    np.testing.assert_allclose(image[10:118, :, 1], wanted, atol=2e-3)
