"""Pictures for the page of a run at work: a mesh from its sides, photos in rows."""

from __future__ import annotations

import numpy as np
import pytest

from workflows.live.pictures import GREY, SIDE, jpeg, shaded, sheet
from workflows.live.publisher import told


def block() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A plate in the plane z = 0, 2 wide and 1 high, that faces +Z, as far right as left."""
    vertices = np.array([[-1, -0.5, 0], [1, -0.5, 0], [1, 0.5, 0], [-1, 0.5, 0]], np.float32)
    return vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.tile(np.array([0, 0, 1], np.float32), (4, 1))


@pytest.mark.parametrize(("degrees", "share"), [(0.0, 2.0), (180.0, 2.0), (60.0, 1.0)])
def test_a_plate_covers_what_its_projection_does(degrees: float, share: float) -> None:
    """Area in the picture: 2 x 1, times the cosine; the picture is 2 r wide, r the farthest corner's distance."""
    picture = shaded(*block(), degrees, 200)[..., 0].astype(int)
    seen = picture != GREY
    width = 2 * 1.02 * np.hypot(1, 0.5)
    assert seen.mean() == pytest.approx(share / width**2, abs=0.01)
    light = 1.0 if share == 2 else 0.5
    assert np.abs(picture[seen] - (40 + 200 * light)).max() <= 1
    rows, columns = np.nonzero(seen)
    assert abs(rows.mean() - 99.5) < 1 and abs(columns.mean() - 99.5) < 1


def test_a_plate_from_its_edge_and_nothing_to_see() -> None:
    assert (shaded(*block(), 90.0, 64) != GREY).mean() < 0.05


def test_a_sheet_keeps_shapes_and_order() -> None:
    pictures = [np.full((40, 80, 3), 10, np.uint8), np.full((900, 300, 3), 200, np.uint8)]
    rows = sheet([*pictures, *pictures, pictures[0]])
    assert rows.shape == (2 * SIDE, 4 * SIDE, 3)
    assert tuple(rows[SIDE // 2, SIDE // 2]) == (10,) * 3 and tuple(rows[4, 4]) == (GREY,) * 3
    assert tuple(rows[SIDE // 2, SIDE + SIDE // 2]) == (200,) * 3 and tuple(rows[SIDE // 2, SIDE + 4]) == (GREY,) * 3
    assert tuple(rows[SIDE + SIDE // 2, SIDE + SIDE // 2]) == (GREY,) * 3
    assert sheet(pictures[:1]).shape == (SIDE, SIDE, 3)
    assert jpeg(rows)[:2] == b"\xff\xd8"


@pytest.mark.parametrize("state", [{}, {"stages": 3}, {"stages": [3]}, {"stages": [{"name": "x"}]}, {"stages": None}])
def test_half_a_state_is_not_shown(state: dict[str, object]) -> None:
    assert not told(state)
