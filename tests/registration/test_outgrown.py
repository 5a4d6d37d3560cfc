"""Where the surface reaches further than the template, the template is pulled along; elsewhere it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array
from support.ball_head import RADIUS, ball_quads, ball_scan, ball_template

from pipeline.meshes import Mesh
from pipeline.registration import refine_identity
from pipeline.registration.cage import cage_of
from pipeline.registration.identity_fit import Data, PlacedHead
from pipeline.registration.nonrigid import Guides, fitted
from pipeline.registration.outgrown import COVERED, OUTSIDE, REACH, ROOT, _in_boxes, growing, outgrown
from pipeline.registration.scan import Scan
from pipeline.template.model import Template

N, QUADS = ball_quads(6)


def lug(out: float, scale: float = 1.0) -> Mesh:
    """A ball with a lug that stands out at +x by `out`."""
    ball = ball_scan(RADIUS * scale)
    share = np.clip((ball.vertices[:, 0] / scale - 0.085) / 0.015, 0, 1)
    moved = ball.vertices + (share * out * scale)[:, None].astype(np.float32) * np.float32([1, 0, 0])
    return Mesh(moved.astype(np.float32), ball.normals, ball.faces)


def eared(n: int = 10) -> Template:
    """A ball whose quads beyond x = 0.07 are an ear."""
    template = ball_template(n)
    ear = template.vertices[template.quads].mean(1)[:, 0] > 0.07
    return replace(template, regions={"face": np.flatnonzero(~ear), "ears": np.flatnonzero(ear)})


@pytest.mark.parametrize("scale", [0.2, 1.0, 40.0])
def test_the_places_are_those_that_stand_out(scale: float) -> None:
    """By a search of every point of the surface for its nearest of the template."""
    mesh = lug(0.008, scale)
    seen = np.where(mesh.vertices[:, 1] > 0, 1.0, 0.0)
    points, grows = RADIUS * scale * N, N[:, 0] > 0.7
    found = outgrown(points, N, grows, Scan(mesh, seen), scale)
    expected = set()
    for q in mesh.vertices[seen > 0].astype(float):
        away = np.linalg.norm(points - q, axis=1)
        p = int(away.argmin())
        out = (q - points[p]) @ N[p] >= OUTSIDE * away[p]
        if grows[p] and out and COVERED * scale < away[p] < REACH * scale:
            expected.add(p)
    assert expected and set(found.rows.tolist()) == expected
    toward = found.where - points[found.rows]
    np.testing.assert_allclose(np.linalg.norm(found.directions, axis=1), 1)
    np.testing.assert_allclose(np.cross(toward, found.directions), 0, atol=1e-9 * scale)
    assert (found.weight == 1).all() and (toward[:, 0] > 0).all()


def test_what_is_unseen_or_covered_or_inside_does_not_pull() -> None:
    points, grows = RADIUS * N, np.ones(len(N), bool)
    for mesh, seen in ((lug(0.008), 0.0), (lug(-0.008), 1.0), (lug(0.02), 0.0), (ball_scan(RADIUS), 1.0)):
        at = Scan(mesh, np.full(len(mesh.vertices), seen))
        flat = outgrown(points, N, grows, at, 1.0)
        assert (np.linalg.norm(flat.where - points[flat.rows], axis=1) < 0.006).all() if len(flat.rows) else True
        assert not len(outgrown(points, N, ~grows, at, 1.0).rows)
    unseen = lug(0.008)
    assert not len(outgrown(points, N, grows, Scan(unseen, np.zeros(len(unseen.vertices))), 1.0).rows)


def test_the_root_of_an_ear_does_not_grow() -> None:
    """By the distance to every other point; a template that is all ear grows everywhere."""
    n = ball_quads(30)[0]
    points, ears = RADIUS * n, n[:, 0] > 0.7
    away = np.linalg.norm(points[:, None] - points[~ears][None], axis=2).min(1)
    may = growing(points, ears)
    assert (may == (ears & (away > ROOT))).all() and 0 < may.sum() < ears.sum()
    assert growing(points, np.ones(len(n), bool)).all() and not growing(points, np.zeros(len(n), bool)).any()


def test_a_small_ear_grows_to_the_one_that_photos_show() -> None:
    """A lug of 8 mm whose side walls are steep: the nearest places alone leave its end bare."""
    template = eared()
    cage, mesh = cage_of(template), lug(0.008)
    none = Guides(csr_array((0, len(cage.of_template))), np.zeros((0, 3)), np.zeros(0))
    rest = template.vertices[cage.of_template]
    scan = Scan(mesh, np.ones(len(mesh.vertices)))
    ends = [cage.points(fitted(c, rest, scan, none, 1.0, lambda: None).vertices)[:, 0].max()
            for c in (cage, replace(cage, grows=np.zeros_like(cage.grows)))]  # fmt: skip
    assert ends[0] > mesh.vertices[:, 0].max() - 0.001
    assert ends[1] < ends[0]


def test_the_identity_is_asked_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The data that reach the solver: landmarks, pairs, then ear vertices pulled along their directions."""
    template, mesh, given = eared(), lug(0.008), []

    def place(template: Template, data: tuple[Data, ...], start: PlacedHead) -> PlacedHead:
        given.append(data)
        return start

    monkeypatch.setattr(refine_identity, "place", place)
    head = PlacedHead(np.eye(4), np.zeros(0), template.vertices, np.zeros(0), 0.0)
    refine_identity.refined(template, np.full((468, 3), np.nan), head, Scan(mesh, np.ones(len(mesh.vertices))))
    more = given[0][2]
    assert len(more.where) and more.normals is not None and (more.normals[:, 0] > 0.5).all()
    assert (template.vertices[more.corners[:, 0], 0] > 0.06).all() and (more.sigma > 0).all()


def test_boxes_leave_out_no_vertex_within_reach() -> None:
    """Against all distances, for points on two sides and on one."""
    random = np.random.default_rng(4)
    vertices = random.uniform(-0.1, 0.1, (3000, 3)).astype(np.float32)
    sides = np.concatenate([random.normal([x, 0, 0], 0.005, (40, 3)) for x in (-0.08, 0.08)])
    for points in (sides, sides[:1], sides[:40]):
        inside = _in_boxes(vertices, points, 0.01)
        near = np.linalg.norm(vertices[:, None] - points[None], axis=2).min(1) <= 0.01
        assert near.any() and inside[near].all() and inside.mean() < 0.2
    assert not _in_boxes(vertices, sides[:0], 0.01).any()
