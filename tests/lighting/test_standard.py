"""The reference renderer of the standard material against quadrature in float64, and closed forms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from support.synthetic_asset import ball

from pipeline.lighting import standard
from pipeline.lighting.median_cut import Lamps, lamps
from pipeline.maths import microfacet
from pipeline.maths.latlong import latlong_directions, latlong_weights

F64 = np.ndarray


def sky(width: int = 256) -> np.ndarray:
    """A smooth light with colour: what spherical harmonics of a low order look like."""
    w = latlong_directions(width, width // 2)
    return np.exp(w @ np.array([0.4, 1.1, 0.7]))[..., None].astype(np.float32) * np.array([1.0, 0.8, 0.6], np.float32)


def free(count: int, lit: Lamps) -> standard.Arrivals:
    """The lamps without anything in their way, at `count` vertices."""
    flux = np.broadcast_to(lit.flux, (count, *lit.flux.shape)).astype(np.float32)
    lamp = standard.table(lit)
    return standard.Arrivals(np.ascontiguousarray(flux), lamp, np.ones((count, 3), np.float32))


def ggx(n: F64, v: F64, w: F64, f0: float, alpha: float) -> np.ndarray:
    """f_s n.l of directions w (..., 3), written down again from the definitions."""
    nl, nv = np.maximum(w @ n, 0), n @ v
    h = (w + v) / np.linalg.norm(w + v, axis=-1, keepdims=True)
    nh, hv = h @ n, h @ v
    d = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)

    def shadow(c: np.ndarray) -> np.ndarray:
        c = np.maximum(c, 1e-9)
        return 0.5 * (np.sqrt(1 + alpha**2 * (1 - c**2) / c**2) - 1)

    g = 1 / (1 + shadow(nl) + shadow(np.asarray(nv)))
    fresnel = f0 + (1 - f0) * (1 - hv) ** 5
    return np.where(nl > 0, d * g * fresnel / (4 * nv), 0)


def tilted(cosine: float) -> tuple[np.ndarray, np.ndarray]:
    n = np.array([0.2, 0.3, np.sqrt(1 - 0.13)])
    across = np.cross(n, [0.0, 1.0, 0.0])
    return n, cosine * n + np.sqrt(1 - cosine**2) * across / np.linalg.norm(across)


@pytest.mark.parametrize("cosine", [1.0, 0.7, 0.35])
@pytest.mark.parametrize(("roughness", "limit"), [(0.35, 0.05), (0.5, 0.03), (0.7, 0.03)])
def test_lamps_reflect_as_quadrature_does(cosine: float, roughness: float, limit: float) -> None:
    image = sky()
    n, v = tilted(cosine)
    f0 = 0.04
    values = ggx(n, v, latlong_directions(256, 128), f0, roughness**2)
    wanted = (image.astype(np.float64) * (values * latlong_weights(256, 128))[..., None]).sum((0, 1))
    at = free(1, lamps(image, standard.COUNT))
    parts = standard.lobes(at, np.zeros(1, np.int64), n[None], v[None], np.array([roughness**2], np.float32))[0, 0]
    np.testing.assert_allclose(f0 * parts[0] + parts[1], wanted, rtol=limit)
    corner, weights = np.zeros((1, 3), np.int32), np.full((1, 3), 1 / 3, np.float32)
    base = np.full((1, 3), 0.5, np.float32)
    diffuse, specular = standard.radiance(
        at, corner, weights, n[None], v[None], base, np.array([f0], np.float32), np.array([roughness], np.float32)
    )
    np.testing.assert_allclose(specular[0], wanted, rtol=limit)
    irradiance = (image * (np.maximum(latlong_directions(256, 128) @ n, 0) * latlong_weights(256, 128))[..., None]).sum(
        (0, 1)
    )
    a, b = microfacet.split_albedo(cosine, roughness**2)
    np.testing.assert_allclose(diffuse[0], (1 - f0 * a - b) * 0.5 / np.pi * irradiance, rtol=0.01)


@pytest.mark.parametrize("cosine", [1.0, 0.7, 0.35])
def test_a_wet_surface_shows_no_dots(cosine: float) -> None:
    """A lobe that is narrower than the lamps' distance, against a fine quadrature: within a tenth of a smooth sky."""
    directions, weights = latlong_directions(2048, 1024), latlong_weights(2048, 1024)
    bright = np.exp(directions @ np.array([0.4, 1.1, 0.7])) * weights
    at, alpha = free(1, lamps(sky(), standard.COUNT)), 0.01
    for seed in range(4):
        n = np.random.default_rng(seed).normal(size=3)
        n /= np.linalg.norm(n)
        across = np.cross(n, [0.0, 1.0, 0.0])
        v = cosine * n + np.sqrt(1 - cosine**2) * across / np.linalg.norm(across)
        wanted = (bright * ggx(n, v, directions, 0.025, alpha)).sum()
        parts = standard.lobes(at, np.zeros(1, np.int64), n[None], v[None], np.array([alpha], np.float32))[0, 0, :, 0]
        assert 0.025 * parts[0] + parts[1] == pytest.approx(wanted, rel=0.1)


@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("cosine", [1.0, 0.5, 0.15])
def test_a_uniform_sky_is_reflected_as_the_layer_says(roughness: float, cosine: float) -> None:
    """In every direction: F0 a + b of the layer, which is checked by itself."""
    at = free(1, lamps(np.ones((64, 128, 3), np.float32), standard.COUNT))
    n = np.random.default_rng(0).normal(size=(200, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    across = np.cross(n, [0.3, 0.5, 0.8])
    v = cosine * n + np.sqrt(1 - cosine**2) * across / np.linalg.norm(across, axis=1, keepdims=True)
    alpha = np.float32(max(roughness**2, standard.LEAST_ALPHA))
    parts = standard.lobes(at, np.zeros(200, np.int64), n, v, alpha[None])[:, 0, :, 0]
    a, b = microfacet.split_albedo(cosine, float(alpha))
    np.testing.assert_allclose(parts[:, 0], a, rtol=0.04)  # 0.03 at the table's end, roughness 1
    np.testing.assert_allclose(parts[:, 1], b, rtol=0.03, atol=2e-4)
    corner, weights = np.zeros((200, 3), np.int32), np.full((200, 3), 1 / 3, np.float32)
    values = (np.ones((200, 3), np.float32), np.full(200, 0.04, np.float32), np.full(200, roughness, np.float32))
    shown = standard.radiance(at, corner, weights, n, v, *values)[1]
    np.testing.assert_allclose(shown[:, 1], 0.04 * parts[:, 0] + parts[:, 1], rtol=1e-4)


def test_without_a_layer_there_is_no_rim() -> None:
    n, v = tilted(0.1)
    at = free(1, lamps(sky(64), 64))
    corner, weights = np.zeros((1, 3), np.int32), np.full((1, 3), 1 / 3, np.float32)
    base, none = np.ones((1, 3), np.float32), np.zeros(1, np.float32)
    diffuse, specular = standard.radiance(at, corner, weights, n[None], v[None], base, none, none + 0.5)
    assert (specular == 0).all()
    whole = (np.maximum(at.lamp[:3].T @ n, 0)[:, None] * at.flux[0]).sum(0) / np.pi
    np.testing.assert_allclose(diffuse[0], whole, rtol=1e-4)


def test_everything_is_finite_at_the_ends() -> None:
    at = free(4, lamps(sky(64), 64))
    n = np.array([[0.0, 0, 1]] * 4)
    v = np.array([[0.0, 0, 1], [1, 0, 1e-9], [1, 0, 0], [0, 1, -1e-3]])
    corner, weights = np.zeros((4, 3), np.int32), np.full((4, 3), 1 / 3, np.float32)
    base = np.ones((4, 3), np.float32)
    for f0 in (0.0, 1e-6, 1.0):
        for roughness in (0.0, 1e-3, 1.0):
            values = (np.full(4, f0, np.float32), np.full(4, roughness, np.float32))
            found = standard.radiance(at, corner, weights, n, v, base, *values)
            assert all(np.isfinite(x).all() and (x >= 0).all() for x in found)


def test_a_layer_keeps_what_microfacets_reflect() -> None:
    cosine, alpha = np.array([0.05, 0.3, 0.9, 1.0]), np.array([0.05, 0.2, 0.36, 0.8])
    a, b = microfacet.split_albedo(cosine, alpha)
    np.testing.assert_allclose(standard.layer(cosine, np.full(4, 0.03), alpha), 0.03 * a + b, rtol=0.05)


@pytest.mark.parametrize("f0", [0.04, 0.5, 0.95])
@pytest.mark.parametrize("cosine", [0.9, 0.3, 0.1])
def test_a_single_sharp_lamp_reflects_by_the_formula(f0: float, cosine: float) -> None:
    """Opposite of the eye, where Schlick's rim is strongest."""
    n, v = tilted(cosine)
    w = 2 * (n @ v) * n - v
    one = np.ones((1, 1, 3), np.float32)
    at = standard.Arrivals(
        one, np.concatenate([w, [0.0, 0.0]]).astype(np.float32)[:, None], np.ones((1, 3), np.float32)
    )
    corner, weights = np.zeros((1, 3), np.int32), np.full((1, 3), 1 / 3, np.float32)
    base, values = np.zeros((1, 3), np.float32), [np.full(1, x, np.float32) for x in (f0, 0.6)]
    shown = standard.radiance(at, corner, weights, n[None], v[None], base, *values)[1]
    np.testing.assert_allclose(shown, float(ggx(n, v, w, f0, 0.36)), rtol=2e-4)


@pytest.mark.parametrize(
    ("alpha", "wanted"), [(0.5, lambda s, hv: 0.25 + s / (2 * hv**2)), (0.05, lambda s, hv: s / hv**2)]
)
def test_the_spread_of_a_lamp_widens_the_lobe(alpha: float, wanted: Callable[[float, float], float]) -> None:
    """In the mirror direction n.h = 1, so D = 1 / (pi q): its ratio to that of a point is alpha^2 / q."""
    n, v = tilted(0.8)
    w = 2 * (n @ v) * n - v
    found = []
    for spread in (0.0, 0.03):
        lamp = np.concatenate([w, [spread, 0.0]]).astype(np.float32)[:, None]
        at = standard.Arrivals(np.ones((1, 1, 3), np.float32), lamp, np.ones((1, 3), np.float32))
        found.append(
            standard.lobes(at, np.zeros(1, np.int64), n[None], v[None], np.array([alpha], np.float32))[0, 0, 0, 0]
        )
    assert found[1] / found[0] == pytest.approx(alpha**2 / wanted(0.03, 0.8), rel=1e-3)


def test_the_layers_table_is_exact_where_it_was_made_and_linear_between() -> None:
    """Entries are at the middles of SIDE intervals of the cosine and of the roughness, which is the root of alpha."""
    at = (np.array([9, 10, 20, 40, 41]) + 0.5) / standard.SIDE
    cosine, rough = (g.ravel() for g in np.meshgrid(at, at))
    a, b = microfacet.split_albedo(cosine, rough**2)
    f0 = np.full(len(a), 0.03)
    exact = 0.03 * a + b
    np.testing.assert_allclose(standard.layer(cosine, f0, rough**2), exact, rtol=1e-9)
    half = at[0] + 0.5 / standard.SIDE
    middle = standard.layer(np.full(5, half), f0[:5], at**2)
    square = exact.reshape(5, 5)  # rows of one roughness
    np.testing.assert_allclose(middle, (square[:, 0] + square[:, 1]) / 2, rtol=1e-9)


def test_light_arrives_on_a_convex_body_without_loss() -> None:
    mesh = ball(48, 24, height=1.0)
    lit = lamps(sky(64), 96)
    albedo = np.full((len(mesh["vertices"]), 3), 0.5)
    at = standard.arrivals(mesh["vertices"], mesh["normals"], mesh["faces"], lit, albedo)
    wanted = np.maximum(mesh["normals"] @ lit.directions.T, 0) @ lit.flux
    np.testing.assert_allclose(at.irradiance, wanted, rtol=0.02, atol=0.02 * wanted.max())


def test_blocked_lamps_send_what_leaves_the_wall() -> None:
    """A floor below a large black, then grey wall that faces it: a black wall takes its half of the sky away."""
    x = np.array(
        [[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1], [-90, 1, -90], [90, 1, -90], [90, 1, 90], [-90, 1, 90]]
    )
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]], np.int32)
    n = np.array([[0, 1, 0]] * 4 + [[0, -1, 0]] * 4, np.float32)
    lit = lamps(np.ones((32, 64, 3), np.float32), 128)
    dark = standard.arrivals(x.astype(np.float32), n, faces, lit, np.zeros((8, 3)))
    grey = standard.arrivals(x.astype(np.float32), n, faces, lit, np.full((8, 3), 0.5))
    up = lit.directions[:, 1] > 0.2  # steep enough to meet the wall
    assert (dark.flux[:4][:, up] == 0).all()
    leaving = 0.5 / np.pi * grey.irradiance[4:].mean(0)
    np.testing.assert_allclose(grey.flux[0][up], lit.solid[up, None] * leaving, rtol=1e-3)


def test_solid_angles_of_the_lamps_fill_the_sphere() -> None:
    assert lamps(sky(64), 50).solid.sum() == pytest.approx(4 * np.pi, rel=1e-5)


def test_observations_of_one_vertex_share_what_arrives_and_nothing_else() -> None:
    """All at once, in any order, as each alone: vertices that come again with the same normal and with another one."""
    rng = np.random.default_rng(11)
    lit, count = lamps(sky(64), 32), 40
    flux = rng.random((4, len(lit.directions), 3)).astype(np.float32)
    at = standard.Arrivals(flux, standard.table(lit), np.zeros((4, 3), np.float32))
    vertex, normals = rng.integers(0, 4, count), rng.normal(size=(2, 4, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    normal = normals[rng.integers(0, 2, count), vertex]
    wo = normal + 0.5 * normals[0, 0]
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    alphas = np.array([0.1, 0.4], np.float32)
    found = standard.lobes(at, vertex, normal, wo, alphas)
    for m in range(count):
        one = slice(m, m + 1)
        np.testing.assert_array_equal(standard.lobes(at, vertex[one], normal[one], wo[one], alphas)[0], found[m])
    assert found.min() >= 0 and found.max() > 0


@pytest.mark.parametrize(("depth", "lined", "lit_by"), [(0.005, False, 1.0), (0.2, False, 0.0), (0.005, True, 0.0)])
def test_a_rim_beneath_the_skin_has_the_skins_light_and_the_inside_of_a_mouth_none(
    depth: float, lined: bool, lit_by: float
) -> None:
    """A ball in a ball: just beneath it, deep inside, and just beneath an inner lining, as teeth behind lips."""
    outer = ball(48, 24, 1.0)
    v, n, f = outer["vertices"], outer["normals"], outer["faces"]
    radius = float(np.ptp(v[:, 0])) / 2
    middle = v.mean(0)
    shells = [(v, n, f), (middle + (v - middle) * (1 - depth * 2), n, f)]
    if lined:  # half-way, facing inwards
        shells.append((middle + (v - middle) * (1 - depth), -n, f[:, ::-1]))
    points, normals = (np.concatenate([s[k] for s in shells]).astype(np.float32) for k in (0, 1))
    faces = np.concatenate([s[2] + i * len(v) for i, s in enumerate(shells)]).astype(np.int32)
    lit = lamps(sky(), 64)
    found = standard.arrivals(points, normals, faces, lit, np.zeros((len(points), 3)))
    skin, rim = found.irradiance[: len(v)], found.irradiance[len(v) : 2 * len(v)]
    assert radius > 0 and skin.min() > 0.1
    np.testing.assert_allclose(rim, lit_by * skin, rtol=0.05, atol=0.02)
