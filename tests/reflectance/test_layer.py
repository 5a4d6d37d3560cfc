"""The material of standard shaders from single lights: samples that were made with a known layer, and its radiance."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.lighting.standard import layer as kept_back
from pipeline.meshes import Mesh
from pipeline.ray_casting import RayCaster
from stages.reflectance.bounces import Bounces
from stages.reflectance.field import Lamp
from stages.reflectance.layer import CELL, WIDTHS, Layers, lowest, pooled_errors, standard_of
from stages.reflectance.layer_kernels import layers
from stages.reflectance.openpbr import OpenPbr, reflection
from tests.reflectance.test_field import field_of
from tests.reflectance.test_reshape import globe
from tests.reflectance.test_split import Made, rig_with

F0, ROUGH = 0.035, 0.4


def written_out(f0: float, alpha: float, nl, nv, nh, vh):
    """GGX with the masking of Smith by Lambda functions, Schlick's Fresnel factor; times n.l."""
    a2 = alpha**2
    d = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    lam_l, lam_v = (0.5 * (np.sqrt(1 + a2 * (1 / np.maximum(x, 1e-3) ** 2 - 1)) - 1) for x in (nl, nv))
    fresnel = f0 + (1 - f0) * (1 - vh) ** 5
    return fresnel * d / (1 + lam_l + lam_v) / (4 * np.maximum(nl, 1e-3) * nv) * nl


def cosines(made: Made, camera: int):
    p, n = made.points.position, made.normal
    towards = made.rig.position[None] - p[:, None]
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    view = made.rig.eyes()[camera][None] - p[:, None]
    view /= np.linalg.norm(view, axis=2, keepdims=True)
    half = towards + view
    half /= np.linalg.norm(half, axis=2, keepdims=True)
    dot = lambda a: np.einsum("td,tld->tl", n, a)  # noqa: E731
    return np.maximum(dot(towards), 0), dot(view), dot(half), (view * half).sum(2)


def fitted(made: Made, table: np.ndarray, albedo: np.ndarray, lobes: float = 0.01) -> Layers:
    count, lights = len(made.normal), len(made.rig.index)
    out, lamps = Layers.empty(count), made.rig.lamps()
    layers(made.points.position, made.normal, made.pairs.first, made.pairs.camera, made.pairs.weight,
           table.astype(np.float32), np.ones((count, lights), np.float32), np.zeros((count, lights, 3), np.float32),
           *lamps, made.rig.eyes(), np.array([0.3, 0.15, 0.05]), albedo, np.full((count, 3), lobes), 5.0, WIDTHS,
           out.base, out.f0, out.error, out.facing)  # fmt: skip
    return out


def test_a_known_layer_is_found() -> None:
    made = Made(rig_with(cameras=5))
    table = np.zeros_like(made.table)
    for c in range(5):
        nl, nv, nh, vh = cosines(made, c)
        through = 1 - kept_back(nv.ravel(), np.full(nv.size, F0), np.full(nv.size, ROUGH**2)).reshape(nv.shape)
        matt = (through * nl / np.pi)[..., None] * made.albedo[:, None]
        table[c::5] = np.where(nl[..., None] > 0, matt + written_out(F0, ROUGH**2, nl, nv, nh, vh)[..., None], 0)
    found = standard_of(fitted(made, table, made.albedo), made.points.position)
    np.testing.assert_allclose(np.median(found[:, 3]), F0, rtol=0.12)
    np.testing.assert_allclose(np.median(found[:, 4]), ROUGH, rtol=0.08)
    ratio = found[:, :3] / made.albedo
    assert abs(np.median(ratio) - 1) < 0.05 and np.abs(ratio - 1).max() < 0.15


def test_a_matt_surface_has_next_to_no_layer_and_black_frames_none() -> None:
    made = Made(rig_with(), specular=0)
    found = standard_of(fitted(made, made.table, made.albedo, 0.0), made.points.position)
    assert np.median(found[:, 3]) <= 0.01
    black = standard_of(fitted(made, 0 * made.table, made.albedo), made.points.position)
    assert np.abs(black[:, :3]).max() < 1e-3 and np.isfinite(black).all()
    none = standard_of(fitted(made, np.nan * made.table, made.albedo), made.points.position)
    assert not none.any()
    assert standard_of(Layers.empty(0), np.zeros((0, 3))).shape == (0, 5)


def test_errors_are_pooled_over_what_is_near() -> None:
    """Oracle: two groups a metre apart keep their own means; within a cell all are alike."""
    rng = np.random.default_rng(0)
    position = np.concatenate([rng.uniform(0, CELL, (50, 3)), 1 + rng.uniform(0, CELL, (30, 3))])
    error = rng.random((80, 4))
    found = pooled_errors(error, position)
    for part in (slice(0, 50), slice(50, 80)):
        assert np.abs(found[part] - error[part].mean(0)).max() < 0.2
        assert np.ptp(found[part], axis=0).max() < 0.2 < np.ptp(error[part], axis=0).min()


def test_the_lowest_place_is_the_parabolas() -> None:
    x = np.arange(8.0)
    at = np.array([2.3, 4.0, 6.5, -3, 11])
    np.testing.assert_allclose(lowest((x - at[:, None]) ** 2), [2.3, 4.0, 6.5, 0, 7], atol=1e-9)
    assert np.isfinite(lowest(np.zeros((2, 8)))).all()


def test_the_radiance_is_that_of_the_page() -> None:
    """A texel of the ball in front of a lamp, by hand; the others are in shadow or dark."""
    field = field_of(np.array([0.4, 0.3, 0.2]))
    count = len(field.known)
    field.arrays["openpbr"] = np.tile(np.float32([0.5, 0.4, 0.3, F0, ROUGH]), (count, 1))
    made, eye = OpenPbr.of(field), np.array([0.2, 0.1, 1.0])
    lamp = Lamp(np.array([0.3, 0.5, 1.2]), -np.array([0.3, 0.5, 1.2]) / np.sqrt(1.78), np.array([4.0, 3, 2]))
    arrives = made.arrives(lamp)
    found = made.radiance(lamp, eye, arrives)
    best = int((made.normal @ np.array([0.2, 0.3, 1])).argmax())
    p, n = made.points.position[best], made.normal[best]
    to, v = lamp.position - p, eye - p
    d2 = to @ to
    to, v = to / np.sqrt(d2), v / np.linalg.norm(v)
    h = (to + v) / np.linalg.norm(to + v)
    shine = written_out(F0, ROUGH**2, n @ to, n @ v, n @ h, v @ h)
    through = 1 - kept_back(np.array([n @ v]), np.array([F0]), np.array([ROUGH**2]))[0]
    expected = (
        (through * np.array([0.5, 0.4, 0.3]) / np.pi * (n @ to) + shine) * (-(to @ lamp.axis)) / d2 * lamp.strength
    )
    np.testing.assert_allclose(found[best], expected, rtol=1e-4)
    assert arrives[best] == 1 and not found[made.normal @ to < -0.3].any()


def test_no_layer_reflects_nothing() -> None:
    one = np.ones(1)
    assert reflection(0 * one, 0.1 * one, one, one, one, 0.5 * one)[0] == 0
    mirror = reflection(one, 0.1 * one, one, one, one, one)[0]
    assert mirror == pytest.approx(1 / (4 * np.pi * 0.1**2), rel=1e-6)  # D of the mirror direction, G and F of 1


def test_light_bounces_inside_a_hollow_ball_as_a_series_says() -> None:
    """Every ray inside ends on the ball: E (a + a^2 + a^3) arrives by way of others. On its outside none does."""
    outer = globe(4)
    inner = Mesh(outer.vertices, -outer.normals, np.ascontiguousarray(outer.faces[:, ::-1]))
    albedo, direct = np.tile([0.5, 0.2, 0.0], (len(outer.vertices), 1)), np.ones((len(outer.vertices), 3))
    found = Bounces(inner, RayCaster(inner.vertices, inner.faces), albedo).of(direct)
    np.testing.assert_allclose(found, np.tile([0.875, 0.248, 0], (len(found), 1)), rtol=1e-6)
    assert not Bounces(outer, RayCaster(outer.vertices, outer.faces), albedo).of(direct).any()


def test_only_what_cameras_saw_throws_shadows_if_it_is_asked() -> None:
    field = field_of(np.array([0.4, 0.3, 0.2]))
    field.arrays["coverage"] = np.zeros_like(field.arrays["coverage"])
    rays = np.tile([0.0, 0, -1], (100, 1))
    start = np.random.default_rng(0).uniform(-0.05, 0.05, (100, 3)) * [1, 1, 0] + [0, 0, 1]
    hits = [(OpenPbr.of(field, trimmed=t).shadows.first_faces(start, rays) >= 0).sum() for t in (True, False)]
    assert hits[1] == 100 and hits[0] < 20  # faces without a texel throw shadows all the same
