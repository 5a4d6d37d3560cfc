"""The deformation of a ball onto balls: what is seen is met, what is not keeps its shape."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation
from support.ball_head import RADIUS, ball_scan, ball_template

from pipeline.meshes import unit
from pipeline.registration.cage import Cage, cage_of
from pipeline.registration.nonrigid import Fitted, Guides, _around, fitted, rotations
from pipeline.registration.scan import Scan
from pipeline.template.model import Template


def none(cage: Cage) -> Guides:
    return Guides(csr_array((0, len(cage.of_template))), np.zeros((0, 3)), np.zeros(0))


def fit(template: Template, scan: Scan, guides: Guides | None = None) -> tuple[Cage, Fitted]:
    cage = cage_of(template)
    rest = template.vertices[cage.of_template]
    return cage, fitted(cage, rest, scan, guides or none(cage), 1.0, lambda: None)


def whole(radius: float) -> Scan:
    mesh = ball_scan(radius)
    return Scan(mesh, np.ones(len(mesh.vertices)))


@pytest.mark.parametrize("radius", [0.097, 0.104])
def test_the_limit_surface_lies_on_the_scan(radius: float) -> None:
    cage, found = fit(ball_template(), whole(radius))
    away = np.linalg.norm(cage.points(found.vertices), axis=1) - radius
    assert np.abs(away).max() < 1e-4 and found.folded == 0 and found.pierced == 0


def test_what_nobody_sees_keeps_its_shape() -> None:
    """Only the front of a scan that is 4 mm off is seen: the back moves with it, and its edges keep their lengths."""
    mesh = ball_scan(RADIUS, centre=(0, 0, 0.004))
    template = ball_template()
    cage, found = fit(template, Scan(mesh, (mesh.vertices[:, 2] > 0.03).astype(float)))
    rest = template.vertices[cage.of_template]
    back = rest[:, 2] < -0.03
    moved = found.vertices - rest
    assert (np.abs(moved[back, :2]) < 1e-3).all() and np.ptp(moved[back, 2]) < 1e-3
    assert (moved[back, 2] > 0.003).all()
    edges = cage.difference @ rest, cage.difference @ found.vertices
    both = (abs(cage.difference) @ back.astype(float)) == 2
    ratio = np.linalg.norm(edges[1][both], axis=1) / np.linalg.norm(edges[0][both], axis=1)
    assert np.abs(ratio - 1).max() < 0.02


def test_nothing_seen_changes_nothing() -> None:
    mesh = ball_scan(0.11)
    template = ball_template(5)
    cage, found = fit(template, Scan(mesh, np.zeros(len(mesh.vertices))))
    assert np.allclose(found.vertices, template.vertices[cage.of_template], atol=1e-9)


def test_the_scalp_does_not_follow_hair_but_a_bald_one_is_met() -> None:
    template = ball_template(scalp=True)
    at = ball_scan(RADIUS)
    hair = at.vertices * np.where(at.vertices[:, 1:2] > 0.062, 1.1, 1.0).astype(np.float32)
    cage, found = fit(template, Scan(type(at)(hair, at.normals, at.faces), np.ones(len(hair))))
    top = cage.points(found.vertices)
    top = top[top[:, 1] > 0.085]
    assert np.abs(np.linalg.norm(top, axis=1) - RADIUS).max() < 1.5e-3
    cage, found = fit(template, whole(RADIUS + 0.002))
    assert np.abs(np.linalg.norm(cage.points(found.vertices), axis=1) - RADIUS - 0.002).max() < 2e-4


def test_guides_slide_the_skin() -> None:
    """On a ball only the landmarks tell how far it is turned."""
    template = ball_template()
    cage = cage_of(template)
    rest = template.vertices[cage.of_template]
    turn = Rotation.from_rotvec([0, 0.05, 0]).as_matrix()
    guides = Guides(csr_array(np.eye(len(rest))[::4]), (rest @ turn.T)[::4], np.zeros(len(rest[::4])))
    found = fitted(cage, rest, whole(RADIUS), guides, 1.0, lambda: None)
    wanted, got = unit(rest @ turn.T), unit(found.vertices)
    off = np.arccos((wanted * got).sum(1).clip(-1, 1))
    assert off.max() < 0.01  # radians, of 0.05


def test_rotations_are_those_of_a_turned_rest() -> None:
    template = ball_template(4)
    cage = cage_of(template)
    rest = template.vertices[cage.of_template]
    turn = Rotation.from_rotvec([0.4, 2.0, -0.3]).as_matrix()
    edges = cage.difference @ rest
    assert np.allclose(rotations(cage, edges, edges @ turn.T, _around(cage)), turn)
    flat = rotations(cage, edges, edges * [1, 1, 0], _around(cage))
    assert np.allclose(np.linalg.det(flat), 1)


def test_a_cancelled_run_stops() -> None:
    class Stop(Exception):
        pass

    def check() -> None:
        raise Stop

    cage = cage_of(ball_template(3))
    with pytest.raises(Stop):
        fitted(cage, ball_template(3).vertices, whole(0.1), none(cage), 1.0, check)


def test_skin_under_hair_keeps_its_shape_and_is_found_beneath_it() -> None:
    """The upper half is hair: 8 mm off it says nothing; one that the skin would come through pushes it inwards."""
    template = ball_template()
    at = ball_scan(RADIUS)
    hair = at.vertices[:, 1] > 0.02
    beneath = np.where(hair, 0.002, 0.0)
    for thick in (0.008, -0.004):
        moved = at.vertices * np.where(hair, 1 + thick / RADIUS, 1.0).astype(np.float32)[:, None]
        scan = Scan(type(at)(moved, at.normals, at.faces), (~hair).astype(float), beneath)
        cage, found = fit(template, scan)
        own = cage.points(template.vertices[cage.of_template])
        top = own[:, 1] > 0.06
        rest, now = (np.linalg.norm(x[top], axis=1) for x in (own, cage.points(found.vertices)))
        if thick > 0:  # it moves with the lower half, which is met
            assert np.abs(now - rest).max() < 2.5e-3 and np.linalg.norm(found.vertices, axis=1).max() < RADIUS + 2e-3
        else:
            assert now.max() < RADIUS - 0.006 + 5e-4 and rest.min() > RADIUS - 0.004
