"""The template stage through its contract: refusals, checks, and the mesh that the uv stage makes of its head."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline import meshes, tiles
from pipeline.artifacts import Camera, CameraSet, FileRef, Located, MaskSet, Surface, ViewMask
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.head_artifacts import RegisteredHead
from pipeline.registration.facets import raised
from pipeline.registration.head import Head
from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.subdivision import subdivided
from pipeline.template.load import OWN, load_template
from stages.presets import configs_for
from stages.template.config import folder_digest
from stages.template.judge import faults, judge, refused_faces, refused_fit, refused_irises, refused_placing
from stages.template.register import ADULT, iris_pixels
from stages.template.stage import Config, Inputs, run
from stages.uv import stage as uv_stage
from stages.uv.config import Config as UvConfig
from tests.support.ball_head import ball_scan, ball_template, no_head
from tests.support.textured_ball import camera_on_orbit

GOOD = {
    "distance_mm": 0.1,
    "distance_95_mm": 0.5,
    "landmarks_mm": 2.0,
    "folded": 0.0,
    "pierced": 0.0,
    "shown_through": 0.0,
}


def inputs(tmp_path: Path, landmarks: np.ndarray | None = None) -> Inputs:
    ref = None
    if landmarks is not None:
        np.savez(tmp_path / "landmarks.npz", xyz=landmarks, kept=np.ones(3, np.bool_), views=np.arange(3))
        ref = FileRef.of(tmp_path, "landmarks.npz")
    masks = Located(MaskSet(masks=(), landmarks=ref), tmp_path)
    poses = CameraSet(source="given", metric=True, capture_from_asset=((1.0,),), roi_radius=1.0, cameras=())
    return Inputs(None, None, Located(poses, tmp_path), masks, None)  # type: ignore[arg-type]


def network_points(scale: float, noise: float) -> np.ndarray:
    template = load_template()
    out = np.full((468, 3), np.nan)
    out[template.landmarks.network] = scale * template.landmark_points(template.vertices)
    return out + np.random.default_rng(0).normal(0, noise, out.shape)


def test_without_a_face_nothing_is_registered_and_nothing_is_written(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    found = run(inputs(tmp_path), Config(enabled=True), Context(tmp_path / "out", tmp_path))
    assert not found.registered and "no face" in found.reason and found.head is None and found.quality == ()
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize(
    ("points", "why"),
    [
        (network_points(1.0, 0.1), "mm off"),
        (network_points(3.0, 0.0), "times the template's size"),
        (np.full((468, 3), np.nan), "too few landmarks"),
    ],
)
def test_landmarks_that_are_not_a_head_s_are_refused(points: np.ndarray, why: str, tmp_path: Path) -> None:
    found = run(inputs(tmp_path, points), Config(enabled=True), Context(tmp_path, tmp_path))
    assert not found.registered and why in found.reason


def test_what_is_required_and_does_not_hold_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="could not be registered"):
        run(inputs(tmp_path), Config(require=True), Context(tmp_path, tmp_path))


def test_a_folder_s_content_is_part_of_the_settings(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text("{}")
    one = Config(folder=str(tmp_path))
    assert one.folder_digest and "folder" not in one.model_dump()
    (tmp_path / "manifest.json").write_text("{ }")
    assert Config(folder=str(tmp_path)).folder_digest != one.folder_digest
    assert folder_digest(tmp_path / "none") == "" and folder_digest(OWN) and Config().folder_digest == ""


def test_checks_and_reasons() -> None:
    assert {f.level for f in judge(GOOD)} == {"good"}
    for name, bad in (("distance_mm", 2.0), ("distance_95_mm", 9.0), ("landmarks_mm", 12.0), ("folded", 99.0),
                      ("pierced", 999.0), ("shown_through", 99.0)):  # fmt: skip
        levels = {f.check: f.level for f in judge(GOOD | {name: bad})}
        assert levels.pop(name) == "unusable" and set(levels.values()) == {"good"}
    assert not refused_placing(2.0, 1.1, metric=True) and not refused_placing(2.0, 9.0, metric=False)
    assert refused_placing(2.0, 0.5, metric=True) and refused_placing(7.0, 1.1, metric=True)
    assert refused_faces(4, 67) and not refused_faces(7, 67) and not refused_faces(3, 0)
    fit = {"identity_rms": 0.6, "distance_mm": 0.1, "seen": 0.9}
    assert not refused_fit(fit)
    for name, bad in (("identity_rms", 4.0), ("distance_mm", 4.0), ("seen", 0.01)):
        assert refused_fit(fit | {name: bad})


def test_without_a_fault_is_with_every_check_good_and_eyes() -> None:
    assert faults(judge(GOOD), "") == ""
    for name, bad in (("distance_95_mm", 2.0), ("pierced", 1.0), ("shown_through", 1.0)):
        why = faults(judge(GOOD | {name: bad}), "")
        assert "uv.mesh=template" in why and f"{bad:g}" in why
    assert "(eye_left: no edge)" in faults(judge(GOOD), "eye_left: no edge")


def test_irises_of_less_than_six_pixels_are_refused() -> None:
    """Cameras at 0.5 and 1 m from a head of usual size: an iris of 11.7 mm, by similar triangles."""
    head = PlacedHead(np.diag([ADULT, ADULT, ADULT, 1.0]), np.zeros(0), np.zeros((0, 3)), np.zeros(0), 0.0)
    near, far = (camera_on_orbit(20.0, 0.0, away, np.zeros(3)) for away in (0.5, 1.0))
    K = np.array([[900.0, 0, 200.0], [0, 900.0, 200.0], [0, 0, 1]])
    made = [
        Camera(index=i, name=str(i), K=tuple(map(tuple, K.tolist())), width=400, height=400,
               world_from_cam=tuple(map(tuple, np.asarray(pose).tolist())), distortion=(0.0,) * 5)
        for i, pose in enumerate((near, far, far))
    ]  # fmt: skip
    assert iris_pixels(made[:1], head) == pytest.approx(900 * 0.0117 / 0.5, rel=1e-6)
    assert iris_pixels(made, head) == pytest.approx(900 * 0.0117, rel=1e-6) and iris_pixels([], head) == 0
    assert not refused_irises(6.1) and "6" in refused_irises(5.9)


@pytest.mark.parametrize(
    ("faultless", "source", "why"),
    [(True, "object", "as an object"), (True, "object+hull", "as an object"), (True, "person", "light stage"),
     (False, "object", "too few landmarks")],
)  # fmt: skip
def test_what_was_segmented_as_an_object_is_not_registered_by_default(
    faultless: bool, source: str, why: str, tmp_path: Path
) -> None:
    """A statue may have a face that many photos agree on."""
    given = inputs(tmp_path, np.full((468, 3), np.nan))
    mask = ViewMask(index=0, mask=given.masks.artifact.landmarks, source=source, coverage=0.3)
    masks = given.masks.artifact.model_copy(update={"masks": (mask,)})
    stage = SimpleNamespace(artifact=SimpleNamespace(stage=object() if source == "person" else None))
    given = replace(given, masks=Located(masks, tmp_path), capture=stage)
    found = run(given, Config(enabled=True, faultless=faultless), Context(tmp_path, tmp_path))
    assert not found.registered and why in found.reason


@pytest.mark.parametrize(("faultless", "why"), [(True, "a light stage"), (False, "too few landmarks")])
def test_a_light_stage_is_not_registered_by_default(faultless: bool, why: str, tmp_path: Path) -> None:
    stage = SimpleNamespace(artifact=SimpleNamespace(stage=object()))
    given = replace(inputs(tmp_path, np.full((468, 3), np.nan)), capture=stage)  # type: ignore[arg-type]
    found = run(given, Config(enabled=True, faultless=faultless), Context(tmp_path, tmp_path))
    assert not found.registered and found.reason.startswith(why)


def ball_files(tmp_path: Path, eyes: bool = True) -> tuple[Located[Surface], Located[RegisteredHead], Head]:
    """A ball as scan and as registered head on two tiles; with eyes, half of it is theirs and a part is left out."""
    ball = ball_template(6)
    n = len(ball.quads)
    uvs = ball.uvs.copy().reshape(n, 4, 2)
    uvs[n // 2 :, :, 0] += 1
    region = np.zeros(n, np.int64)
    if eyes:
        region[n // 2 :], region[-3:] = 1, 2
    count = subdivided(ball.quads, len(ball.vertices), 1).stencil.shape[0]
    some = np.full(count, 1e-3, np.float32)
    head = Head(ball.vertices, ball.quads, uvs.reshape(-1, 2), ball.uv_quads, region, 0 * region, some, some + 1, 1)
    head.save(tmp_path / "head.npz")
    meshes.save(tmp_path / "surface.npz", ball_scan(0.1))
    mesh = FileRef.of(tmp_path, "surface.npz")
    surface = Surface(mesh=mesh, vertices=1, faces=1, watertight=True, components=1, removed_components=0, cell=0.006)
    found = RegisteredHead(
        registered=True, head=FileRef.of(tmp_path, "head.npz"), regions=("face", "eyes", "lashes"), levels=1
    )
    return Located(surface, tmp_path), Located(found, tmp_path), head


def test_the_uv_stage_takes_the_registered_head(tmp_path: Path) -> None:
    surface, registered, head = ball_files(tmp_path)
    masks = Located(MaskSet(masks=()), tmp_path)
    files = uv_stage.Inputs(surface, None, None, masks, registered)  # type: ignore[arg-type]
    (tmp_path / "out").mkdir()
    uv = uv_stage.run(files, UvConfig(mesh="template", rest=False), Context(tmp_path / "out", tmp_path))
    path = tmp_path / "out" / uv.mesh.path
    mesh, charts = meshes.load(path), meshes.load_charts(path)
    kept = len(head.quads) - 3
    assert uv.tiles == 2 and uv.faces == 2 * 4 * kept and uv.warnings == ()
    pairs = mesh.faces.reshape(-1, 6)
    assert (pairs[:, 0] == pairs[:, 3]).all() and (pairs[:, 2] == pairs[:, 4]).all()  # quads, cut alike
    points, normals, _ = head.surface()
    wanted = points + 1e-3 * normals  # facets that follow it in the mean lie outside of it at the vertices
    wanted = wanted + raised(wanted, normals, head.surface()[2], head.finer())[:, None] * normals
    assert cKDTree(wanted).query(mesh.vertices)[0].max() < 2e-5
    assert (tiles.of_face(charts)[: 4 * len(head.quads)] == 0).all()
    assert uv.face_share == 1.0 and uv.proxy is not None
    assert len(meshes.load(tmp_path / "out" / uv.proxy.path).faces) == 2 * kept
    facing = (meshes.vertex_normals(mesh.vertices, mesh.faces) * mesh.normals).sum(1)
    assert facing.min() > 0.9


def test_what_lies_beside_the_head_is_on_the_next_tile(tmp_path: Path) -> None:
    """A ball above the head as hair, and a dent in the head that is not left over."""
    surface, registered, _ = ball_files(tmp_path, eyes=False)
    inner, hair = ball_scan(0.1), ball_scan(0.03, 12, (0, 0.16, 0))
    dented = inner.vertices * np.where(inner.vertices[:, 2:] > 0.09, 0.9, 1.0).astype(np.float32)
    both = meshes.Mesh(
        np.concatenate([dented, hair.vertices]), np.concatenate([inner.normals, hair.normals]),
        np.concatenate([inner.faces, hair.faces + len(dented)]),
    )  # fmt: skip
    meshes.save(tmp_path / "surface.npz", both)
    masks = Located(MaskSet(masks=()), tmp_path)
    files = uv_stage.Inputs(surface, None, None, masks, registered)  # type: ignore[arg-type]
    made = {}
    for rest in (False, True):
        (tmp_path / str(rest)).mkdir()
        config = UvConfig(mesh="template", rest=rest)
        made[rest] = uv_stage.run(files, config, Context(tmp_path / str(rest), tmp_path))
    path = tmp_path / "True" / made[True].mesh.path
    mesh, charts = meshes.load(path), meshes.load_charts(path)
    assert made[False].tiles == 2 and made[True].tiles == 3
    added = mesh.vertices[np.unique(mesh.faces[made[False].faces :])]
    assert np.allclose(np.linalg.norm(added - [0, 0.16, 0], axis=1), 0.03, atol=1e-5)
    assert (tiles.of_face(charts)[made[False].faces :] == 2).all() and made[True].face_share == 1.0


def test_the_scan_is_used_where_the_template_does_not_hold(tmp_path: Path) -> None:
    surface, _, _ = ball_files(tmp_path)
    masks = Located(MaskSet(masks=()), tmp_path)
    files = uv_stage.Inputs(surface, None, None, masks, no_head(tmp_path))  # type: ignore[arg-type]
    config = UvConfig(mesh="template", target_faces=2000, proxy_faces=300)
    uv = uv_stage.run(files, config, Context(tmp_path, tmp_path))
    assert any("no face" in w for w in uv.warnings) and uv.tiles == 1


def test_it_is_registered_only_where_the_asset_may_be_made_from_it() -> None:
    assert configs_for("draft", {})["template"].enabled and configs_for("draft", {})["template"].faultless
    assert not configs_for("draft", {"uv": {"mesh": "both"}})["template"].faultless
    assert not configs_for("draft", {"uv": {"mesh": "scan"}})["template"].enabled
    assert configs_for("draft", {"uv": {"mesh": "template"}})["template"].enabled
    assert not configs_for("draft", {"uv": {"mesh": "template"}, "template": {"enabled": False}})["template"].enabled


def test_nothing_is_read_where_it_is_not_asked_for(tmp_path: Path) -> None:
    found = run(None, Config(), Context(tmp_path, tmp_path))  # type: ignore[arg-type]
    assert not found.registered and "template.enabled" in found.reason
