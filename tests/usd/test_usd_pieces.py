"""Pieces of a mesh by tile and material: four triangles on two tiles, sorted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from stages.usd.write.mesh import UvSurface
from stages.usd.write.pieces import grouped, pieces, together
from stages.usd.write.variants import HAIR, RENDER, REST

FACES = np.array([[0, 1, 2], [1, 2, 3], [3, 4, 5], [4, 5, 6]], np.int32)
UVS = np.array(
    [[0.1, 0.1], [0.4, 0.1], [0.1, 0.4], [0.6, 0.6], [0.9, 0.6], [0.6, 0.9],
     [1.1, 0.2], [1.4, 0.2], [1.1, 0.5], [1.5, 0.5], [1.9, 0.5], [1.5, 0.8]], np.float32,
)  # fmt: skip


def mesh() -> UvSurface:
    points = np.arange(21, dtype=np.float32).reshape(7, 3)
    return UvSurface(points, points, FACES, UVS, np.arange(12, dtype=np.int32).reshape(4, 3))


def test_each_piece_has_the_triangles_of_its_tile_and_material() -> None:
    found = list(pieces(mesh(), 2, np.array([True, False])))
    assert [(p.tile, p.eyes, p.mesh.faces.tolist()) for p in found] == [
        (0, False, [[1, 2, 3]]),
        (0, True, [[0, 1, 2]]),
        (1, False, [[3, 4, 5], [4, 5, 6]]),
    ]
    for piece in found:
        inside = piece.mesh.uvs[piece.mesh.uv_faces]
        own = np.flatnonzero((FACES[:, None] == piece.mesh.faces).all(2).any(1))
        np.testing.assert_allclose(inside, UVS.reshape(4, 3, 2)[own] - [piece.tile, 0], atol=1e-6)


def test_without_eyes_a_tile_is_one_piece() -> None:
    assert [(p.tile, p.eyes, len(p.mesh.faces)) for p in pieces(mesh(), 2, None)] == [(0, False, 2), (1, False, 2)]


@pytest.mark.parametrize(
    ("moving", "hair", "wanted"),
    [
        (0, None, {RENDER: [1, 0, 2]}),
        (3, None, {REST: [1, 2], RENDER: [0]}),  # the second triangle has vertex 3, which no rig moves
        (4, None, {RENDER: [1, 0], REST: [2]}),
        (7, 1, {RENDER: [1, 0], HAIR: [2]}),
    ],
)
def test_what_a_rig_moves_is_a_mesh_of_its_own(moving: int, hair: int | None, wanted: dict[str, list[int]]) -> None:
    found = grouped(list(pieces(mesh(), 2, np.array([True, False]))), moving, hair)
    assert {name: [int(p.mesh.faces.min()) for p in some] for name, some in found.items()} == {
        name: [int(FACES[n].min()) for n in some] for name, some in wanted.items()
    }


def test_tiles_lie_side_by_side_in_one_square() -> None:
    found = list(pieces(mesh(), 2, np.array([True, False])))
    whole, rows = together(found, 2)
    order = [1, 0, 2, 3]
    np.testing.assert_array_equal(whole.faces, FACES[order])
    np.testing.assert_allclose(whole.uvs[whole.uv_faces], UVS.reshape(4, 3, 2)[order] / [2, 1], atol=1e-6)
    assert [r.tolist() for r in rows] == [[0], [1], [2, 3]]
