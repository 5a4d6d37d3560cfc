"""A field on a moved and a deformed mesh, against closed forms, and every mesh that is not its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.errors import StageError
from pipeline.meshes import unit, vertex_normals
from pipeline.ray_casting import RayCaster
from stages.reflectance.deform import deformed, least_rotations, moved, nearest_rotations, vertex_rotations, write_rest
from stages.reflectance.field import Field, Lamp
from stages.reflectance.texels import arriving
from tests.reflectance.test_field import RADIUS, field_of

TURN = Rotation.from_euler("xyz", [20, 55, -30], degrees=True).as_matrix()
LAMP = Lamp(np.array([0.3, 0.4, 1.2]), -np.array([0.3, 0.4, 1.2]) / 1.3, np.array([4.0, 3, 2]))
EYE = np.array([0.1, 0.2, 1.0])


def uneven() -> Field:
    """A field whose normals, rest and corrections of shadows differ from texel to texel and with the direction."""
    field = field_of(np.array([0.5, 0.4, 0.3]), 0.02)
    rng = np.random.default_rng(3)
    field.normal = field.normal + rng.normal(0, 0.1, field.normal.shape)
    field.normal /= np.linalg.norm(field.normal, axis=1, keepdims=True)
    field.arrays["rest"] = rng.uniform(-0.02, 0.05, field.arrays["rest"].shape).astype(np.float32)
    field.arrays["shadow"] = -rng.uniform(0, 1, field.arrays["shadow"].shape).astype(np.float32)
    field.arrays["trust"] = rng.uniform(0, 1, field.arrays["trust"].shape).astype(np.float32)
    return field


def test_a_turned_head_under_a_turned_lamp_looks_the_same() -> None:
    """Oracle: the whole scene is turned rigidly about the stage's centre; nothing that is seen changes."""
    field = uneven()
    other = moved(field, field.mesh.vertices.astype(float) @ TURN.T)
    turned = Lamp(TURN @ LAMP.position, TURN @ LAMP.axis, LAMP.strength)
    before = field.radiance(LAMP, EYE, field.arrives(LAMP))
    after = other.radiance(turned, TURN @ EYE, other.arrives(turned))
    same = np.abs(after - before).max(1) < 1e-3  # rays at the terminator may fall on either side
    assert same.mean() > 0.995 and before.max() > 0.3
    wrong = other.radiance(LAMP, EYE, other.arrives(LAMP))
    assert np.abs(wrong - before).max(1).mean() > 0.02


def test_a_mesh_that_did_not_move_changes_nothing() -> None:
    field = uneven()
    same = moved(field, field.mesh.vertices.astype(float))
    a, b = (f.radiance(LAMP, EYE, f.arrives(LAMP)) for f in (field, same))
    np.testing.assert_allclose(a, b, atol=2e-4)
    twice = moved(moved(field, field.mesh.vertices @ TURN.T), field.mesh.vertices.astype(float))
    np.testing.assert_allclose(twice.normal, field.normal, atol=1e-4)


def test_one_turn_after_another_is_their_product() -> None:
    field, v = uneven(), uneven().mesh.vertices.astype(float)
    other = Rotation.from_rotvec([0.9, -0.4, 0.2]).as_matrix()
    twice = moved(moved(field, v @ TURN.T), v @ TURN.T @ other.T)
    assert twice.turn is not None and np.abs(other @ TURN - TURN @ other).max() > 0.1
    np.testing.assert_allclose(twice.turn, np.broadcast_to(other @ TURN, twice.turn.shape), atol=1e-5)


def test_normals_of_a_stretched_ball_are_an_ellipsoids() -> None:
    """Oracle: the gradient of x^2 / a^2 + y^2 / b^2 + z^2 / c^2."""
    field, axes = field_of(np.full(3, 0.5)), np.array([1.4, 0.8, 1.1])
    field.normal = field.points.normal.copy()
    made = moved(field, field.mesh.vertices.astype(float) * axes)
    expected = made.points.position / axes**2
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    off = np.degrees(np.arccos(np.clip((made.normal * expected).sum(1), -1, 1)))
    assert np.median(off) < 1 and np.quantile(off, 0.99) < 4
    np.testing.assert_allclose(np.linalg.norm(made.normal, axis=1), 1, atol=1e-6)
    before, after = (
        unit((mesh.normals.astype(float)[mesh.faces[field.points.face]] * field.points.weights[..., None]).sum(1))
        for mesh in (replace(field.mesh, normals=vertex_normals(field.mesh.vertices, field.mesh.faces)), made.mesh)
    )  # what was the mesh's own normal is so again
    assert made.turn is not None
    np.testing.assert_allclose(np.einsum("tij,tj->ti", made.turn, before), after, atol=1e-6)


def test_a_dent_is_in_the_shadow_of_its_wall() -> None:
    """Oracle: rays against the dented mesh itself."""
    field = field_of(np.full(3, 0.5))
    v = field.mesh.vertices.astype(float)
    cosine = v[:, 2] / np.linalg.norm(v, axis=1)
    dented = v * (1 - 0.7 * np.clip((cosine - 0.9) / 0.04, 0, 1))[:, None]
    made = moved(field, dented)
    lamp = Lamp(np.array([1.3, 0, 0.25]), -np.array([1.3, 0, 0.25]) / np.hypot(1.3, 0.25), np.ones(3))
    floor = field.points.position[:, 2] / RADIUS > 0.97
    assert field.arrives(lamp)[floor].min() > 0.9 and made.arrives(lamp)[floor].mean() < 0.3
    direct = arriving(made.points, RayCaster(made.mesh.vertices, made.mesh.faces), lamp.position, lamp.axis)
    np.testing.assert_allclose(made.arrives(lamp), direct * direct * (3 - 2 * direct), atol=1e-6)


def test_rotations() -> None:
    """Oracle: scipy's; opposite vectors and collapsed triangles stay finite."""
    rng = np.random.default_rng(0)
    turns = Rotation.random(20, random_state=0).as_matrix()
    stretch = np.stack([np.diag(rng.uniform(0.5, 2, 3)) for _ in range(20)])
    np.testing.assert_allclose(nearest_rotations(turns @ stretch), turns, atol=1e-9)
    mirrored = nearest_rotations(turns @ np.diag([1.0, 1, -0.5]))
    np.testing.assert_allclose(np.linalg.det(mirrored), 1)
    a, b = rng.normal(size=(2, 30, 3))
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    b[0], b[1] = -a[0], a[1]
    found = least_rotations(a, b)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(np.einsum("nij,nj->ni", found, a)[1:], b[1:], atol=1e-9)
    np.testing.assert_allclose(found[1], np.eye(3), atol=1e-12)
    angle = Rotation.from_matrix(found[2:]).magnitude()
    np.testing.assert_allclose(angle, np.arccos((a * b).sum(1))[2:], atol=1e-6)
    faces = np.array([[0, 1, 2], [0, 1, 1]], np.int32)
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5.0]])
    np.testing.assert_allclose(vertex_rotations(square, square @ TURN.T, faces)[:3], [TURN] * 3, atol=1e-9)
    np.testing.assert_allclose(vertex_rotations(square, square @ TURN.T, faces)[3], np.eye(3))


def test_its_own_file_comes_back(tmp_path: Path) -> None:
    field = field_of(np.full(3, 0.5))
    write_rest(tmp_path / "rest.obj", field.mesh, field.charts)
    same = deformed(field, tmp_path / "rest.obj")
    np.testing.assert_allclose(same.points.position, field.points.position, atol=1e-6)
    lines = (tmp_path / "rest.obj").read_text().splitlines()
    bare = [" ".join(w.split("/")[0] for w in x.split()) if x.startswith("f") else x for x in lines if x[:2] != "vt"]
    (tmp_path / "bare.obj").write_text("\n".join([*bare, "s off", "usemtl x"]))  # no texture coordinates: as good
    assert len(deformed(field, tmp_path / "bare.obj").known) == len(field.known)


def edit(change: Callable[[list[str]], list[str]]) -> Callable[[str], str]:
    return lambda text: "\n".join(change(text.splitlines()))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda t: t + "v 0 0 0\n", "another number of vertices"),
        (edit(lambda x: x[:-1]), "another number of faces"),
        (edit(lambda x: [*x[:-2], x[-1], x[-2]]), "joins other vertices"),
        (edit(lambda x: [f"vt {i % 7 / 7} 0.5" if w[:2] == "vt" else w for i, w in enumerate(x)]), "other texture"),
        (
            edit(lambda x: [f"v {' '.join(w[2:].replace('.', '').split())}" if w[:2] == "v " else w for w in x]),
            "another size",
        ),
        (edit(lambda x: ["v nan 0 0" if i == 5 else w for i, w in enumerate(x)]), "line 6"),
        (edit(lambda x: ["v 1 2" if i == 5 else w for i, w in enumerate(x)]), "line 6"),
        (edit(lambda x: [*x[:-1], "f 1/1 2/2 3/3 4/4"]), "a face of 4 corners"),
        (edit(lambda x: [*x[:-1], "f 1/1 2/2 99999999/3"]), "99999999 of"),
        (lambda t: "", "another number of vertices"),
    ],
)
def test_another_mesh_is_refused(tmp_path: Path, change: Callable[[str], str], told: str) -> None:
    field = field_of(np.full(3, 0.5))
    path = tmp_path / "rest.obj"
    write_rest(path, field.mesh, field.charts)
    path.write_text(change(path.read_text()))
    with pytest.raises(StageError) as found:
        deformed(field, path)
    assert told in str(found.value) and "rest.obj" in found.value.remedy


def test_no_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="no such file"):
        deformed(field_of(np.full(3, 0.5)), tmp_path / "no.obj")
    (tmp_path / "a.fbx").write_text("x")
    with pytest.raises(StageError, match=r"a \.fbx file"):
        deformed(field_of(np.full(3, 0.5)), tmp_path / "a.fbx")
