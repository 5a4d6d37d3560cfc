"""Which faces share an edge, against a search through all pairs of sides."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pipeline import meshes

TETRAHEDRON = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]


@pytest.mark.parametrize(
    ("faces", "most"),
    [
        (TETRAHEDRON, 2),
        (TETRAHEDRON[:3], 2),
        ([*TETRAHEDRON, [0, 1, 4]], 3),  # a fin: its edge is no pair
        ([[5, 2, 9]], 1),
        (np.zeros((0, 3)), 0),
    ],
)
def test_pairs_are_those_of_a_search(faces: list[list[int]], most: int) -> None:
    sides = meshes.edges(np.array(faces, np.int32))
    same = [set(s) for s in sides.tolist()]
    alone = [[j for j in range(len(same)) if same[j] == same[i]] for i in range(len(same))]
    expected = {(i, j) for i, j in itertools.combinations(range(len(same)), 2) if alone[i] == [i, j]}
    first, second, found = meshes.paired_edges(np.array(faces, np.int32), 10)
    assert set(zip(first.tolist(), second.tolist(), strict=True)) == expected
    assert found == most
    order = np.sort(sides[first], axis=1).tolist()
    assert order == sorted(order)


def test_open_edges_are_those_along_borders() -> None:
    """By hand: a square of two triangles, whose diagonal is shared; a closed tetrahedron has none."""
    square = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    assert meshes.open_edges(square, 4).tolist() == [[0, 1], [1, 2], [2, 3], [3, 0]]
    assert not len(meshes.open_edges(np.array(TETRAHEDRON, np.int32), 4))
