"""Colours of fitted eyes: read from photos, completed behind the lids, and written at their texels only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline import raster, tangents
from pipeline.artifacts import FileRef, Located, UvMesh
from pipeline.eyes import material
from pipeline.eyes.ball import Eye, turned
from pipeline.eyes.picture import Sights, directions_at, plane, sights
from pipeline.head_artifacts import FittedEye, RegisteredHead
from pipeline.lighting.moving import MovingLight
from pipeline.meshes import Charts, Mesh, triangles_of
from pipeline.registration.head import Head
from pipeline.visibility import Occluder
from stages.bake.detail import shade
from stages.bake.eyes import Eyes, completed, eye_of, painted, painted_eyes, usual_behind_lids
from stages.bake.stage import unfitted_eyes
from stages.bake.texels import Known, sample
from tests.support.analytic_fields import AnalyticField, sphere
from tests.support.ball_head import ball_quads, ball_scan
from tests.support.eyes import IRIS, WHITE, gaze_to, photographed, slit

EYE = Eye(np.zeros(3), 0.012, turned(np.eye(3), gaze_to(6, 3)), 0.006)
VIEWS = [(a, e) for e in (-8, 8) for a in (-30, 0, 30)]
SIDE = 96


def angles() -> np.ndarray:
    """(SIDE, SIDE) angles from the gaze over that of the iris."""
    return np.arccos(directions_at(plane(SIDE))[..., 2]) / np.arcsin(EYE.iris / EYE.radius)


def test_what_no_photo_shows_is_the_ring_s_or_the_sclera_s() -> None:
    angle = angles()
    image = np.where(angle[..., None] < 1, (0.2, 0.1, 0.05), (0.7, 0.6, 0.5)).astype(np.float32)
    image[angle < 0.3] = 0.02
    seen = np.abs(plane(SIDE)[..., 1]) < 0.3
    noise = np.where(seen[..., None], image, 9.0).astype(np.float32)  # what is not seen is not read
    np.testing.assert_allclose(completed(noise, seen, EYE)[angle < 0.95], image[angle < 0.95], atol=0.02)
    np.testing.assert_allclose(completed(noise, seen, EYE)[angle > 1.2], image[angle > 1.2], atol=0.02)
    nothing = completed(noise, np.zeros_like(seen), EYE)
    assert np.ptp(nothing.reshape(-1, 3), axis=0).max() == 0 and 0.4 < nothing.mean() < 0.7


@pytest.mark.parametrize("response", [1.0, 0.5])
def test_the_albedo_is_what_the_photos_show_over_the_light(tmp_path: Path, response: float) -> None:
    field = AnalyticField(sphere(0.012))
    views = photographed(EYE, tmp_path, VIEWS)
    seen = sights(EYE, views, Occluder(slit(EYE)), SIDE)
    made = painted(EYE, seen, field, np.tile(response * np.eye(3), (len(views), 1, 1)), views)
    normals = directions_at(plane(SIDE).reshape(-1, 2)) @ EYE.axes
    lit = shade(field.light, normals, np.ones_like(normals, np.float32)).reshape(SIDE, SIDE, 3)
    shown = (seen.weight > 0).any(0).reshape(SIDE, SIDE) & (np.abs(plane(SIDE)[..., 1]) < 0.15)
    for low, high, wanted in ((0.5, 0.85, IRIS), (1.2, 1.6, WHITE)):
        own = shown & (angles() > low) & (angles() < high)
        assert own.sum() > 20
        np.testing.assert_allclose(made[own], (wanted / lit[own] / response).clip(0, 1), atol=0.06)


SKY = 0.8  # radiance from everywhere
UNIFORM = np.array([[SKY * np.sqrt(4 * np.pi)] * 3] + [[0.0] * 3] * 120, np.float32)


class UnderSky(AnalyticField):
    """A ball under a uniform sky; `carried`: the same as the still part of a light that moves."""

    carried = False

    @property
    def light(self) -> np.ndarray:
        return UNIFORM

    @property
    def moving_light(self) -> MovingLight | None:  # type: ignore[override]
        return MovingLight("camera", 1.0, 0 * UNIFORM, UNIFORM) if self.carried else None


@pytest.mark.parametrize("carried", [False, True])
def test_what_the_wet_surface_reflects_is_not_its_colour(tmp_path: Path, carried: bool) -> None:
    """Photos by the formula, a L + F L under a uniform sky of radiance L: Schlick's F at each photo's own angle."""
    field = UnderSky(sphere(0.012))
    field.carried = carried
    views = photographed(EYE, tmp_path, [(-40, 0), (40, 0)])
    directions = directions_at(plane(SIDE).reshape(-1, 2))
    x, n = EYE.points(directions), directions @ EYE.axes
    albedo = np.where(np.arange(SIDE * SIDE)[:, None] % 2 == 0, 0.05, 0.4) * np.ones(3)
    colours = []
    for view in views:
        way = np.asarray(view.camera.world_from_cam).reshape(4, 4)[:3, 3] - x
        cosine = ((way / np.linalg.norm(way, axis=1, keepdims=True)) * n).sum(1).clip(0, 1)
        f0 = ((1.376 - 1) / (1.376 + 1)) ** 2
        colours.append(albedo * SKY + (f0 + (1 - f0) * (1 - cosine) ** 5)[:, None] * SKY)
    shape = (len(views), SIDE * SIDE)
    seen = Sights(np.array(colours, np.float32), np.ones(shape, np.float32), np.ones(len(views)), (0, 1), SIDE)
    made = painted(EYE, seen, field, np.tile(np.eye(3), (len(views), 1, 1)), views)
    inner = np.s_[20:-20, 20:-20]
    np.testing.assert_allclose(made[inner], albedo.reshape(SIDE, SIDE, 3)[inner], atol=4e-3)


def test_only_the_eye_s_texels_get_its_surface() -> None:
    """Two balls side by side on one tile, one of them an eye."""
    ball = ball_scan(0.012, 8)
    count = len(ball.vertices)
    vertices = np.concatenate([ball.vertices, ball.vertices + np.float32([0.05, 0, 0])])
    mesh = Mesh(vertices, np.tile(ball.normals, (2, 1)), np.concatenate([ball.faces, ball.faces + count]))
    corners = np.random.default_rng(0).random((len(mesh.faces), 1, 2)) * 0.9 + [[0, 0], [0.05, 0], [0, 0.05]]
    charts = Charts(
        corners.reshape(-1, 2).astype(np.float32), np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3)
    )
    hits = raster.rasterise(raster.texel_corners(charts, 64), 64, 0, 64)
    image = np.full((16, 16, 3), 0.33, np.float32)
    of_vertex = np.where(np.arange(2 * count) < count, 0, -1)
    known = Known(*(np.full(2 * count, v, np.float32) for v in (1, 0, 0)), np.zeros((2 * count, 3), np.float32),
                  eyes=Eyes(of_vertex, (EYE,), (image,)))  # fmt: skip
    field, frame = AnalyticField(sphere(0.012)), tangents.frames(mesh, charts)
    found = sample(field, mesh, frame, hits, known)
    plain = sample(field, mesh, frame, hits, Known(known.ambient, known.unseen, known.replaced, known.albedo))
    eye = mesh.faces[hits.face, 0] < count
    assert eye.any() and (~eye).any()
    np.testing.assert_allclose(found.base_color[eye], 0.33, atol=1e-6)
    assert (found.f0[eye] == np.float32(material.F0)).all() and (found.roughness[eye] == np.float32(0.1)).all()
    assert (found.normal[eye] == [0, 0, 1]).all() and (found.displacement[eye] == 0).all()
    for name in ("base_color", "albedo", "f0", "roughness", "normal", "displacement"):
        assert (getattr(found, name)[~eye] == getattr(plain, name)[~eye]).all()


def test_behind_the_lids_the_correction_is_the_eye_s_usual_one() -> None:
    """Traced light behind a lid is about 0: the largest ratio there, which no photo asks for. Where the eye is shown it
    stays."""
    ball = ball_scan(0.012, 16)
    mesh = Mesh(ball.vertices, ball.normals, ball.faces)
    angle = np.degrees(np.arccos((ball.normals[:, 2]).clip(-1, 1)))
    shown = angle < 35
    ratio = np.where(shown[:, None], 1.2 + 0.1 * ball.normals[:, :1], 2.5) * np.ones(3)
    eyes = Eyes(np.zeros(len(ball.vertices), np.int64), (EYE,), (np.zeros((4, 4, 3), np.float32),))
    found = usual_behind_lids(eyes, mesh, ratio, shown)
    np.testing.assert_allclose(found[shown], ratio[shown], atol=0.01)
    np.testing.assert_allclose(found[angle > 60], 1.2, atol=0.02)
    hidden = usual_behind_lids(eyes, mesh, ratio, np.zeros(len(shown), np.bool_))
    np.testing.assert_array_equal(hidden, 1)
    other = replace(eyes, of_vertex=np.full(len(shown), -1))
    np.testing.assert_allclose(usual_behind_lids(other, mesh, ratio, shown), ratio, rtol=1e-6)


def test_the_cornea_reflects_as_its_index_says() -> None:
    assert pytest.approx(0.0250, abs=1e-4) == material.F0


def test_eyes_are_found_among_the_textured_mesh_s_faces(tmp_path: Path) -> None:
    """A head of two balls, the second an eye; hair after both."""
    directions, quads = ball_quads(3)
    n, q = len(directions), len(quads)
    vertices = np.concatenate([0.1 * directions, 0.012 * directions])
    every = np.concatenate([quads, quads + n])
    part = np.repeat([0, 1], q)
    some = np.zeros(2 * n, np.float32)
    head = Head(vertices, every, np.zeros((4, 2)), np.zeros_like(every), 0 * part, part, some, some, 0)
    head.save(tmp_path / "head.npz")
    axes = tuple(tuple(float(x) for x in row) for row in EYE.axes)
    stored = FittedEye(part="eye_left", centre=(0, 0, 0), radius=0.012, iris=0.006, axes=axes)
    registered = RegisteredHead(registered=True, head=FileRef.of(tmp_path, "head.npz"), regions=("face",),
                                parts=("skin", "eye_left"), eyes=(stored,))  # fmt: skip
    faces = np.concatenate([triangles_of(every), [[0, 1, 2]]]).astype(np.int32)
    mesh = Mesh(vertices.astype(np.float32), np.tile(directions, (2, 1)).astype(np.float32), faces)
    field = AnalyticField(sphere(0.1))
    found = painted_eyes(Located(registered, tmp_path), field, mesh, (), np.zeros((0, 3, 3)))
    assert found is not None and (found.of_vertex == np.repeat([-1, 0], n)).all()
    rows, albedo = found.at(mesh.faces[:, 0].astype(np.int64), vertices[mesh.faces[:, 0]])
    assert (rows == np.arange(2 * q, 4 * q)).all() and albedo.shape == (2 * q, 3)
    np.testing.assert_allclose(eye_of(stored).axes, EYE.axes)
    none = Located(registered.model_copy(update={"eyes": ()}), tmp_path)
    assert painted_eyes(none, field, mesh, (), np.zeros((0, 3, 3))) is None


def test_eyes_that_are_not_fitted_are_said(tmp_path: Path) -> None:
    head = RegisteredHead(registered=True, eyes_reason="eye_left: the iris is 4 pixels across, fewer than 6")
    ref = FileRef(path="uv.npz", sha256="", size=0)
    uv = UvMesh(mesh=ref, vertices=1, faces=1, charts=1, utilisation=0.5, stretch=1.0, overlap=0.0, deviation_mm=0.1,
                of_template=True)  # fmt: skip
    assert "4 pixels across" in unfitted_eyes(head, uv)[0]
    assert unfitted_eyes(head, uv.model_copy(update={"of_template": False})) == ()
    assert unfitted_eyes(head.model_copy(update={"eyes_reason": ""}), uv) == ()
