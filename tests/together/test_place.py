"""Where a second capture lies: bodies whose outlines are formulas, in similarities that are known."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline import transforms
from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.transforms import F64, apply, similarity
from stages.together.judge import findings, refuse
from stages.together.place import COMMON, Body, agreement, body_of, landmark_distance, place

WIDTH, FOCAL, AWAY = 96, 190.0, 0.8
HEAD = np.array([[0, 0, 0, 0.1, 0.14, 0.12], [0, 0.0, 0.12, 0.03, 0.03, 0.04], [-0.1, -0.03, 0, 0.03, 0.05, 0.02]])
OTHER = np.array([[0, 0, 0, 0.14, 0.1, 0.1], [0, 0.09, 0.05, 0.05, 0.06, 0.06], [0.1, 0.05, 0, 0.06, 0.03, 0.03]])


def photo(index: int, count: int, solid: F64, world_from_body: F64) -> tuple[Camera, np.ndarray]:
    """A camera on a ring and the silhouette of ellipsoids (centre, radii)."""
    angle = 2 * np.pi * index / count
    o = AWAY * np.array([np.sin(angle), 0.5 * np.sin(3 * angle), np.cos(angle)])
    z = -o / np.linalg.norm(o)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    pose = transforms.rigid(np.stack([x, np.cross(z, x), z], 1), o)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, WIDTH / 2], [0, 0, 1]])
    _, d = transforms.rays(K, pose, np.zeros(5), transforms.pixel_centres(3 * WIDTH, 3 * WIDTH) / 3)
    hit = np.zeros(len(d), bool)
    for row in solid:
        p, q = (o - row[:3]) / row[3:], d / row[3:]
        b, c = q @ p, p @ p - 1
        hit |= b * b - (q * q).sum(1) * c > 0
    alpha = hit.reshape(WIDTH, 3, WIDTH, 3).mean((1, 3)).astype(np.float32)
    seen = transforms.rescale_camera(world_from_body, pose)
    camera = Camera(
        index=index, name=f"{index}", width=WIDTH, height=WIDTH, K=transforms.rows(K),
        world_from_cam=transforms.rows(seen), distortion=(0.0,) * 5,
    )  # fmt: skip
    return camera, alpha


MOVED = similarity(1.3, Rotation.from_rotvec([0.1, 0.9, -0.05]).as_matrix(), np.array([0.03, -0.02, 0.04]))


@lru_cache(maxsize=8)
def body(kind: str = "head", moved: bool = False, given: bool = False, views: int = 14) -> Body:
    """A capture of a body. moved: its asset coordinates are other ones. given: its world is that of `head`."""
    solid = HEAD if kind == "head" else OTHER
    m = MOVED if moved else np.eye(4)
    shots = [photo(i, views, solid, m) for i in range(views)]
    radius = 0.22 * transforms.scale_of(m)
    world = np.linalg.inv(m) if given else None
    return body_of([c for c, _ in shots], [a for _, a in shots], radius, None, world, None)


def off(found: F64, true: F64) -> float:
    """Largest displacement of the body's hull, in units of the first capture."""
    points = body(moved=True).hull.shell
    return float(np.linalg.norm(apply(found, points) - apply(true, points), axis=1).max())


TRUE = np.linalg.inv(MOVED)


def test_a_common_world_that_fits_is_taken_as_it_is() -> None:
    found = place(body(given=True), body(moved=True, given=True))
    assert found.source == COMMON and np.allclose(found.matrix, TRUE) and found.agreement > 0.97


@pytest.mark.slow
def test_cameras_without_a_common_world_are_registered_by_outlines() -> None:
    found = place(body(), body(moved=True, views=13))
    assert found.of_world is None and found.agreement > 0.97
    assert off(found.matrix, TRUE) < 0.004  # of a body of .3
    assert transforms.scale_of(found.matrix) == pytest.approx(1 / 1.3, rel=0.01)


@pytest.mark.slow
def test_a_world_that_does_not_fit_is_corrected() -> None:
    wrong = transforms.rigid(Rotation.from_rotvec([0, 0.15, 0]).as_matrix(), np.array([0.02, 0.01, 0])) @ TRUE
    second = replace(body(moved=True), world=wrong)
    found = place(body(given=True), second)
    assert found.source.startswith("outlines") and off(found.matrix, TRUE) < 0.004
    assert found.of_world is not None and found.of_world < 0.9
    kept = place(body(given=True), second, wanted="world")
    assert np.allclose(kept.matrix, wrong) and kept.agreement == found.of_world


@pytest.mark.slow
def test_another_body_is_refused_with_the_figure() -> None:
    found = place(body(), body("other", moved=True))
    assert found.agreement < 0.93
    with pytest.raises(StageError, match="do not show the same subject") as said:
        refuse(found, 0.93)
    assert f"{found.agreement:.3f}" in str(said.value) and "0.93" in str(said.value)


def test_views_that_face_nothing_of_the_other_hull_compare_containment() -> None:
    """A hull from a few directions is too large in all others: it must not count as another body."""
    few = body(views=14)
    arc = replace(few, cameras=few.cameras[:3], alphas=few.alphas[:3])
    assert agreement(few, arc, np.eye(4)) > 0.97


def test_faces_that_differ_are_refused() -> None:
    face = np.random.default_rng(0).normal(0, 0.04, (468, 3))
    first, second = (replace(body(), landmarks=x) for x in (face, face + [0.03, 0, 0]))
    far = landmark_distance(first, second, np.eye(4))
    assert far == pytest.approx(0.03 / np.ptp(face, axis=0).max())
    found = replace(place(body(given=True), body(given=True)), landmarks=far)
    with pytest.raises(StageError, match="different faces or expressions"):
        refuse(found, 0.5)
    assert [f.level for f in findings(replace(found, landmarks=0.005))] == ["good", "good"]
