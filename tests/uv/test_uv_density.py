"""The face has 40 % of the texels, and is one chart."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline import meshes
from pipeline.faces.landmarks3d import head_frame
from pipeline.faces.oval import on_face
from pipeline.meshes import Charts, Mesh
from stages.surface.build import build as surface_build
from stages.uv.build import build
from stages.uv.config import Config
from stages.uv.density import MAX_SCALE, SHARE, Front, dense_charts, enlarged, face_share, front_of, scale_for
from stages.uv.unwrap import chart_of_face, signed_areas
from tests.support.analytic_fields import AnalyticField, bumpy_head
from tests.support.faces import face


def quiet(*_: object) -> None:
    pass


@pytest.fixture(scope="module")
def head() -> Mesh:
    return surface_build(AnalyticField(bumpy_head(0.0, 60.0)), 48, quiet).mesh


def landmarks(share: float = 0.7) -> np.ndarray:
    """On the front of the head, about as large as a face is on one."""
    return face() * (share, share, 1.0) + (0, 0, 0.03)


@pytest.mark.slow
def test_the_face_is_a_chart_with_two_fifths_of_the_texels(head: Mesh) -> None:
    plain = build(head, Config(target_faces=4000, proxy_faces=400, texture_size=512, padding=3), quiet)
    made = build(
        head, Config(target_faces=4000, proxy_faces=400, texture_size=512, padding=3), quiet, landmarks=landmarks()
    )
    assert plain.quality.face_share is None
    assert made.quality.face_share is not None and made.quality.face_share == pytest.approx(SHARE, abs=0.01)
    assert made.quality.overlap == 0 and made.quality.flipped == 0 and made.warnings == ()
    assert made.quality.charts <= plain.quality.charts + 6
    assert made.quality.stretch < plain.quality.stretch + 0.05  # the scale of a chart is no stretch
    front = front_of(made.mesh, landmarks())
    assert front is not None
    label = chart_of_face(made.charts.faces, len(made.charts.uvs))
    assert len(np.unique(label[front.face])) == 1
    area = meshes.areas(made.mesh.vertices, made.mesh.faces)
    density = np.sqrt(np.abs(signed_areas(made.charts.uvs.astype(np.float64), made.charts.faces)) / area)
    ratio = np.median(density[front.face]) / np.median(density[~front.region])
    assert 1.2 < ratio <= MAX_SCALE + 0.01


def test_a_small_face_is_enlarged_up_to_a_limit(head: Mesh) -> None:
    area = meshes.areas(head.vertices, head.faces)
    tiny = front_of(head, landmarks(0.2))
    large = front_of(head, landmarks(1.2))
    assert tiny is not None and large is not None
    assert scale_for(tiny, tiny.face, area) == MAX_SCALE
    assert 1 <= scale_for(large, large.face, area) < MAX_SCALE
    everything = np.ones(len(area), np.bool_)
    assert scale_for(large, everything, area) in (1.0, MAX_SCALE)  # nothing is left to be coarser
    assert front_of(head, None) is None and front_of(head, face() + (0, 5, 0)) is None


def test_the_share_is_that_in_the_texture_and_a_ring_around_the_face_is_not_enlarged() -> None:
    """Four squares of two triangles: the face, which the chart made half as large as it is; a ring around it; and two
    of the rest."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    small = square * np.sqrt(0.5)
    uvs = np.concatenate([small, square + 3, square + 5, square + 7])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(4)]).astype(np.int32)
    label = np.repeat(np.arange(4), 2)
    face = label == 0
    front = Front(face, label <= 1)
    true = np.full(8, 0.5)
    assert dense_charts(label, front, true).tolist() == [True, False, False, False]
    made = enlarged(uvs, faces, label, front, true)
    np.testing.assert_array_equal(made[4:], uvs[4:])
    assert face_share(Charts(made.astype(np.float32), faces), face) == pytest.approx(SHARE, abs=1e-6)
    assert face_share(Charts(uvs.astype(np.float32), faces), face) == pytest.approx(0.5 / 3.5, abs=1e-6)


def test_which_places_are_in_the_face() -> None:
    points = landmarks()
    frame = head_frame(points)
    nose, back, top = np.array([[0, 0, 0.09], [0, 0, -0.09], [0, 0.2, 0.05]])
    normals = np.array([[0, 0, 1.0], [0, 0, -1.0], [0, 0.5, 0.8]])
    assert on_face(np.stack([nose, back, top]), normals, points).tolist() == [True, False, False]
    assert not on_face(nose[None], -normals[:1], points)[0]  # the inside of a thin sheet
    assert frame.axes[2] @ [0, 0, 1] == pytest.approx(1)
