"""The inside of the mouth: a made-up head with a bag behind its lips, and the template itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.registration.head import Head, limit_surface
from pipeline.registration.inside import CAVITY, DEEP, MOST, SHOWN, beneath, shown_through
from pipeline.registration.subdivision import subdivided
from pipeline.template.load import load_template
from stages.template.register import index_of

TEMPLATE = load_template()
NAMES = tuple(TEMPLATE.regions)
PUSH = 0.006  # metres of the template


def head(unit: float = 1.0, push: float = 0.0) -> Head:
    """The template's own head, `unit` metres a metre. push: metres of the template by which a place of the mouth's
    inside, beside the upper lip, is moved out through the cheek."""
    vertices = TEMPLATE.vertices.copy()
    region = index_of(TEMPLATE.regions, len(TEMPLATE.quads))
    inside = region == NAMES.index(CAVITY)
    own = np.setdiff1d(TEMPLATE.quads[inside], TEMPLATE.quads[~inside])
    if push:  # where the cheek is thinnest, away from the lips
        face, lips = (TEMPLATE.vertices[np.unique(TEMPLATE.quads[region == NAMES.index(n)])] for n in ("face", "lips"))
        gap, nearest = cKDTree(face).query(vertices[own])
        gap[cKDTree(lips).query(vertices[own])[0] < 0.008] = np.inf
        i = int(gap.argmin())
        way = face[nearest[i]] - vertices[own[i]]
        share = np.exp(-((np.linalg.norm(vertices[own] - vertices[own[i]], axis=1) / 0.008) ** 2))
        vertices[own] += share[:, None] * (way + push * way / np.linalg.norm(way))
    count = len(limit_surface(vertices, subdivided(TEMPLATE.quads, len(vertices), 1))[0])
    flat = np.zeros(count, np.float32)
    return Head(unit * vertices, TEMPLATE.quads, TEMPLATE.uvs, TEMPLATE.uv_quads, region,
                index_of(TEMPLATE.parts, len(TEMPLATE.quads)), flat, flat, 1)  # fmt: skip


def mended(h: Head, unit: float) -> tuple[Head, np.ndarray]:
    points, normals, quads = h.surface()
    more = beneath(points, normals, h.displacement.astype(np.float64), quads, np.repeat(h.region, 4), NAMES, unit)
    return replace(h, displacement=(h.displacement + more).astype(np.float32)), more


def deepest(h: Head, unit: float) -> float:
    """Distance outside of the skin that comes closest to it, of the mouth's inside 6 mm and more from the lips."""
    _, _, quads = h.surface()
    region, moved = np.repeat(h.region, 4), h.displaced()
    inside = region == NAMES.index(CAVITY)
    own = np.setdiff1d(quads[inside], quads[~inside])
    rim = np.intersect1d(quads[inside], quads[~inside])
    far = own[cKDTree(moved[rim]).query(moved[own])[0] > 0.006 * unit]
    skin = np.unique(quads[np.isin(region, [NAMES.index(n) for n in ("face", "lips", "nose")])])
    return -float(cKDTree(moved[skin]).query(moved[far])[0].min())


@pytest.mark.parametrize("unit", [1.0, 1.3, 250.0])
def test_what_comes_through_the_cheek_is_put_back_beneath_it(unit: float) -> None:
    wrong = head(unit, PUSH)
    found, more = mended(wrong, unit)
    assert shown_through(wrong, NAMES, unit) > 3
    assert shown_through(found, NAMES, unit) == 0
    assert deepest(found, unit) < -0.5 * DEEP * unit  # not only just beneath it
    assert 0.001 * unit < more.max() <= MOST * unit
    inside = np.unique(wrong.surface()[2][np.repeat(wrong.region, 4) == NAMES.index(CAVITY)])
    assert not np.delete(more, inside).any()  # the skin, the teeth and the tongue stay


def test_the_template_s_own_mouth_hardly_moves() -> None:
    found, more = mended(head(), 1.0)
    assert shown_through(head(), NAMES, 1.0) == shown_through(found, NAMES, 1.0) == 0
    assert more.max() < DEEP


def test_a_point_whose_normal_leads_out_of_the_skin_stays() -> None:
    """At the lips' edge a normal can do so; a point that lacked .1 mm came .4 mm through the lip."""
    h = head(1.0, PUSH)
    points, normals, quads = h.surface()
    flat, region = np.zeros(len(points)), np.repeat(h.region, 4)
    into, out = (beneath(points, n, flat, quads, region, NAMES, 1.0) for n in (normals, -normals))
    assert (into > 0.001).sum() > 20
    assert not out[into > 0.001].any()


def test_the_way_is_smooth() -> None:
    """No vertex moves alone: neighbours differ by less than half of the largest way."""
    h = head(1.0, PUSH)
    _, more = mended(h, 1.0)
    inner = h.surface()[2][np.repeat(h.region, 4) == NAMES.index(CAVITY)]
    step = np.abs(more[inner] - np.roll(more[inner], 1, axis=1)).max()
    assert step < 0.5 * more.max()


def test_a_displaced_cheek_counts() -> None:
    """The skin that the photos show lies deeper than the cage's."""
    h = head()
    points, normals, quads = h.surface()
    face = np.unique(quads[np.repeat(h.region, 4) == NAMES.index("face")])
    sunk = h.displacement.copy()
    sunk[face] = -0.006
    deep = replace(h, displacement=sunk)
    before = shown_through(deep, NAMES, 1.0)
    assert before > 0 and shown_through(mended(deep, 1.0)[0], NAMES, 1.0) < 0.2 * before


def test_a_head_without_a_mouth_is_left_alone() -> None:
    h = head()
    points, normals, quads = h.surface()
    other = tuple("cheeks" if n == CAVITY else n for n in NAMES)
    assert not beneath(points, normals, np.zeros(len(points)), quads, np.repeat(h.region, 4), other, 1.0).any()
    assert shown_through(h, other, 1.0) == 0


def test_a_little_outside_is_not_shown() -> None:
    """Closer to the skin than SHOWN, facets hide it."""
    assert 0 < SHOWN < DEEP / 3
