"""Charts that lie twice on the same texels are taken apart, the others are left as they are."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline import meshes, raster
from pipeline.meshes import Charts, Mesh
from stages.uv import unwrap as unwrapping
from stages.uv.chart_quality import measure
from stages.uv.config import Config
from stages.uv.split_overlaps import folded, one_by_one, taken_apart
from stages.uv.unwrap import signed_areas, unwrap


def strip(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners (2 (count + 1), 2) of a row of squares of edge 1, and its faces (2 count, 3), counter-clockwise."""
    x = np.arange(count + 1.0)
    points = np.concatenate([np.stack([x, 0 * x], 1), np.stack([x, 0 * x + 1], 1)])
    low = np.arange(count)
    high = low + count + 1
    faces = np.concatenate([np.stack([low, low + 1, high + 1], 1), np.stack([low, high + 1, high], 1)])
    return points, faces.astype(np.int32)


def wound() -> tuple[np.ndarray, np.ndarray]:
    """A strip laid one and a half times around a ring in the texture: its last third lies on its first."""
    points, faces = strip(36)
    angle, radius = 2 * np.pi * points[:, 0] / 24, 0.45 - 0.2 * points[:, 1]
    return np.stack([0.5 - radius * np.sin(angle), 0.5 + radius * np.cos(angle)], 1), faces


def turned(uvs: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The strip with positive areas."""
    return uvs if signed_areas(uvs, faces).sum() > 0 else uvs * [-1, 1] + [1, 0]


def test_the_second_layer_is_found_and_only_that() -> None:
    uvs, faces = wound()
    charts = Charts(turned(uvs, faces).astype(np.float32), faces)
    out = folded(charts, 512)
    square = np.arange(len(faces)) % 36
    both = (square < 12) | (square >= 24)
    assert not out[~both].any()
    pairs = out[:, None] & (square[:, None] % 24 == square[None, :] % 24)  # of two on the same place one stays
    assert (out & both).sum() >= 24 and pairs.any()
    layers = raster.layers(raster.texel_corners(Charts(charts.uvs, faces[~out]), 512), 512)
    assert (layers > 1).sum() == 0


def test_a_flat_chart_has_no_fold_whichever_way_it_is_turned() -> None:
    points, faces = strip(9)
    uvs = points / 10 + 0.05
    assert not folded(Charts(uvs.astype(np.float32), faces), 256).any()
    assert not folded(Charts((1 - uvs).astype(np.float32), faces), 256).any()
    assert not folded(Charts(uvs.astype(np.float32), faces[:, ::-1]), 256).any()


def test_mirrored_faces_are_found() -> None:
    points, faces = strip(9)
    faces[4] = faces[4, ::-1]
    assert np.flatnonzero(folded(Charts((points / 10 + 0.05).astype(np.float32), faces), 256)).tolist() == [4]


def test_what_is_taken_apart_keeps_its_shape_and_shares_nothing_with_the_rest() -> None:
    uvs, faces = wound()
    out = np.zeros(len(faces), np.bool_)
    out[[3, 4, 39, 60]] = True  # 3, 4 and 39 touch, 60 does not
    apart, split = taken_apart(uvs, faces, out)
    assert np.allclose(apart[split], uvs[faces])
    assert not np.isin(split[out], split[~out]).any()
    assert len(np.unique(meshes.component_of_face(split, len(apart))[out])) == 2


def test_one_by_one_faces_are_as_they_are_in_space() -> None:
    rng = np.random.default_rng(5)
    uvs, faces = wound()
    corners = rng.normal(0, 1, (len(faces), 3, 3))
    out = rng.random(len(faces)) < 0.3
    apart, split = one_by_one(uvs, faces, out, corners)
    assert np.allclose(apart[split][~out], uvs[faces[~out]])
    assert len(np.unique(split[out])) == 3 * out.sum()
    for i in range(3):
        flat = np.linalg.norm(apart[split[out, i]] - apart[split[out, i - 1]], axis=1)
        assert np.allclose(flat, np.linalg.norm(corners[out, i] - corners[out, i - 1], axis=1))
    assert (signed_areas(apart, split)[out] > 0).all()


def band() -> Mesh:
    """The strip as a surface, its squares a centimetre wide."""
    points, faces = strip(36)
    vertices = np.concatenate([points * 0.01, np.zeros((len(points), 1))], 1)
    return Mesh(vertices.astype(np.float32), meshes.vertex_normals(vertices, faces), faces)


def thrown(seed: int) -> np.ndarray:
    """Texture coordinates for the strip that mean nothing at all."""
    return np.random.default_rng(seed).random((74, 2))


def mirrored_and_wound() -> np.ndarray:
    """The wound strip with one vertex drawn across its neighbours: some faces are mirrored as well."""
    uvs = turned(*wound())
    uvs[50] += 0.2
    return uvs


@pytest.mark.parametrize(
    "uvs", [turned(*wound()), *(pytest.param(x, marks=pytest.mark.slow) for x in (mirrored_and_wound(), thrown(1)))]
)
@pytest.mark.slow
def test_charts_that_fold_are_mended_before_they_are_packed(uvs: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = band()
    before = measure(mesh, Charts(uvs.astype(np.float32), mesh.faces))
    assert before.overlap > 0.1
    for ours in ("unwrapped", "in_pieces"):  # as where our own charts do not lie flat
        monkeypatch.setattr(unwrapping, ours, lambda *_, **__: None)
    monkeypatch.setattr(unwrapping, "_cut", lambda *_: (uvs * 1000, mesh.faces))  # as if xatlas had made these
    charts = unwrap(mesh, Config())
    quality = measure(mesh, charts)
    assert quality.overlap < 1e-3 and quality.flipped == 0 and quality.empty == 0
    assert charts.faces.shape == mesh.faces.shape and charts.uvs.min() >= 0 and charts.uvs.max() <= 1
