"""Albedo where photos show the surface badly or not at all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.images import write_png
from pipeline.meshes import Mesh
from pipeline.registration.head_regions import (
    BAND_HEIGHT,
    BANDS,
    CLEAR_OF,
    FIRST_BAND,
    FIRST_BEHIND,
    HAIR,
    PARTED,
    REGIONS,
    REST,
    SIDE,
    near_head,
    plain_face,
    region_of,
)
from pipeline.registration.identity_fit import PlacedHead
from pipeline.smoothing import continued
from pipeline.template.load import load_template
from pipeline.visibility import FittedPhoto, Occluder, view_cosines
from stages.bake.outline_depth import outline_depth
from stages.bake.unseen import (
    AROUND,
    CLEAR,
    GRAZING,
    HAIR_CLEAR,
    HAIR_GRAZING,
    LENGTH,
    region_colours,
    replaced_share,
    with_hair,
)
from tests.support.field_artifacts import camera

TEMPLATE = load_template()


def strip(length: float, step: float) -> Mesh:
    """A flat strip along x, one step wide."""
    n = round(length / step) + 1
    x = np.arange(n) * step
    vertices = np.concatenate([np.stack([x, np.full(n, y), np.zeros(n)], 1) for y in (0.0, step)]).astype(np.float32)
    i = np.arange(n - 1)
    faces = np.concatenate([np.stack([i, i + 1, i + 1 + n], 1), np.stack([i, i + 1 + n, i + n], 1)]).astype(np.int32)
    return Mesh(vertices, np.tile(np.float32([0, 0, 1]), (2 * n, 1)), faces)


def placed(scale: float) -> PlacedHead:
    world = np.diag([scale, scale, scale, 1.0])
    return PlacedHead(world, np.zeros(0), TEMPLATE.vertices * scale, np.zeros(0), 0.0)


def test_what_photos_show_well_is_kept_and_what_they_do_not_is_replaced() -> None:
    for code, low, high in ((REGIONS.index("face"), GRAZING, CLEAR), (HAIR, HAIR_GRAZING, HAIR_CLEAR)):
        share = replaced_share(np.array([0.0, low, 0.5 * (low + high), high, 1.0]), np.full(5, code))
        np.testing.assert_allclose(share, [1, 1, 0.5, 0, 0], atol=1e-12)
        assert (np.diff(replaced_share(np.linspace(0, 1, 50), np.full(50, code))) <= 0).all()
    at_a_slant = np.full(2, 0.4)  # a solid is kept there, hair is replaced by half
    solid, hair = replaced_share(at_a_slant, np.array([REGIONS.index("face"), HAIR]))
    assert solid == 0 and hair == pytest.approx(0.5)


def test_an_unseen_region_goes_on_in_its_own_colour() -> None:
    """Black hair seen in front, skin of the face: the back of the head is black; a region that no photo shows has the
    colour of the whole."""
    region = np.repeat([0, 3, 1], [100, 300, 50])
    seen = np.concatenate([np.arange(100) < 30, np.ones(300, bool), np.zeros(50, bool)])
    albedo = np.where((region == 0)[:, None], 0.02, 0.6) * np.ones((450, 3))
    albedo[~seen] = 9.0  # means nothing
    cosine, depth = np.where(seen, 0.9, 0.0), np.where(seen, 0.2, 0.0)
    # at the outline the wall shines through, on more than half of what is seen, and straight before a camera
    cosine[:18], depth[:18], albedo[:18] = 0.95, 0.01, 0.8
    found = region_colours(np.zeros((450, 3)), albedo, region, cosine, depth)
    np.testing.assert_allclose(found[region == 0], 0.02)
    np.testing.assert_allclose(found[region != 0], 0.6)


def test_a_fringe_before_the_forehead_does_not_decide_the_colour_of_hair() -> None:
    """It is farthest inside of the silhouettes, but the skin beside it shines through; at the outline the wall does."""
    height = np.linspace(0, 0.2, 201)  # metres above the fringe's end, where the forehead begins
    points = np.stack([np.zeros(301), np.r_[height, np.linspace(-0.1, -0.001, 100)], np.zeros(301)], 1)
    hair = np.arange(301) < 201
    region = np.where(hair, HAIR, REGIONS.index("face"))
    depth = np.where(hair, 0.25 - points[:, 1], 0.3)  # the outline is above
    albedo = np.where(hair, 0.02, 0.6)
    albedo[:80] = 0.3  # over more than the third that lies deepest
    albedo[180:201] = 0.8
    found = region_colours(points, albedo[:, None] * np.ones(3), region, np.ones(301), depth)
    np.testing.assert_allclose(found[hair], 0.02)
    np.testing.assert_allclose(found[~hair], 0.6)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_regions_are_those_of_the_placed_template(scale: float) -> None:
    for name in ("scalp", "ears"):
        middle = TEMPLATE.vertices[TEMPLATE.quads[TEMPLATE.regions[name]]].mean(1)
        assert (region_of(middle * scale, TEMPLATE, placed(scale)) == REGIONS.index(name)).all()
    far = np.array([[0.0, -0.5, 0.0]]) * scale
    assert (region_of(far, TEMPLATE, placed(scale)) == REST).all()
    ears = TEMPLATE.vertices[TEMPLATE.quads[TEMPLATE.regions["ears"]]].mean(1) * scale
    near = near_head(TEMPLATE, placed(scale))
    assert near(ears).all() and not near(far).any() and near(ears[:0]).shape == (0,)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_plain_skin_of_the_face_keeps_clear_of_what_has_a_shape(scale: float) -> None:
    plain = plain_face(TEMPLATE, placed(scale))
    for name in (*PARTED, "ears", "scalp", "neck"):
        assert not plain(TEMPLATE.vertices[TEMPLATE.quads[TEMPLATE.regions[name]]].mean(1) * scale).any()
    face = TEMPLATE.vertices[np.unique(TEMPLATE.quads[TEMPLATE.regions["face"]])]
    parted = TEMPLATE.vertices[np.unique(np.concatenate([TEMPLATE.quads[TEMPLATE.regions[n]] for n in PARTED]))]
    away = np.linalg.norm(face[:, None] - parted[None], axis=-1).min(1)
    found = plain(face * scale)
    assert not found[away < 0.999 * CLEAR_OF].any() and found[away > 0.015].mean() > 0.8
    assert not plain(np.array([[0.0, -0.5, 0.0]]) * scale).any() and plain(face[:0]).shape == (0,)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_neck_is_divided_by_height(scale: float) -> None:
    """Bands rise with the template's y, also where the head is turned; a collar of four centimetres belongs to them."""
    middle = TEMPLATE.vertices[TEMPLATE.quads[TEMPLATE.regions["neck"]]].mean(1)
    out = middle * [1, 0, 1]
    collar = middle + 0.03 * out / np.linalg.norm(out, axis=1, keepdims=True)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # up becomes -x
    world = np.eye(4)
    world[:3, :3] = scale * turn
    head = PlacedHead(world, np.zeros(0), scale * TEMPLATE.vertices @ turn.T, np.zeros(0), 0.0)
    for points in (middle, collar):
        found = region_of(scale * points @ turn.T, TEMPLATE, head)
        ours = found >= FIRST_BAND  # near the jaw and behind the ears other regions are nearer
        assert ours.mean() > 0.7
        side, band = np.divmod(found - FIRST_BAND, BANDS)
        expected = np.floor((points[:, 1] - middle[:, 1].min()) / BAND_HEIGHT)
        assert (np.abs(band - expected)[ours] <= 1).all()
        x, _, z = (points - middle.mean(0)).T
        angle = np.degrees(np.arctan2(np.abs(x), z))
        assert (side[ours] == (angle > SIDE)[ours]).all() and 0.5 < side[ours].mean() < 0.9


def test_a_band_that_is_not_seen_takes_the_nearest_bands_colour() -> None:
    """Skin above, a collar below, both seen in front; the band between is not seen, nor is one far above."""
    region = FIRST_BAND + np.repeat([0, 2, 3, 9], 50)
    cosine = np.where(np.isin(region - FIRST_BAND, [0, 3]), 0.9, 0.0)
    albedo = np.where((region == FIRST_BAND)[:, None], 0.1, 0.6) * np.ones((200, 3))
    albedo[cosine == 0] = 9.0
    found = region_colours(np.zeros((200, 3)), albedo, region, cosine, cosine)[:, 0]
    np.testing.assert_allclose(found, np.repeat([0.1, 0.6, 0.6, 0.6], 50))


def test_the_nape_goes_on_as_the_sides_of_the_neck_do() -> None:
    """A bare throat, hair that covers the sides. Behind, a band that is not seen takes the nearest one behind, unless a
    band in front is nearer by more than AROUND."""
    front, sides, above, far = (FIRST_BAND + 5, FIRST_BEHIND + 5, FIRST_BEHIND + 5 + AROUND, FIRST_BEHIND + 12 + AROUND)
    region = np.repeat([front, sides, above, far, FIRST_BAND + 12 + AROUND], 50)
    cosine = np.where(np.isin(region, [front, FIRST_BAND + 12 + AROUND]) | (np.arange(250) % 50 < 10), 0.9, 0.0)
    cosine[np.isin(region, [above, far])] = 0.0
    albedo = np.where((region < FIRST_BEHIND)[:, None], 0.6, 0.02) * np.ones((250, 3))
    albedo[region == FIRST_BAND + 12 + AROUND] = 0.3
    found = region_colours(np.zeros((250, 3)), albedo, region, cosine, cosine)[:, 0]
    np.testing.assert_allclose(found, np.repeat([0.6, 0.02, 0.02, 0.3, 0.3], 50))


def test_what_is_far_from_the_head_takes_what_is_seen_nearby() -> None:
    """Two halves of a coat, black and white, seen in front: each back has its own half's colour."""
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (1000, 3)) + [0, -0.5, 0]
    points[:, 0] += 0.2 * np.sign(points[:, 0])
    seen = points[:, 2] > 0
    white = points[:, 0] > 0
    albedo = np.where(seen, np.where(white, 0.9, 0.05), 7.0)[:, None] * np.ones((1000, 3))
    found = region_colours(points, albedo, np.full(1000, REST), 0.9 * seen, np.zeros(1000))[:, 0]
    np.testing.assert_allclose(found[~seen], np.where(white, 0.9, 0.05)[~seen])


def test_the_inside_of_the_head_does_not_take_the_colour_of_hair() -> None:
    """The hollow behind an eye, nearer to the face than to hair; the rest that is seen is a white shirt far below."""
    face, hair, hollow, back, shirt = (
        np.array(p) for p in ([0, 0, 0.1], [0, 0.1, 0], [0, 0, 0.06], [0, 0.1, -0.03], [0, -0.5, 0.0])
    )
    points = np.repeat([face, hair, hollow, back, shirt], 30, axis=0) + 0.001 * np.arange(150)[:, None] / 150
    region = np.repeat([REGIONS.index("face"), HAIR, REST, REST, REST], 30)
    seen = np.repeat([True, True, False, False, True], 30)
    albedo = np.repeat([0.6, 0.02, 7.0, 7.0, 0.9], 30)[:, None] * np.ones((150, 3))
    found = region_colours(points, albedo, region, 0.9 * seen, np.ones(150))[:, 0]
    np.testing.assert_allclose(found[60:120], np.repeat([0.9, 0.02], 30))


def test_depth_is_the_distance_from_the_outline_of_the_best_photo(tmp_path: Path) -> None:
    """Oracle: a wall before two cameras whose masks are a square and the whole photo; distances by hand."""
    side = np.linspace(-0.05, 0.05, 41)
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    vertices = np.stack([x, y, np.zeros_like(x)], 1).astype(np.float32)
    i = np.arange(40 * 41).reshape(40, 41)[:, :40].ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + 42], 1), np.stack([i, i + 42, i + 41], 1)]).astype(np.int32)
    wall = Mesh(vertices, np.tile(np.float32([0, 0, 1]), (len(vertices), 1)), faces)
    front = camera(0, 0.0)  # 0.6 m in front
    square = np.zeros((front.height, front.width), np.uint8)
    margin = 7 * front.width // 16
    square[margin:-margin, margin:-margin] = 255
    write_png(tmp_path / "square.png", square)
    view = FittedPhoto(front, tmp_path / "square.png")
    every = np.arange(len(vertices))
    found = outline_depth(wall, every, [view], Occluder(wall), CLEAR)
    _, at = view_cosines(view, vertices.astype(np.float64), wall.normals.astype(np.float64), Occluder(wall))
    inside = front.width / 2 - margin - np.abs(at - front.width / 2).max(1)  # pixels to the square's side
    seen = inside > 1
    assert seen.any() and not seen.all()
    np.testing.assert_allclose(found[seen] * front.width, inside[seen], atol=1.5)
    assert (found[inside < -1] == 0).all()
    some = outline_depth(wall, every[:7], [view, replace(view, mask=None)], Occluder(wall), CLEAR)
    np.testing.assert_array_equal(some[:7], found[:7])
    assert (some[7:] == 0).all()
    grazing = replace(wall, normals=np.tile(np.float32([0.98, 0, 0.19]), (len(vertices), 1)))
    assert not outline_depth(grazing, every[820:860], [view], Occluder(wall), CLEAR).any()
    assert not outline_depth(wall, every, [replace(view, mask=None)], Occluder(wall), CLEAR).any()


def test_the_seen_rim_fades_over_the_length() -> None:
    """Source of the expected values: u'' = u / L^2 on a half line, u = exp(-x / L)."""
    mesh = strip(0.2, 5e-4)
    x = mesh.vertices[:, 0].astype(np.float64)
    seen = x <= 0.05
    u = continued(mesh, np.ones((len(x), 1)), seen, np.zeros((len(x), 1)), LENGTH)[:, 0]
    np.testing.assert_allclose(u, np.exp(-(x - x[seen].max()).clip(0) / LENGTH), atol=0.01)


def test_with_all_or_nothing_seen_the_albedo_is_unchanged() -> None:
    mesh = strip(0.01, 1e-3)
    albedo = np.random.default_rng(0).uniform(size=(len(mesh.vertices), 3))
    for seen in (True, False):
        whole = np.full(len(albedo), seen)
        np.testing.assert_array_equal(continued(mesh, albedo, whole, np.zeros_like(albedo), LENGTH), albedo)


def test_the_scalp_under_hair_goes_on_in_the_colour_of_the_face() -> None:
    scalp, face = REGIONS.index("scalp"), REGIONS.index("face")
    region = np.repeat([scalp, face, REST, scalp], 100)
    hair = np.arange(400) >= 300
    found = with_hair(region, hair)
    assert (found[:200] == face).all() and (found[200:300] == REST).all() and (found[300:] == HAIR).all()
    cosine = np.where(region == scalp, 0.0, 0.9)
    cosine[300:350] = 0.9
    albedo = np.where(hair, 0.02, 0.6)[:, None] * np.ones((400, 3))
    colours = region_colours(np.zeros((400, 3)), albedo, found, cosine, cosine)
    np.testing.assert_allclose(colours[:200], 0.6)
    np.testing.assert_allclose(colours[300:], 0.02)
