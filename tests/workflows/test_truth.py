"""The demo's ruler against shapes whose distances and colours are known on paper."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Gf, Sdf, Usd, UsdGeom

from pipeline.artifacts import FileRef
from pipeline.capture_artifacts import Capture, CaptureView, GivenCamera
from pipeline.colour import srgb_from_linear
from pipeline.images import write_exr, write_png
from pipeline.transforms import inverse_rigid, rigid, rows
from workflows.evaluation import demo, geometry

RADIUS, SIZE = 0.1, 96
EYES = [np.array(e, float) for e in ((0, 0, 1), (0.3, 0.2, 1), (-0.3, 0.1, 1), (0, -0.3, 1))]


def camera(eye: np.ndarray) -> GivenCamera:
    """Looks from `eye` at the origin; OpenCV axes."""
    z = -eye / np.linalg.norm(eye)
    x = np.cross(z, (0, 1, 0))
    x /= np.linalg.norm(x)
    world_from_cam = rigid(np.stack([x, np.cross(z, x), z], 1), eye)
    K = np.array([[320.0, 0, SIZE / 2], [0, 320.0, SIZE / 2], [0, 0, 1]])
    return GivenCamera(K=rows(K), cam_from_world=rows(inverse_rigid(world_from_cam)), distortion=(0.0,) * 5)


def views() -> list[CaptureView]:
    ref = FileRef(path="0.png", sha256="", size=0)
    return [CaptureView(index=i, name=f"{i}.png", image=ref, width=SIZE, height=SIZE, camera=camera(e), holdout=i == 0)
            for i, e in enumerate(EYES)]  # fmt: skip


def write_asset(path: Path, mesh: trimesh.Trimesh) -> None:
    """A component as the pipeline's, but moved and scaled by its transform; st = 0.5 everywhere."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.Xform.Define(stage, "/head").AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    prim = UsdGeom.Mesh.Define(stage, "/head/render")
    prim.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
    prim.GetPointsAttr().Set(np.asarray(mesh.vertices, np.float32))
    prim.GetFaceVertexCountsAttr().Set([3] * len(mesh.faces))
    prim.GetFaceVertexIndicesAttr().Set(mesh.faces.ravel().tolist())
    st = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set([(0.5, 0.5)] * (3 * len(mesh.faces)))
    stage.Save()


@pytest.fixture
def run(tmp_path: Path) -> tuple[Path, Path]:
    """A run whose surface is 1 mm too large, whose pictures are 0.1 off and whose albedo is half of the truth."""
    out, capture = tmp_path / "out", tmp_path / "capture"
    (out / "asset").mkdir(parents=True)
    (capture / "truth").mkdir(parents=True)
    write_asset(out / "asset/head.usd", trimesh.creation.icosphere(5, RADIUS + 0.001))
    trimesh.creation.icosphere(5, RADIUS).export(capture / "truth/mesh_gt.ply")
    capture_from_asset = np.eye(4) / 2  # undoes the scale of the prim, and the translation after it
    capture_from_asset[:3, 3], capture_from_asset[3, 3] = (-0.5, -1, -1.5), 1
    (out / "run.json").write_text(
        json.dumps({"asset": "asset/head.usd", "capture_from_asset": rows(capture_from_asset)})
    )
    write_exr(out / "asset/textures/head_albedo.exr", np.full((8, 8, 3), 0.2, np.float32))
    write_exr(capture / "truth/albedo/0.exr", np.full((SIZE, SIZE, 3), 0.4, np.float32))
    disc = np.hypot(*(np.indices((SIZE, SIZE)) + 0.5 - SIZE / 2)) < 25
    write_png(capture / "truth/alpha/0.png", disc.astype(float))
    write_png(capture / "0.png", np.where(disc[..., None], 128 / 255, 0.0) * np.ones(3))
    for folder, encoded in (("views", 128 / 255 + 0.1), ("asset_views", 128 / 255 + 0.01)):
        linear = np.full((SIZE, SIZE, 4), 0.0, np.float32)
        steps = 12.92 * np.linspace(0, 1, 1_000_001)  # invert the curve by its own forward direction
        curve = srgb_from_linear(steps / 12.92)
        linear[..., :3] = np.interp(encoded, curve, steps / 12.92)
        write_exr(out / f"report/{folder}/0.exr", linear)
    return out, capture


def test_known_errors_are_measured_as_they_are(run: tuple[Path, Path]) -> None:
    figures = demo.measure(*run, Capture(kind="facescape", views=tuple(views())))
    assert figures.psnr == pytest.approx(20, abs=0.01)
    assert figures.psnr_asset == pytest.approx(40, abs=0.05)
    assert figures.accuracy_mean == pytest.approx(1, abs=0.02)
    assert figures.accuracy_median == pytest.approx(1, abs=0.02)
    assert figures.completeness_mean == pytest.approx(1, abs=0.02)
    assert figures.albedo > 100  # a gain of two explains all of it
    assert figures.views == 1
    assert "20.0 dB" in figures.lines()[0]


def test_a_gain_does_not_explain_a_pattern(run: tuple[Path, Path]) -> None:
    out, capture = run
    pattern = np.full((SIZE, SIZE, 3), 0.3, np.float32)
    pattern[::2] = 0.5
    write_exr(capture / "truth/albedo/0.exr", pattern)
    figures = demo.measure(out, capture, Capture(kind="facescape", views=tuple(views())))
    shown = [1.055 * x ** (1 / 2.4) - 0.055 for x in (0.4, 0.3, 0.5)]  # the best constant, then the pattern
    expected = -10 * np.log10(((shown[0] - shown[1]) ** 2 + (shown[0] - shown[2]) ** 2) / 2)
    assert figures.albedo == pytest.approx(expected, abs=0.2)


def test_tiles_are_read_side_by_side() -> None:
    texture = np.concatenate([np.full((8, 8, 3), v, np.float32) for v in (0.2, 0.6)], 1)
    found = geometry.bilinear(texture, np.array([[0.5, 0.5], [1.5, 0.5], [1.1, 0.9], [1.9, 0.1]]))
    assert np.allclose(found[:, 0], [0.2, 0.6, 0.6, 0.6])


def test_only_what_several_views_see_counts() -> None:
    mesh = trimesh.creation.icosphere(4, RADIUS)
    seen = demo.seen_by(mesh, views())
    assert len(seen) > 1000
    assert seen[:, 2].min() > -0.02  # the back is not seen
    assert len(demo.seen_by(mesh, views()[:2])) == 0


def test_a_surface_behind_another_is_not_seen() -> None:
    screen = trimesh.creation.box((0.06, 0.06, 0.002), transform=rigid(np.eye(3), np.array([0, 0, 0.13])))
    both = trimesh.util.concatenate([trimesh.creation.icosphere(4, RADIUS), screen])
    seen = demo.seen_by(both, views())
    middle = np.hypot(seen[:, 0], seen[:, 1]) < 0.015  # 3 cm behind the screen: hidden from every one of these views
    assert (seen[middle, 2] > 0.12).all()
    assert middle.sum() > 50
    assert ((seen[:, 2] < 0.1) & ~middle).sum() > 1000


def test_distances_are_exact_on_a_plane() -> None:
    plane = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (500, 3))
    assert np.allclose(geometry.distances(plane, points), abs(points[:, 2]), atol=1e-12)
    assert geometry.distances(plane, np.array([[2.0, 0, 0]]))[0] == pytest.approx(1)


def test_a_mesh_of_more_triangles_than_samples_is_no_further_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geometry, "TREE_SAMPLES", 100)
    ball = trimesh.creation.icosphere(5)  # 20,480 triangles
    random = np.random.default_rng(1)
    corners = ball.triangles[random.integers(0, len(ball.faces), 300)]
    points = np.einsum("nij,ni->nj", corners, random.dirichlet(np.ones(3), 300))
    assert geometry.distances(ball, points).max() < 1e-12


def test_held_out_pictures_are_found_in_the_store(tmp_path: Path) -> None:
    from workflows.evaluation.held_out import held_out_exr

    for stage, field in (("inverse_rendering", "held_out"), ("usd", "views")):
        folder = tmp_path / "store" / stage / "k"
        folder.mkdir(parents=True)
        manifest = {field: [{"index": i, "exr": {"path": f"x/{i}.exr"}} for i in (3, 9)]}
        (folder / "manifest.json").write_text(json.dumps(manifest))
    record = {"store": str(tmp_path / "store"), "stages": {s: {"key": "k"} for s in ("inverse_rendering", "usd")}}
    (tmp_path / "run.json").write_text(json.dumps(record))
    assert held_out_exr(tmp_path, "views", 9) == tmp_path / "store/inverse_rendering/k/x/9.exr"
    assert held_out_exr(tmp_path, "asset_views", 3) == tmp_path / "store/usd/k/x/3.exr"
    assert not held_out_exr(tmp_path, "asset_views", 4).is_file()
    published = tmp_path / "report/views/9.exr"
    published.parent.mkdir(parents=True)
    published.write_bytes(b"x")
    assert held_out_exr(tmp_path, "views", 9) == published
