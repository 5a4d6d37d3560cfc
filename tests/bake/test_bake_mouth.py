"""A mouth that no photo shows inside is dark there, and its teeth are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import FileRef, Located
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import Charts, Mesh, areas, triangles_of
from pipeline.registration.head import Head
from pipeline.visibility import Occluder
from stages.bake.build import _known
from stages.bake.filling import Filler
from stages.bake.mouth import COLOURS, hidden_tiles, inside_of
from tests.support.analytic_fields import AnalyticField, sphere
from tests.support.ball_head import ball_quads, no_head

NAMES = ("face", "mouth_inside", "teeth")


def head_and_mesh(folder: Path, names: tuple[str, ...] = NAMES) -> tuple[Located[RegisteredHead], Mesh]:
    """A ball whose sides are face but for two: the mouth's inside, and teeth with vertices of their own."""
    directions, quads = ball_quads(4)
    region = np.repeat([0, 0, 0, 0, 1, 2], 16)
    own, flat = np.unique(quads + len(directions) * (region == 2)[:, None], return_inverse=True)
    vertices, quads = 0.08 * directions[own % len(directions)], flat.reshape(-1, 4)
    some = np.zeros(len(vertices), np.float32)
    Head(vertices, quads, np.zeros((4, 2)), 0 * quads, region, 0 * region, some, some, 0).save(folder / "head.npz")
    made = RegisteredHead(registered=True, head=FileRef.of(folder, "head.npz"), regions=names, parts=("skin",))
    mesh = Mesh(vertices.astype(np.float32), (vertices / 0.08).astype(np.float32), triangles_of(quads))
    return Located(made, folder), mesh


def test_unseen_places_have_the_mouth_s_colours(tmp_path: Path) -> None:
    registered, mesh = head_and_mesh(tmp_path)
    found = inside_of(registered, mesh)
    assert found is not None
    faces = mesh.faces.reshape(6, -1, 3)
    inner = np.setdiff1d(faces[4], faces[:4])
    np.testing.assert_allclose(found.colour[inner], np.tile(COLOURS["mouth_inside"], (len(inner), 1)))
    np.testing.assert_allclose(found.colour[np.unique(faces[5])][0], COLOURS["teeth"])
    assert (found.share[inner] == 1).all() and (found.share[np.setdiff1d(faces[:4], faces[4])] == 0).all()
    border = np.intersect1d(faces[4], faces[:4])
    assert len(border) and ((found.share[border] > 0) & (found.share[border] < 1)).all()
    albedo = np.full((len(mesh.vertices), 3), 0.5)
    dark = found.in_place_of(albedo, np.ones(len(albedo), np.bool_))
    assert dark[inner].max() == pytest.approx(0.1) and (dark[np.setdiff1d(faces[:4], faces[4])] == 0.5).all()
    assert (found.in_place_of(albedo, np.zeros(len(albedo), np.bool_)) == 0.5).all()  # photos that show it count


def test_the_bake_takes_them(tmp_path: Path) -> None:
    registered, mesh = head_and_mesh(tmp_path)
    field, inside = AnalyticField(sphere(0.08)), inside_of(registered, mesh)
    around = np.ones(len(mesh.vertices), np.float32)
    known, plain = (_known(field, Filler.of(mesh, (), Occluder(mesh), m, None), around) for m in (inside, None))
    inner = np.setdiff1d(mesh.faces[128:160], mesh.faces[:128])
    assert known.albedo[inner].max() < 0.11 and np.abs(known.albedo - plain.albedo)[mesh.faces[:64]].min() == 0
    assert areas(mesh.vertices, mesh.faces).min() > 0


def test_a_template_without_a_mouth_has_no_inside(tmp_path: Path) -> None:
    registered, mesh = head_and_mesh(tmp_path, ("face", "ears", "neck"))
    assert inside_of(registered, mesh) is None and inside_of(no_head(tmp_path), mesh) is None


def test_tiles_without_skin_s_outside_are_hidden(tmp_path: Path) -> None:
    """Face on tile 1001, the mouth's inside and teeth on 1002, hair of the scan on 1003; and all on one tile."""
    registered, mesh = head_and_mesh(tmp_path)
    tile = np.repeat([0, 0, 0, 0, 1, 1], 32)
    more = np.concatenate([tile, np.full(8, 2)])
    corners = np.array([[0.2, 0.2], [0.4, 0.2], [0.2, 0.4]], np.float32)
    for place, wanted in ((more, {1}), (0 * more, set())):
        uvs = (corners[None] + np.stack([place, 0 * place], -1)[:, None]).reshape(-1, 2).astype(np.float32)
        charts = Charts(uvs, np.arange(len(uvs), dtype=np.int32).reshape(-1, 3))
        assert hidden_tiles(registered, charts) == wanted
    assert hidden_tiles(no_head(tmp_path), charts) == set()
