"""The template's texture layout: inside its tiles, upright, symmetric, nothing on top of anything else."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pipeline.meshes import F64, Charts
from pipeline.raster import rasterise, texel_corners
from pipeline.template.load import OWN, load_template
from pipeline.template.model import Template

FACE = ("face", "brows", "lids", "lips", "nose", "nostrils")
OUTSIDE = (*FACE, "ears", "scalp", "neck")
SIZE = 1024


@pytest.fixture(scope="module")
def head() -> Template:
    return load_template()


def areas(corners: F64) -> F64:
    """(n,) signed areas of triangles (n, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2)


def quad_areas(head: Template, quads: np.ndarray) -> F64:
    c = head.uvs[head.uv_quads[quads]]
    return areas(c[:, :3]) + areas(c[:, [0, 2, 3]])


def test_skin_is_on_the_first_tile_and_the_rest_on_the_second(head: Template) -> None:
    for name, quads in head.regions.items():
        corners = head.uvs[head.uv_quads[quads]]
        low, high = (0, 1) if name in OUTSIDE else (1, 2)
        assert low + 0.003 < corners[..., 0].min() and corners[..., 0].max() < high - 0.003, name
        assert corners[..., 1].min() > 0.003 and corners[..., 1].max() < 0.997, name


def test_no_corner_of_a_quad_is_flipped(head: Template) -> None:
    corners = head.uvs[head.uv_quads]
    for three in ((0, 1, 2), (0, 2, 3), (0, 1, 3), (1, 2, 3)):
        assert areas(corners[:, list(three)]).min() > 1e-9, "convex and counter-clockwise"


@pytest.mark.parametrize("tile", [0, 1])
def test_nothing_overlaps(head: Template, tile: int) -> None:
    """The charts' areas sum to the texels that any of them covers."""
    faces = head.uv_quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    own = np.floor(head.uvs[faces][..., 0].mean(1)) == tile
    charts = Charts((head.uvs - [tile, 0]).astype(np.float32), faces[own].astype(np.int32))
    corners = texel_corners(charts, SIZE)
    covered = len(rasterise(corners, SIZE, 0, SIZE, reach=1e-4).texel) / SIZE**2
    total = float(areas((head.uvs - [tile, 0])[faces[own]]).sum())
    assert abs(covered - total) < 2e-3
    assert total > (0.9 if tile == 0 else 0.4)
    moved = corners.copy()  # the check sees an overlap: every tenth triangle on top of its neighbour
    moved[::10] = moved[np.arange(0, len(moved), 10) ^ 1]
    assert len(rasterise(moved, SIZE, 0, SIZE, reach=1e-4).texel) / SIZE**2 < total - 2e-3


def test_it_is_upright_and_symmetric(head: Template) -> None:
    """On the face +v is up and +u the person's left; mirrored vertices have mirrored coordinates."""
    quads = head.quads[head.regions["face"]]
    corners, uv = head.vertices[quads].reshape(-1, 3), head.uvs[head.uv_quads[head.regions["face"]]].reshape(-1, 2)
    assert np.corrcoef(corners[:, 1], uv[:, 1])[0, 1] > 0.97 and np.corrcoef(corners[:, 0], uv[:, 0])[0, 1] > 0.95
    middle = head.mirror == np.arange(len(head.vertices))
    on = middle[quads].reshape(-1)
    assert on.sum() > 20 and np.abs(uv[on, 0] - 0.5).max() < 1e-6, "the face's middle line is the tile's"
    skin = np.concatenate([head.regions[r] for r in OUTSIDE])
    uvs = head.uvs[head.uv_quads[skin]].reshape(-1, 2).tolist()
    keys = {(v, *np.round(x, 5)) for v, x in zip(head.quads[skin].ravel().tolist(), uvs, strict=True)}
    near = {(v, round(u, 4), round(w, 4)) for v, u, w in keys}
    lost = sum(not any((int(head.mirror[v]), round(1 - u + d, 4), round(w + e, 4)) in near
                       for d in (-1e-4, 0, 1e-4) for e in (-1e-4, 0, 1e-4)) for v, u, w in keys)  # fmt: skip
    assert lost == 0


def test_face_has_at_least_half_of_the_tile(head: Template) -> None:
    share = sum(float(quad_areas(head, head.regions[r]).sum()) for r in FACE)
    assert share >= 0.5
    assert abs(share - json.loads((OWN / "manifest.json").read_text())["figures"]["layout"]["face_share"]) < 1e-3


def test_the_skins_only_seams_are_down_the_back_and_round_the_mouth_and_eyes(head: Template) -> None:
    """A vertex with two places in the texture is on the middle line behind the crown, or at an opening."""
    skin = np.concatenate([head.regions[r] for r in OUTSIDE])
    both = np.unique(np.stack([head.quads[skin].ravel(), head.uv_quads[skin].ravel()], 1), axis=0)[:, 0]
    vertex, count = np.unique(both, return_counts=True)
    seam = head.vertices[vertex[count > 1]]
    assert len(seam) >= 8 and np.abs(seam[:, 0]).max() < 1e-9 and seam[:, 2].max() < 0.01


def test_stretch_on_the_face_is_small(head: Template) -> None:
    """Largest over smallest singular value of each triangle's map: half of the face below 1.5, 95 % below 2.3."""
    quads = np.concatenate([head.regions[r] for r in FACE])
    p = head.vertices[head.quads[quads][:, :3]]
    uv = head.uvs[head.uv_quads[quads][:, :3]]
    x, side = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    length = np.linalg.norm(x, axis=1)
    along = (x * side).sum(1) / length
    flat = np.zeros((len(p), 2, 2))
    flat[:, 0, 0], flat[:, 0, 1], flat[:, 1, 1] = length, along, np.linalg.norm(np.cross(x, side), axis=1) / length
    s = np.linalg.svd(np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], 2) @ np.linalg.inv(flat), compute_uv=False)
    assert np.median(s[:, 0] / s[:, 1]) < 1.5 and np.percentile(s[:, 0] / s[:, 1], 95) < 2.3
