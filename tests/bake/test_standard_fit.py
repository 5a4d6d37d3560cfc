"""The fit of base colour, F0 and roughness on a ball whose photos are rendered with known ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.synthetic_asset import ball

from pipeline.lighting import standard
from pipeline.lighting.median_cut import lamps
from pipeline.lighting.moving import MovingLight, Standpoint
from pipeline.lighting.moving_standard import MovingLamps
from pipeline.maths import sh
from pipeline.maths.latlong import latlong_directions
from pipeline.maths.light_frame import FLASH
from pipeline.meshes import Mesh
from pipeline.transforms import rigid
from stages.bake import standard_fit as fits
from stages.bake.base_colour import layers
from stages.bake.standard_observe import carried

RADIUS = 0.1


def unlit() -> Mesh:
    """A ball."""
    made = ball(40, 20, height=1.0)
    x = made["vertices"] / np.linalg.norm(made["vertices"], axis=1).max() * RADIUS
    n = x / np.linalg.norm(x, axis=1, keepdims=True)
    return Mesh(x.astype(np.float32), n.astype(np.float32), made["faces"])


def scene(
    f0: float | np.ndarray, roughness: float | np.ndarray, scale: float = 1.0
) -> tuple[Mesh, standard.Arrivals, np.ndarray, fits.Seen]:
    """A ball under a light with soft lamps, seen by 24 cameras. f0, roughness: of all vertices, or of each; scale: true
    base colour over the field's albedo."""
    mesh = unlit()
    x = mesh.vertices.astype(np.float64)
    n = x / np.linalg.norm(x, axis=1, keepdims=True)
    w = latlong_directions(64, 32)
    image = 0.1 + sum(np.exp(8 * (w @ (d / np.linalg.norm(d)) - 1)) for d in np.array([[1, 1, 1.0], [-1, 0.3, 0.6]]))
    lit = lamps(np.repeat(image[..., None], 3, -1).astype(np.float32), 128)
    albedo = np.full((len(n), 3), [0.4, 0.3, 0.2]) * (1 + 0.3 * np.sin(60 * x[:, :1]))
    at = standard.arrivals(mesh.vertices, mesh.normals, mesh.faces, lit, albedo)
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    eyes = np.stack([np.sin(turn), 0.4 * np.sin(3 * turn), np.cos(turn)], 1)
    vertex, eye = np.nonzero(n @ (eyes / np.linalg.norm(eyes, axis=1, keepdims=True)).T > 0.25)
    wo = eyes[eye] - x[vertex]
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    one = np.zeros((len(vertex), 3), np.int32) + vertex[:, None].astype(np.int32)
    third = np.full((len(vertex), 3), 1 / 3, np.float32)
    values = [np.broadcast_to(np.asarray(v, np.float32), len(n))[vertex] for v in (f0, roughness)]
    base = (scale * albedo[vertex]).astype(np.float32)
    diffuse, specular = standard.radiance(at, one, third, n[vertex], wo, base, *values)
    return mesh, at, albedo, fits.Seen(vertex, wo, diffuse + specular, diffuse + specular)


def fitted(f0: float, roughness: float, *, skin: bool, scale: float = 1.0) -> fits.Fitted:
    mesh, at, albedo, seen = scene(f0, roughness, scale)
    return fits.fit(mesh, mesh.normals.astype(np.float64), at, albedo, seen, np.full(len(albedo), skin))


@pytest.mark.parametrize(("f0", "roughness", "limit"), [(0.03, 0.45, 0.05), (0.09, 0.45, 0.05), (0.05, 0.6, 0.18)])
def test_an_objects_material_is_found(f0: float, roughness: float, limit: float) -> None:
    """A rough layer's wide lobe is nearly a part of the diffuse light: its F0 is less certain."""
    found = fitted(f0, roughness, skin=False, scale=1.1)
    assert np.median(found.f0) == pytest.approx(f0, rel=limit)
    assert np.median(found.roughness) == pytest.approx(roughness, abs=0.06)
    assert np.median(found.correction) == pytest.approx(1.1, rel=0.03)


def test_a_third_of_the_vertices_tells_f0_and_all_tell_the_albedo() -> None:
    """Base colours that differ from the field's by a wave that only all vertices together show."""
    mesh, at, albedo, seen = scene(0.04, 0.45)
    wave = 1 + 0.2 * np.sin(120 * mesh.vertices[:, 0])[:, None]
    n, asked = mesh.normals.astype(np.float64), np.arange(len(albedo)) % 3 == 0
    skin = np.zeros(len(albedo), bool)
    whole, some = (fits.fit(mesh, n, at, albedo / wave, seen, skin, asked=a) for a in (None, asked))
    assert np.median(some.f0) == pytest.approx(0.04, rel=0.06)
    assert np.median(some.roughness) == pytest.approx(np.median(whole.roughness), abs=0.02)
    np.testing.assert_allclose(some.correction, whole.correction, rtol=0.01)
    assert np.corrcoef(some.correction[:, 0], wave[:, 0])[0, 1] > 0.95


def test_the_albedo_of_skin_keeps_a_part_of_the_fit_s(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos that are 1.5 times too bright for the exported light: other things follow them, skin three quarters."""
    mesh, at, albedo, seen = scene(0.0, 0.45, scale=1.5)
    skin, n = mesh.vertices[:, 0] > 0, mesh.normals.astype(np.float64)
    found = fits.fit(mesh, n, at, albedo, seen, skin).correction
    monkeypatch.setattr(fits, "FIELD", 0.0)
    photos = fits.fit(mesh, n, at, albedo, seen, skin).correction
    assert np.median(photos[skin]) > 1.3
    np.testing.assert_allclose(found[skin] - 1, 0.75 * (photos[skin] - 1), atol=1e-5)
    np.testing.assert_array_equal(found[~skin], photos[~skin])


def test_black_is_corrected_as_much_as_white() -> None:
    """Without a pull that follows the albedo, black hair beside skin kept the error of the field."""
    mesh, at, albedo, seen = scene(0.0, 0.45, scale=1.5)
    dark = mesh.vertices[:, 0] > 0
    colour = np.where(dark[seen.vertex, None], 0.004, 1.0) * seen.colour
    albedo = np.where(dark[:, None], 0.004, 1.0) * albedo
    seen = fits.Seen(seen.vertex, seen.wo, colour, colour)
    found = fits.fit(mesh, mesh.normals.astype(np.float64), at, albedo, seen, np.zeros(len(albedo), bool))
    inside = mesh.vertices[:, 0] > 0.3 * RADIUS  # the pooling crosses the edge
    assert np.median(found.correction[inside]) == pytest.approx(1.5, rel=0.03)


def test_skin_stays_skin() -> None:
    """Metal labelled as skin is at the range's upper end; within the range the photos decide."""
    assert fitted(0.5, 0.45, skin=True).figures["gloss_skin_f0"] < 2 * fits.SKIN_RANGE[1]
    assert np.median(fitted(0.036, 0.45, skin=True).f0) == pytest.approx(0.036, rel=0.15)


def test_where_nothing_shines_objects_have_no_layer_and_skin_is_as_usual() -> None:
    dull = fitted(0.0, 0.5, skin=False)
    assert (dull.f0 == 0).all()
    np.testing.assert_allclose(np.median(dull.correction), 1, rtol=0.01)
    np.testing.assert_allclose(fitted(0.0, 0.5, skin=True).f0, fits.USUAL_F0, rtol=1e-2)


def test_an_object_that_photos_hardly_tell_has_a_matt_layer() -> None:
    """No bone or stone has F0 0. A layer as rough as can be is nearly diffuse light: noise hides it."""
    mesh, at, albedo, seen = scene(0.0, 0.5)
    noisy = seen.colour * (1 + 0.3 * np.random.default_rng(0).standard_normal(seen.colour.shape))
    n, none = mesh.normals.astype(np.float64), np.zeros(len(albedo), bool)
    found = fits.fit(mesh, n, at, albedo, fits.Seen(seen.vertex, seen.wo, noisy, seen.colour), none)
    np.testing.assert_allclose(found.f0, fits.ASSUMED_F0, rtol=1e-3)
    assert found.figures["gloss_rest_assumed"] == 1 and found.roughness.min() > 0.7


def test_a_layer_that_its_rim_alone_tells_is_not_lost() -> None:
    """A layer whose highlights are missing, as where a light is drawn too soft, has F0 0 by the regression. Photos that
    are certain keep it; in noisy ones it is the least of a dielectric, and only its roughness counts as measured."""
    mesh, at, albedo, seen = scene(1e-4, 0.45)
    n, none = mesh.normals.astype(np.float64), np.zeros(len(albedo), bool)
    noise = np.random.default_rng(0).standard_normal(seen.colour.shape)

    def noisy(much: float) -> fits.Fitted:
        return fits.fit(mesh, n, at, albedo, replace(seen, colour=seen.colour + much * noise), none)

    certain, doubtful = noisy(0.0), noisy(0.02)
    assert certain.f0.max() < 3e-4 and doubtful.figures["gloss_rest_explained"] > fits.MIN_EXPLAINED
    np.testing.assert_allclose(doubtful.f0, fits.LEAST_F0, rtol=0.02)
    assert np.median(doubtful.roughness) == pytest.approx(0.45, abs=0.02)
    assert doubtful.measured[:, 0].max() < 0.05 and doubtful.measured[:, 1].max() > 0.5


def test_a_glossy_half_is_found() -> None:
    """F0 and roughness of two halves of one material, each by itself and both as on skin. Where a higher F0 goes with a
    higher roughness, the highlights of a soft light hardly change, and nothing would be found."""
    left = unlit().vertices[:, 0] > 0
    for shine, sharp in ((0.4, 0.0), (0.0, 0.06), (0.3, 0.05)):
        f0, roughness = 0.04 * (1 + shine * (left - 0.5)), 0.48 - sharp * (2 * left - 1)
        mesh, at, albedo, seen = scene(f0, roughness)
        n, none = mesh.normals.astype(np.float64), np.zeros(len(albedo), bool)
        found = fits.fit(mesh, n, at, albedo, seen, none)
        inside = np.abs(mesh.vertices[:, 0]) > 0.4 * RADIUS
        for got, true, size in ((found.f0, f0, 0.005), (found.roughness, roughness, 0.02)):
            step, wanted = (np.median(v[inside & left]) - np.median(v[inside & ~left]) for v in (got, true))
            assert step == pytest.approx(wanted, abs=max(0.6 * abs(wanted), size))


def test_skin_whose_photos_contradict_a_layer_is_as_usual() -> None:
    """Errors of the light can make highlights darker than their surroundings: F0 below 0 is no F0."""
    mesh, at, albedo, seen = scene(0.0, 0.5)
    dark = 2 * seen.colour - scene(0.03, 0.45)[3].colour
    n, skin = mesh.normals.astype(np.float64), np.ones(len(albedo), bool)
    found = fits.fit(mesh, n, at, albedo, fits.Seen(seen.vertex, seen.wo, dark, dark), skin)
    np.testing.assert_allclose(found.f0, fits.USUAL_F0, rtol=1e-2)


def darker(share: float) -> tuple[fits.Fitted, float]:
    """Hair that varies with the view as a layer of keratin does, and reflects this share of what such a layer does:
    its material, and the ratio of what it reflects to what the photos show, where they look at it straight on."""
    mesh, at, albedo, seen = scene(0.046, 0.7)
    bare = scene(0.0, 0.7)[3].colour
    layer = seen.colour - bare
    n, hair = mesh.normals.astype(np.float64), np.ones(len(albedo), bool)
    facing = (n[seen.vertex] * seen.wo).sum(1) > fits.FACING
    total = [np.bincount(seen.vertex, facing * z.mean(1), len(albedo)) for z in (layer, bare)]
    whole = total[0] / np.maximum(total[1], 1e-9)
    dark = np.maximum(layer - (1 - share) * whole[seen.vertex, None] * bare, 0)
    colour = np.maximum(albedo * share * whole[:, None], 1e-6)  # as the field has it: all of it is albedo
    observed = fits.Seen(seen.vertex, seen.wo, dark, dark)
    found = fits.fit(mesh, n, at, colour, observed, ~hair, hair=hair)
    lit = fits.under_dome(at, n, observed)
    of = layers(n, observed, lit, found.f0.astype(float), found.roughness.astype(float))
    base = (found.correction * colour)[seen.vertex] * lit.shade
    shown = found.f0[seen.vertex, None] * of.mirror + of.rim + base
    return found, shown[facing].sum() / max(dark[facing].sum(), 1e-9)


def test_black_hair_is_no_brighter_than_its_photos() -> None:
    """What varies with the view alone gives F0 .046; with that, half of the layer would be twice as bright."""
    f0 = []
    for share in (0.5, 1.0, 2.0, 3.0):
        found, ratio = darker(share)
        assert found.figures["gloss_hair_explained"] > 0.3
        assert np.ptp(found.f0) < 1e-3  # one for all of it
        assert ratio == pytest.approx(1, abs=0.15)
        f0.append(float(found.f0.mean()))
    assert f0 == sorted(f0) and f0[0] < 0.01 and f0[-1] > 0.035


@pytest.mark.parametrize("share", [0.0, 1e-3])
def test_hair_that_reflects_nothing_has_no_layer(share: float) -> None:
    assert (darker(share)[0].f0 < 0.002).all()


def test_an_object_of_no_dielectric_is_refused() -> None:
    """As a flash on the camera makes one: the lobe's material is kept then. Beside skin, the rest only has no layer."""
    found = fitted(0.4, 0.45, skin=False)
    assert not found.plausible and found.figures["gloss_rest_refused_f0"] == pytest.approx(0.4, rel=0.15)
    mesh, at, albedo, seen = scene(0.4, 0.45)
    half = mesh.vertices[:, 0] > 0
    mixed = fits.fit(mesh, mesh.normals.astype(np.float64), at, albedo, seen, half)
    assert mixed.plausible and (mixed.f0[mesh.vertices[:, 0] < -0.05] == 0).all()


def test_without_photos_the_prior_is_all() -> None:
    mesh, at, albedo, seen = scene(0.04, 0.45)
    none = fits.Seen(seen.vertex[:0], seen.wo[:0], seen.colour[:0], seen.predicted[:0])
    n = mesh.normals.astype(np.float64)
    for skin, wanted in ((True, fits.USUAL_F0), (False, 0.0)):
        found = fits.fit(mesh, n, at, albedo, none, np.full(len(albedo), skin))
        np.testing.assert_allclose(found.f0, wanted, rtol=1e-3)
        np.testing.assert_allclose(found.correction, 1, rtol=1e-3)


def test_an_objects_material_is_found_under_a_flash() -> None:
    """Photos by a lamp beside the lens: each has its own irradiance, so that what arrives is given by observation."""
    made = ball(40, 20, height=1.0)
    x = made["vertices"] / np.linalg.norm(made["vertices"], axis=1).max() * RADIUS
    n = (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float64)
    mesh = Mesh(x.astype(np.float32), n.astype(np.float32), made["faces"])
    degree = np.sqrt(np.arange(121)).astype(int)
    d = torch.tensor([[0.0, -0.15, -1.0]], dtype=torch.float64)
    c = sh.sh_basis(d / d.norm(), 10).numpy()[0] * np.exp(-degree * (degree + 1) * 0.03)
    light = MovingLight(FLASH, 0.8, np.repeat(c[:, None], 3, 1).astype(np.float32), np.full((1, 3), 0.1, np.float32))
    lamps_ = MovingLamps(light)
    albedo = np.full((len(n), 3), [0.4, 0.3, 0.2]) * (1 + 0.3 * np.sin(60 * x[:, :1]))
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    parts, poses = [], []
    for k, a in enumerate(turn):
        centre = np.array([np.sin(a), 0.4 * np.sin(3 * a), np.cos(a)])
        z = -centre / np.linalg.norm(centre)
        right = np.cross(z, [0, 1.0, 0])
        right /= np.linalg.norm(right)
        poses.append(rigid(np.stack([right, np.cross(z, right), z], 1), centre))
        wo = centre - x
        wo /= np.linalg.norm(wo, axis=1, keepdims=True)
        rows = np.flatnonzero((n * wo).sum(1) > 0.25)
        f0, rough = (np.full(len(rows), v, np.float32) for v in (0.05, 0.45))
        base = (1.1 * albedo[rows]).astype(np.float32)
        shown = lamps_.radiance(mesh.vertices[rows], mesh.normals[rows], Standpoint.of(poses[-1]), base, f0, rough)
        parts.append((rows, wo[rows], shown, np.full(len(rows), k)))
    vertex, wo, colour, view = (np.concatenate([p[i] for p in parts]) for i in range(4))
    seen = fits.Seen(vertex, wo, colour, colour)
    lit = carried(light, light.still(), mesh, n, seen, view, poses, lambda: None)
    found = fits.fit(mesh, n, lit, albedo, seen, np.zeros(len(n), bool))
    well = np.abs(n[:, 1]) < 0.5
    assert np.median(found.f0[well]) == pytest.approx(0.05, rel=0.15)
    assert np.median(found.roughness) == pytest.approx(0.45, abs=0.06)
    assert np.median(found.correction[well]) == pytest.approx(1.1, rel=0.03)


def test_hair_is_matt() -> None:
    """Shine like metal's is keratin's at most; without shine there is no layer; what is labelled skin is hair too."""
    for f0, wanted in ((0.5, fits.HAIR_RANGE[1]), (0.035, 0.035), (0.0, 0.0)):
        mesh, at, albedo, seen = scene(f0, 0.6)
        every = np.ones(len(albedo), bool)
        found = fits.fit(mesh, mesh.normals.astype(np.float64), at, albedo, seen, every, hair=every)
        assert found.f0.max() <= fits.HAIR_RANGE[1] + 1e-6 and found.plausible
        assert np.median(found.f0) == pytest.approx(wanted, rel=0.2, abs=1e-9)  # a rougher lobe needs more
        assert np.median(found.roughness) > 0.55 and "gloss_skin_f0" not in found.figures
    assert np.median(found.roughness) == pytest.approx(fits.HAIR_ROUGHNESS, abs=1e-3)


def test_places_that_few_photos_see_do_not_tell_the_material() -> None:
    """One side is seen by three photos only, in which it shines as metal does: the same as if nobody had seen it."""
    mesh, at, albedo, seen = scene(0.04, 0.45)
    shown = scene(0.5, 0.45)[3].colour
    order = np.arange(len(seen.vertex)) - np.searchsorted(seen.vertex, seen.vertex)
    side = mesh.vertices[seen.vertex, 0] > 0
    few, other = side & (order < fits.MIN_VIEWS - 1), ~side
    material = []
    for keep in (few | other, other):
        colour = np.where(side[:, None], shown, seen.colour)[keep]
        some = fits.Seen(seen.vertex[keep], seen.wo[keep], colour, colour)
        made = fits.fit(mesh, mesh.normals.astype(np.float64), at, albedo, some, np.zeros(len(albedo), bool))
        material.append((made.f0, made.roughness))
    for with_few, without in zip(*material, strict=True):
        np.testing.assert_allclose(with_few, without, rtol=1e-3)
    assert np.median(material[0][0]) == pytest.approx(0.04, rel=0.2)


@pytest.mark.parametrize("wrong", [1.3, 0.7])
def test_photos_at_grazing_angles_do_not_tell_the_albedo(wrong: float) -> None:
    """Within a fifth of the horizon a photo mixes the surface with what lies behind it."""
    mesh, at, albedo, seen = scene(0.04, 0.45)
    n = mesh.normals.astype(np.float64)
    flat = (n[seen.vertex] * seen.wo).sum(1) < 0.3
    turned = seen.wo[flat] - (0.3 - fits.GRAZING + 0.02) * n[seen.vertex[flat]]
    wo = seen.wo.copy()
    wo[flat] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    assert ((n[seen.vertex[flat]] * wo[flat]).sum(1) < fits.GRAZING).all() and flat.sum() > 1000
    colour = np.where(flat[:, None], wrong, 1.0) * seen.colour
    some = fits.Seen(seen.vertex, wo, colour, colour)
    found = fits.fit(mesh, n, at, albedo, some, np.zeros(len(albedo), bool))
    keep = ~flat
    clean = fits.Seen(seen.vertex[keep], seen.wo[keep], seen.colour[keep], seen.colour[keep])
    wanted = fits.fit(mesh, n, at, albedo, clean, np.zeros(len(albedo), bool))
    np.testing.assert_allclose(found.correction, wanted.correction, rtol=2e-3)
    np.testing.assert_allclose(found.f0, wanted.f0, rtol=0.02, atol=1e-4)


def in_pairs(f0: float | np.ndarray, roughness: float | np.ndarray) -> tuple:
    """The ball in polarised pairs: base and mirror reflection apart."""
    mesh, at, albedo, seen = scene(f0, roughness)
    n, v = mesh.normals.astype(np.float64), seen.vertex
    one = np.zeros((len(v), 3), np.int32) + v[:, None].astype(np.int32)
    third = np.full((len(v), 3), 1 / 3, np.float32)
    values = [np.broadcast_to(np.asarray(x, np.float32), len(n))[v] for x in (f0, roughness)]
    base, mirror = standard.radiance(at, one, third, n[v], seen.wo, albedo[v].astype(np.float32), *values)
    return mesh, at, albedo, fits.Seen(v, seen.wo, base, base, mirror.astype(np.float64))


@pytest.mark.parametrize(("f0", "roughness"), [(0.03, 0.45), (0.08, 0.6), (0.04, 0.3)])
def test_polarised_pairs_tell_the_layer_and_the_base(f0: float, roughness: float) -> None:
    mesh, at, albedo, seen = in_pairs(f0, roughness)
    found = fits.fit(mesh, mesh.normals.astype(np.float64), at, albedo, seen, np.zeros(len(albedo), bool))
    assert np.median(found.f0) == pytest.approx(f0, rel=0.05)
    assert np.median(found.roughness) == pytest.approx(roughness, abs=0.02)
    assert np.median(found.correction) == pytest.approx(1, rel=0.01)
    assert found.figures["gloss_rest_explained"] > 0.95


def test_a_wrong_base_colour_does_not_move_what_pairs_tell() -> None:
    """Texture finer than a pixel, as noise that differs from photo to photo: it is in both photos of a pair alike."""
    mesh, at, albedo, seen = in_pairs(0.035, 0.45)
    grain = 1 + 0.2 * np.random.default_rng(0).normal(size=(len(seen.vertex), 1))
    n, skin = mesh.normals.astype(np.float64), np.ones(len(albedo), bool)
    paired = fits.fit(mesh, n, at, albedo, replace(seen, colour=seen.colour * grain), skin)
    alone = fits.fit(mesh, n, at, albedo, fits.Seen(
        seen.vertex, seen.wo, seen.colour * grain + seen.mirror, seen.colour + seen.mirror), skin)  # fmt: skip
    assert np.median(paired.f0) == pytest.approx(0.035, rel=0.05)
    assert np.abs(paired.f0 - 0.035).mean() < 0.5 * np.abs(alone.f0 - 0.035).mean()


def test_pairs_that_are_not_there_do_not_count() -> None:
    mesh, at, albedo, seen = in_pairs(0.04, 0.45)
    mirror = seen.mirror.copy()
    mirror[::2] = np.nan
    found = fits.fit(mesh, mesh.normals.astype(np.float64), at, albedo, replace(seen, mirror=mirror),
                     np.zeros(len(albedo), bool))  # fmt: skip
    assert np.median(found.f0) == pytest.approx(0.04, rel=0.05) and np.isfinite(found.correction).all()


def test_pairs_without_a_mirror_reflection_have_no_layer() -> None:
    mesh, at, albedo, seen = in_pairs(0.04, 0.45)
    dark = replace(seen, mirror=np.zeros_like(seen.mirror))
    found = fits.fit(mesh, mesh.normals.astype(np.float64), at, albedo, dark, np.zeros(len(albedo), bool))
    assert (found.f0 < 0.01).all() or "gloss_rest_assumed" in found.figures


def test_pairs_tell_the_mean_of_the_reflection_and_not_only_what_changes() -> None:
    """Noise as large as what changes with the view, and far below the reflection's mean: the layer explains most."""
    mesh, at, albedo, seen = in_pairs(0.04, 0.6)
    v, count = seen.vertex, len(albedo)
    mean = np.bincount(v, seen.mirror.mean(1), count) / np.maximum(np.bincount(v, minlength=count), 1)
    changes = float(np.std(seen.mirror.mean(1) - mean[v]))
    noise = changes * np.random.default_rng(0).normal(size=seen.mirror.shape)
    found = fits.fit(mesh, mesh.normals.astype(np.float64), at, albedo, replace(seen, mirror=seen.mirror + noise),
                     np.zeros(count, bool))  # fmt: skip
    assert found.figures["gloss_rest_explained"] > 0.6
    assert np.median(found.f0) == pytest.approx(0.04, rel=0.2)
