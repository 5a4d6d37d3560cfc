"""Expressions leave the border of the neck alone, where collar and shoulders begin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from support.ball_head import ball_template

from pipeline.meshes import Mesh, triangles_of, vertex_normals
from pipeline.registration.expressions import transferred
from pipeline.registration.neck import (
    FREE,
    HELD,
    LEVEL,
    OVERLAPPED,
    SUNK,
    covered_neck,
    from_border,
    neck_border,
    neck_share,
    sunk,
)  # fmt: skip
from pipeline.registration.rig import jaw_axis, jaw_weights
from pipeline.registration.scan import Scan
from pipeline.template.load import load_template

TEMPLATE = load_template()
AWAY = from_border(TEMPLATE)
SKIN = np.isin(np.arange(len(TEMPLATE.vertices)), TEMPLATE.part_vertices("skin"))


def test_no_expression_reaches_the_collar() -> None:
    found = transferred(TEMPLATE, TEMPLATE.vertices, np.eye(4))
    jaw = found.names.index("jawOpen")
    for e, name in enumerate(found.names):
        rows = found.vertices[found.starts[e] : found.starts[e + 1]]
        assert not (SKIN[rows] & (AWAY[rows] <= HELD)).any(), name
    rows = slice(found.starts[jaw], found.starts[jaw + 1])
    moved = np.zeros(len(SKIN))
    moved[found.vertices[rows]] = np.linalg.norm(found.offsets[rows], axis=1)
    collar = SKIN & (AWAY > 0.02) & (AWAY < 0.03)
    before = np.linalg.norm(TEMPLATE.expression("jawOpen"), axis=1)
    assert before[collar].max() > 1e-3 and moved[collar].max() < 3e-4
    chin = TEMPLATE.region_weights("lips") > 0
    np.testing.assert_allclose(moved[chin], before[chin], atol=2e-4)  # the mouth opens as before


def test_the_joint_of_the_jaw_leaves_the_collar_too() -> None:
    axis = jaw_axis(TEMPLATE)
    assert axis is not None
    weights = jaw_weights(TEMPLATE, *axis)
    assert weights[SKIN & (AWAY <= HELD)].max() == 0 and weights[TEMPLATE.part_vertices("teeth_lower")].min() == 1


def test_the_share_rises_with_the_distance_from_the_border() -> None:
    border, share = neck_border(TEMPLATE), neck_share(TEMPLATE)
    assert len(border) == 42 and (AWAY[border] == 0).all() and (share[border] == 0).all()
    order = np.argsort(AWAY[SKIN])
    assert (np.diff(share[SKIN][order]) >= 0).all()
    assert (share[AWAY >= FREE] == 1).all() and (share[~SKIN] == 1).all()
    straight = np.linalg.norm(TEMPLATE.vertices[SKIN][:, None] - TEMPLATE.vertices[border][None], axis=2).min(1)
    assert (AWAY[SKIN] >= straight - 1e-12).all() and (AWAY[SKIN] <= 1.6 * straight + 0.01).mean() > 0.9


def test_the_last_ring_lies_beneath_the_scan() -> None:
    depth = sunk(TEMPLATE)
    assert (depth[AWAY <= OVERLAPPED] == SUNK).all() and (depth[AWAY >= LEVEL] == 0).all()
    order = np.argsort(AWAY)
    assert (np.diff(depth[order]) <= 0).all() and (depth[~SKIN] == 0).all()
    assert (sunk(ball_template(4)) == 0).all()


def test_a_template_without_an_open_neck_moves_everywhere() -> None:
    ball = ball_template(4)
    assert (neck_share(ball) == 1).all()
    named = replace(ball, regions={"neck": np.arange(len(ball.quads))})
    assert not len(neck_border(named)) and (neck_share(named) == 1).all()


def collar(low: float, high: float, out: float) -> Scan:
    """The template's skin, whose neck from `low` to `high` metres from the border lies `out` metres further out."""
    skin = triangles_of(TEMPLATE.quads[TEMPLATE.parts["skin"]])
    normals = vertex_normals(TEMPLATE.vertices, skin).astype(np.float64)
    under = ((AWAY[skin] > low) & (AWAY[skin] < high)).all(1)
    points = np.concatenate([TEMPLATE.vertices, TEMPLATE.vertices + out * normals]).astype(np.float32)
    faces = np.concatenate([skin[~under], skin[under] + len(TEMPLATE.vertices)]).astype(np.int32)
    mesh = Mesh(points, np.tile(normals, (2, 1)).astype(np.float32), faces)
    return Scan(mesh, np.ones(len(points)))


def test_what_a_collar_covers_is_found_and_stays_still() -> None:
    covered = covered_neck(TEMPLATE, TEMPLATE.vertices, collar(0.005, 0.05, 0.008), 1.0)
    inside = SKIN & (AWAY > 0.02) & (AWAY < 0.036)
    assert covered[inside].mean() > 0.95 and not covered[AWAY > 0.055].any()
    found = transferred(TEMPLATE, TEMPLATE.vertices, np.eye(4), covered)
    jaw = found.names.index("jawOpen")
    rows = slice(found.starts[jaw], found.starts[jaw + 1])
    moved = np.zeros(len(SKIN))
    moved[found.vertices[rows]] = np.linalg.norm(found.offsets[rows], axis=1)
    before = np.linalg.norm(TEMPLATE.expression("jawOpen"), axis=1)
    assert before[covered].max() > 3e-3 and moved[covered].max() < 3e-4
    lips = TEMPLATE.region_weights("lips") > 0
    assert moved[lips].max() > 0.97 * before[lips].max()
    axis = jaw_axis(TEMPLATE)
    assert axis is not None and jaw_weights(TEMPLATE, *axis, covered)[covered].max() == 0


def test_skin_alone_and_a_shoulder_far_outside_cover_nothing() -> None:
    for out in (0.0, 0.002, 0.05):
        assert not covered_neck(TEMPLATE, TEMPLATE.vertices, collar(0.0, 0.05, out), 1.0).any(), out
    none = np.zeros(len(SKIN), np.bool_)
    assert np.array_equal(neck_share(TEMPLATE, none), neck_share(TEMPLATE))
    ball = ball_template(4)
    assert not covered_neck(ball, ball.vertices, collar(0.005, 0.05, 0.008), 1.0).any()
