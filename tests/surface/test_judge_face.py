"""The face's judge on made-up heads: an ellipsoid whose landmarks are known, seen by made-up cameras, and its ruins."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import CameraSet, FileRef, FittedFace, Located, MaskSet
from pipeline.meshes import Mesh, vertex_normals
from pipeline.transforms import rows
from pipeline.verdict import Finding
from stages.surface.judge_face import NOSE, OUTER, STABLE, Landmarks, face_findings, judge_face, read
from tests.pipeline.test_landmarks3d import CAMERAS, F64, face, seen

RADII = np.array([0.4, 0.5, 0.4]) * 0.18  # of the ellipsoid that carries the landmarks


def ellipsoid(scale: float = 1.0, shift: tuple[float, float, float] = (0, 0, 0), side: int = 200) -> Mesh:
    """A closed mesh around the origin."""
    theta = np.linspace(0, np.pi, side)
    phi = np.linspace(0, 2 * np.pi, 2 * side, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    x = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], -1).reshape(-1, 3) * RADII * scale
    i, j = np.meshgrid(np.arange(side - 1), np.arange(2 * side), indexing="ij")
    a, b = i * 2 * side + j, i * 2 * side + (j + 1) % (2 * side)
    c, d = a + 2 * side, b + 2 * side
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3).astype(np.int32)
    vertices = (x + np.array(shift)).astype(np.float32)
    return Mesh(vertices, vertex_normals(vertices, faces), faces)


def on_the_ellipsoid() -> F64:
    """(468, 3) the made-up face, all of it on the ellipsoid's surface."""
    x = face() / RADII
    return x / np.linalg.norm(x, axis=1, keepdims=True) * RADII


def landmarks(noise: float = 0.5, scale: float = 1.0) -> Landmarks:
    """As the network finds them."""
    x = on_the_ellipsoid() * scale
    return Landmarks(CAMERAS, seen(CAMERAS, x, noise), x)


def by_name(mesh: Mesh, found: Landmarks | None = None, *, metric: bool = True) -> dict[str, Finding]:
    return {f.check: f for f in judge_face(mesh, found or landmarks(), metric=metric)}


CHECKS = {"face_shape_mm", "nose_buried_mm", "face_reprojection_mm"}


def test_a_face_in_its_place_is_good() -> None:
    found = by_name(ellipsoid())
    assert set(found) == CHECKS and {f.level for f in found.values()} == {"good"}
    assert found["face_shape_mm"].value == pytest.approx(0.0, abs=0.2)


def test_a_face_inside_a_blob() -> None:
    """The hull of an arc of cameras: the mesh reaches 30 mm further to the front."""
    found = by_name(ellipsoid(1.0, (0, 0, 0.03)))
    assert {found["face_shape_mm"].level, found["nose_buried_mm"].level} == {"unusable"}
    value = found["nose_buried_mm"].value  # of the eyes, whose rays cross the blob askew
    assert value is not None and 28 < value < 45 and "behind the mesh" in found["nose_buried_mm"].said
    assert found["face_reprojection_mm"].level != "good"


def test_a_nose_alone_inside() -> None:
    """A cap before the nose, 15 mm off it, and the rest of the face right: the median of all landmarks is small."""
    head = ellipsoid()
    vertices = head.vertices.copy()
    tip = on_the_ellipsoid()[list(NOSE)].mean(0)
    near = np.linalg.norm(vertices - tip, axis=1) < 0.02
    vertices[near] += np.array([0, 0, 0.02], np.float32)
    found = by_name(replace(head, vertices=vertices), landmarks(0.0))
    assert found["nose_buried_mm"].level == "unusable" and found["nose_buried_mm"].said.startswith("nose")
    assert found["face_shape_mm"].level == "good"


def test_a_face_behind_its_place_is_of_the_wrong_shape_but_not_buried() -> None:
    found = by_name(ellipsoid(1.0, (0, 0, -0.03)))
    assert found["face_shape_mm"].level == "unusable" and found["nose_buried_mm"].level == "good"


def test_a_mesh_without_the_head() -> None:
    found = by_name(ellipsoid(0.5, (0, -0.4, 0)))
    assert found["face_shape_mm"].level == "unusable" and found["face_shape_mm"].value is None
    assert "not on the mesh" in found["face_shape_mm"].said
    assert found["face_reprojection_mm"].level == "unusable" and found["nose_buried_mm"].level == "good"


def test_a_capture_without_a_scale_is_measured_by_the_eyes() -> None:
    """The same head and blob ten times as large: figures are as those of a head whose eyes are 88 mm apart."""
    large = [c.model_copy(update={"world_from_cam": rows(_moved(c.world_from_cam, 10))}) for c in CAMERAS]
    x = on_the_ellipsoid() * 10
    found = Landmarks(large, seen(large, x, 0.5), x)
    apart = float(np.linalg.norm(np.subtract(*on_the_ellipsoid()[list(OUTER)])))
    shape = by_name(ellipsoid(10, (0, 0, 0.3)), found, metric=False)["nose_buried_mm"]
    same = by_name(ellipsoid(1, (0, 0, 0.03)))["nose_buried_mm"]
    assert shape.value is not None and same.value is not None
    assert shape.value == pytest.approx(same.value * 0.088 / apart, rel=0.05)


def _moved(pose: object, factor: float) -> F64:
    out = np.array(pose, np.float64)
    out[:3, 3] *= factor
    return out


def test_photos_from_behind_and_from_the_side_have_no_say() -> None:
    """The network's guesses for a turned face are wild."""
    found = landmarks()
    uv = found.uv.copy()
    turned = [n for n, c in enumerate(CAMERAS) if abs(c.world_from_cam[0][3]) > 0.6]
    assert len(turned) == 6  # those 50 degrees to the side
    uv[turned] += 200
    assert {f.level for f in judge_face(ellipsoid(), replace(found, uv=uv), metric=True)} == {"good"}


@pytest.mark.parametrize("count", [0, 2])
def test_too_few_photos(count: int) -> None:
    found = landmarks()
    assert (
        judge_face(ellipsoid(), Landmarks(CAMERAS[6 : 6 + count], found.uv[6 : 6 + count], found.xyz), metric=True)
        == ()
    )


def test_a_landmark_without_a_place() -> None:
    found = landmarks()
    lost = found.xyz.copy()
    lost[0] = np.nan  # a lip
    assert {f.level for f in judge_face(ellipsoid(), replace(found, xyz=lost), metric=True)} == {"good"}
    lost[STABLE[0]] = np.nan
    assert judge_face(ellipsoid(), replace(found, xyz=lost), metric=True) == ()


class Stage:
    """The inputs that are read."""

    def __init__(self, folder: Path, masks: MaskSet) -> None:
        poses = CameraSet(
            source="given", metric=True, capture_from_asset=rows(np.eye(4)), roi_radius=0.12, cameras=tuple(CAMERAS)
        )
        self.poses, self.masks = Located(poses, folder), Located(masks, folder)
        fitted = FittedFace.model_construct(refined=())
        self.inverse_rendering = Located(fitted, folder)


def test_from_the_masks_file(tmp_path: Path) -> None:
    """Photos that disagree with the face, and one without a camera, are left out."""
    found = landmarks()
    uv = found.uv.copy()
    uv[3] += 500
    views = np.array([c.index for c in CAMERAS], np.int32)
    views[5] = 99
    kept = np.arange(len(views)) != 3
    np.savez(tmp_path / "landmarks.npz", views=views, uv=uv.astype(np.float32), xyz=found.xyz, kept=kept)
    back = read(tmp_path / "landmarks.npz", {c.index: c for c in CAMERAS})
    assert [c.index for c in back.cameras] == [i for i in range(len(CAMERAS)) if i not in (3, 5)]
    masks = MaskSet(masks=(), landmarks=FileRef.of(tmp_path, "landmarks.npz"))
    assert {f.check: f.level for f in face_findings(Stage(tmp_path, masks), ellipsoid())} == dict.fromkeys(
        CHECKS, "good"
    )
    assert face_findings(Stage(tmp_path, MaskSet(masks=())), ellipsoid()) == ()
