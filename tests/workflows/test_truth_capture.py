"""Measuring of captures against their truth, on shapes and colours whose errors are known on paper."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from pxr import Sdf, Usd, UsdGeom

from pipeline import meshes
from pipeline.artifacts import FileRef
from pipeline.camera import PinholeCamera
from pipeline.capture_artifacts import CaptureView, GivenCamera
from pipeline.images import write_exr, write_png, write_png_from_linear
from pipeline.transforms import apply, centre_K_from_corner_K, inverse_rigid, rigid, rows, similarity
from workflows.bench.captures_figures import Run, _of_own_tile, figures_of, texture_of
from workflows.evaluation import geometry, rendered_person, stored_truth

RADIUS, SIZE = 0.1, 96
EYES = [np.array(e, float) for e in ((0, 0, 1), (0.3, 0.2, 1), (-0.3, 0.1, 1), (0, -0.3, 1))]
K = np.array([[320.0, 0, SIZE / 2], [0, 320.0, SIZE / 2], [0, 0, 1]])


def pose(eye: np.ndarray) -> np.ndarray:
    """world_from_cam that looks at the origin; OpenCV axes."""
    z = -eye / np.linalg.norm(eye)
    x = np.cross(z, (0, 1, 0))
    x /= np.linalg.norm(x)
    return rigid(np.stack([x, np.cross(z, x), z], 1), eye)


def sphere(radius: float = RADIUS) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(5, radius)


def disc() -> np.ndarray:
    """(H, W) well inside of what the sphere covers in every view."""
    return (np.hypot(*(np.indices((SIZE, SIZE)) + 0.5 - SIZE / 2)) < 25).astype(np.float32)


def write_asset(path: Path, mesh: trimesh.Trimesh) -> None:
    stage = Usd.Stage.CreateNew(str(path))
    prim = UsdGeom.Mesh.Define(stage, "/head")
    prim.GetPointsAttr().Set(np.asarray(mesh.vertices, np.float32))
    prim.GetFaceVertexCountsAttr().Set([3] * len(mesh.faces))
    prim.GetFaceVertexIndicesAttr().Set(mesh.faces.ravel().tolist())
    st = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set([(0.5, 0.5)] * (3 * len(mesh.faces)))
    stage.Save()


def made_up(tmp_path: Path, mesh: trimesh.Trimesh, capture_from_asset: np.ndarray, **manifests: Any) -> Run:
    """A run whose asset is a mesh (asset coordinates) with albedo 0.2."""
    out, store = tmp_path / "out", tmp_path / "store"
    (out / "asset" / "textures").mkdir(parents=True)
    write_asset(out / "asset" / "head.usd", mesh)
    write_exr(out / "asset" / "textures" / "head_albedo.exr", np.full((8, 8, 3), 0.2, np.float32))
    for stage, manifest in manifests.items():
        (store / stage / "k").mkdir(parents=True)
        (store / stage / "k" / "manifest.json").write_text(json.dumps(manifest))
    record = {
        "asset": "asset/head.usd",
        "capture_from_asset": rows(capture_from_asset),
        "store": str(store),
        "stages": {s: {"key": "k"} for s in manifests},
    }
    return Run(out, record, {})


def views() -> list[dict[str, Any]]:
    ref = FileRef(path="0.png", sha256="", size=0)
    made = []
    for i, e in enumerate(EYES):
        given = GivenCamera(K=rows(K), cam_from_world=rows(inverse_rigid(pose(e))), distortion=())
        made.append(
            CaptureView(index=i, name=f"{i}.png", image=ref, width=SIZE, height=SIZE, camera=given, holdout=i == 0)
        )
    return [v.model_dump(mode="json") for v in made]


# ------------------------------------------------------------------ scans
@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """A capture's folder with the truth of a sphere."""
    truth = tmp_path / "capture" / "truth"
    truth.mkdir(parents=True)
    sphere().export(truth / "mesh_gt.ply")
    for i in range(4):
        write_png(truth / f"mask/{i}.png", np.ones((SIZE, SIZE)))
    write_png(truth / "alpha/0.png", disc())
    write_exr(truth / "albedo/0.exr", np.full((SIZE // 2, SIZE // 2, 3), 0.4, np.float32))
    return truth.parent


def test_a_larger_sphere_in_another_world_is_measured_in_millimetres(tmp_path: Path, scan: Path) -> None:
    """The asset is twice as large and elsewhere; brought into the capture's world its radius is 1.5 mm too large."""
    capture_from_asset = similarity(0.5, pose(EYES[1])[:3, :3], np.array([0.3, -0.2, 0.1]))
    asset = sphere(RADIUS + 0.0015)
    asset.apply_transform(np.linalg.inv(capture_from_asset))
    run = made_up(tmp_path, asset, capture_from_asset, capture={"views": views()}, poses={"source": "given"})
    figures, labels = stored_truth.measure(run, scan)
    for name in ("accuracy_mm", "completeness_mm", "chamfer_mm"):
        assert figures[name] == pytest.approx(1.5, abs=0.03)
    assert figures["albedo_gain"] == pytest.approx(2, abs=1e-3) and figures["albedo_gain_db"] > 80
    shown = [1.055 * x ** (1 / 2.4) - 0.055 for x in (0.2, 0.4)]
    assert figures["albedo_db"] == pytest.approx(-20 * np.log10(shown[1] - shown[0]), abs=0.01)
    assert labels == {}


@pytest.mark.slow
def test_what_the_truths_outline_leaves_out_does_not_count_for_accuracy(tmp_path: Path, scan: Path) -> None:
    """A plate beside the sphere: in the cameras' sight, but on no photo's subject. completeness never sees it."""
    plate = trimesh.creation.box((0.02, 0.02, 0.02), transform=rigid(np.eye(3), np.array([0, 0.115, 0.02])))
    asset = trimesh.util.concatenate([sphere(), plate])
    run = made_up(tmp_path, asset, np.eye(4), capture={"views": views()}, poses={"source": "given"})
    with_plate, _ = stored_truth.measure(run, scan)
    assert with_plate["accuracy_mm"] > 0.1 and with_plate["completeness_mm"] < 0.05
    for i, eye in enumerate(EYES):
        camera = PinholeCamera(K, pose(eye), SIZE, SIZE)
        at, inside = camera.pixels(geometry.spread(sphere(), 20_000)[0])
        subject = np.zeros((SIZE, SIZE))
        subject[at[inside, 1], at[inside, 0]] = 1
        write_png(scan / f"truth/mask/{i}.png", subject)
        write_png(scan / f"truth/alpha/{i}.png", subject)
    without, _ = stored_truth.measure(run, scan)
    assert without["accuracy_mm"] < 0.2 * with_plate["accuracy_mm"]


def test_held_out_views_do_not_say_what_is_seen(tmp_path: Path, scan: Path) -> None:
    """Three fitted views of four see the surface; with two of them there is nothing to measure."""
    shown = views()
    shown[1]["holdout"] = True
    run = made_up(tmp_path, sphere(), np.eye(4), capture={"views": shown}, poses={"source": "given"})
    figures, _ = stored_truth.measure(run, scan)
    assert figures["chamfer_mm"] is None and figures["accuracy_mm"] is None


def test_without_truth_or_with_solved_cameras_nothing_is_measured(tmp_path: Path, scan: Path) -> None:
    run = made_up(tmp_path, sphere(), np.eye(4), capture={"views": views()}, poses={"source": "colmap"})
    assert stored_truth.measure(run, scan) == ({}, {})
    assert stored_truth.measure(run, tmp_path) == ({}, {})


# ------------------------------------------------------------------ persons
def test_true_cameras_follow_the_files_convention(tmp_path: Path) -> None:
    """A point of the resting head goes to K (world_to_camera @ head_motion @ x); pixel centres are integers."""
    world_to_camera = inverse_rigid(pose(np.array([0.2, 0.1, 1.0])))
    motion = rigid(trimesh.transformations.rotation_matrix(0.1, (0, 1, 0))[:3, :3], np.array([0.01, 0.02, 0]))
    photo = {"name": "IMG_7.jpg", "K": rows(K), "distortion": [0.1, 0, 0, 0, 0], "width": SIZE, "height": SIZE,
             "world_to_camera": rows(world_to_camera), "head_motion": rows(motion)}  # fmt: skip
    (tmp_path / "cameras.json").write_text(json.dumps({"photos": [photo]}))
    [(stem, camera)] = rendered_person.true_cameras(tmp_path).items()
    points = np.random.default_rng(0).uniform(-0.08, 0.08, (200, 3))
    seen = np.concatenate([points, np.ones((200, 1))], 1) @ (world_to_camera @ motion).T
    x, y = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]
    bent = 1 + 0.1 * (x * x + y * y)
    expected = np.rint(np.stack([K[0, 0] * x * bent + K[0, 2], K[1, 1] * y * bent + K[1, 2]], -1))
    at, inside = camera.pixels(points)
    assert stem == "IMG_7" and inside.sum() > 150 and np.array_equal(at[inside], expected[inside])


@pytest.fixture
def person(tmp_path: Path) -> Path:
    """The truth of a person who is a sphere of skin; the upper quarter of each photo is hair."""
    truth = tmp_path / "capture" / "truth"
    (truth / "labels").mkdir(parents=True)
    sphere().export(truth / "skin.obj")
    marks = {"eye_inner_left": [0.03, 0.02, 0.09], "mouth_corner_right": [-0.03, -0.02, 0.09], "eye_radius_left": 0.02,
             "chin": [5, 5, 5], "note": "metres"}  # fmt: skip
    (truth / "landmarks.json").write_text(json.dumps(marks))
    photos = []
    for i, eye in enumerate(EYES):
        motion = rigid(np.eye(3), np.array([0.01, 0, 0]))  # the head has moved, and the camera with it
        photos.append({"name": f"p{i}.jpg", "K": rows(centre_K_from_corner_K(K)), "width": SIZE, "height": SIZE,
                       "world_to_camera": rows(inverse_rigid(pose(eye)) @ np.linalg.inv(motion)),
                       "head_motion": rows(motion)})  # fmt: skip
        label = disc().astype(np.uint8)
        label[: SIZE // 4] *= 2
        write_png(truth / "labels" / f"p{i}.png", label / 255)
        rgba = np.concatenate([np.full((SIZE // 2, SIZE // 2, 3), 0.2), disc()[::2, ::2, None]], -1)
        write_exr(truth / "albedo" / f"p{i}.exr", rgba.astype(np.float32))
    (truth / "cameras.json").write_text(json.dumps({"photos": photos}))
    return truth.parent


def solved(asset_from_head: np.ndarray) -> dict[str, Any]:
    """The poses' manifest of cameras in a world of their own."""
    cameras = [
        {"index": i, "name": f"p{i}.jpg", "world_from_cam": rows(asset_from_head @ pose(e))} for i, e in enumerate(EYES)
    ]
    return {"source": "colmap", "cameras": cameras}


ASSET_FROM_HEAD = similarity(3.0, pose(EYES[2])[:3, :3], np.array([1.0, 2.0, 3.0]))


@pytest.mark.slow
def test_a_person_in_a_world_of_its_own(tmp_path: Path, person: Path) -> None:
    asset = sphere()
    asset.apply_transform(ASSET_FROM_HEAD)
    run = made_up(tmp_path, asset, np.eye(4), capture={"views": []}, poses=solved(ASSET_FROM_HEAD))
    figures, labels = stored_truth.measure(run, person)
    assert figures["skin_median_mm"] < 0.02 and figures["depth_p95_mm"] < 0.02 and figures["face_missed"] == 0
    assert figures["albedo_db"] > 80 and labels == {}


def test_a_dent_in_the_face_is_seen_along_the_rays(tmp_path: Path, person: Path) -> None:
    """The front of the face lies 4 mm too deep: the nearest surface says so, and the rays say by how much."""
    asset = sphere()
    front = asset.vertices[:, 2] > 0.08
    asset.vertices[front] *= (RADIUS - 0.004) / RADIUS
    asset.apply_transform(ASSET_FROM_HEAD)
    run = made_up(tmp_path, asset, np.eye(4), capture={"views": []}, poses=solved(ASSET_FROM_HEAD))
    figures, _ = stored_truth.measure(run, person)
    assert 3 < figures["depth_p95_mm"] < 4.5


def test_depths_before_behind_and_beside() -> None:
    points = np.array([[0, 0, 0.1], [0, 0, 0.1], [0.5, 0, 0]])
    eyes = np.array([[0, 0, 1.0]] * 3)
    assert np.allclose(rendered_person.depths(sphere(0.102), points[:2], eyes[:2]), 0.002, atol=1e-5)
    found = rendered_person.depths(sphere(0.097), points, eyes)
    assert np.allclose(found[:2], -0.003, atol=1e-5) and np.isnan(found[2])


def test_closest_points_mend_cameras_that_are_slightly_off() -> None:
    bumpy = sphere()
    bumpy.vertices *= 1 + 0.1 * np.sin(20 * bumpy.vertices[:, [0]]) + 0.1 * np.sin(25 * bumpy.vertices[:, [1]])
    points = geometry.spread(bumpy, 20_000)[0]
    off = similarity(
        1.01, trimesh.transformations.rotation_matrix(0.01, (0, 1, 0))[:3, :3], np.array([0.002, -0.001, 0])
    )
    moved = bumpy.copy().apply_transform(off)
    mended = rendered_person.refined(moved, points)
    assert np.abs(apply(mended @ off, points) - points).max() < 2e-4
    assert np.abs(apply(off, points) - points).max() > 2e-3


def test_no_alignment_hides_a_surface_that_is_elsewhere() -> None:
    """A head that is far too small: closest points would grow it."""
    points = geometry.spread(sphere(), 5_000)[0]
    assert np.array_equal(rendered_person.refined(sphere(0.09), points), np.eye(4))


def test_two_cameras_place_nothing(tmp_path: Path, person: Path) -> None:
    poses = solved(np.eye(4))
    poses["cameras"] = poses["cameras"][:2]
    run = made_up(tmp_path, sphere(), np.eye(4), capture={"views": []}, poses=poses)
    assert stored_truth.measure(run, person)[0] == {}


def test_psnr_by_label(tmp_path: Path, person: Path) -> None:
    """Skin 0.1 off in the shown values, hair 0.01, in the held-out view alone; the outline is a part of its own."""
    run = made_up(tmp_path, sphere(), np.eye(4), capture={}, poses=solved(np.eye(4)))
    photo = np.full((SIZE, SIZE, 3), 0.2, np.float32)
    store = Path(run.record["store"]) / "capture" / "k"
    write_png_from_linear(store / "p0.png", photo)
    shown_views = [{"index": 0, "name": "p0.jpg", "image": {"path": "p0.png"}, "holdout": True},
                   {"index": 1, "name": "p1.jpg", "image": {"path": "none.png"}, "holdout": False}]  # fmt: skip
    (store / "manifest.json").write_text(json.dumps({"views": shown_views}))
    run = Run(run.out, run.record, {})
    from pipeline.colour import linear_from_srgb
    from pipeline.images import read_encoded

    label = disc().astype(np.uint8)
    label[: SIZE // 2] *= 2
    write_png(person / "truth/labels/p0.png", label / 255)
    encoded = read_encoded(store / "p0.png")[0, 0, 0] / 255
    half = SIZE // 2
    render = np.full((half, half, 4), linear_from_srgb(np.float32(encoded + 0.1)), np.float32)
    render[: half // 2, :, :3] = linear_from_srgb(np.float32(encoded + 0.01))
    for index in (0, 1):
        write_exr(run.out / f"report/views/{index}.exr", render)
    found = rendered_person.by_label(run, person / "truth")["model"]
    assert found["skin"]["psnr"] == pytest.approx(20, abs=0.05)
    assert found["hair"]["psnr"] == pytest.approx(40, abs=0.5)
    assert set(found) == {"skin", "hair", "outline"}
    assert sum(p["pixels"] for p in found.values()) == pytest.approx(1, abs=1e-3)
    assert sum(p["error"] for p in found.values()) == pytest.approx(1, abs=1e-3)


# ------------------------------------------------------------------ a run's own figures
def test_the_face_has_its_share_of_its_own_tile() -> None:
    """Half of the first tile, a speck on the second, nothing on the third."""
    tile = np.repeat([0, 1, 2], [40, 100, 60])
    face = np.zeros(200, np.bool_)
    face[:20] = face[45:50] = True
    assert _of_own_tile(face, tile) == 0.5
    assert _of_own_tile(np.zeros(200, np.bool_), tile) == 0


def test_texture_figures_of_two_charts(tmp_path: Path) -> None:
    """A square of 1 m with the left half of the texture, and a speck with the right; the speck is a fragment."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    vertices = np.concatenate([corners, 0.01 * corners + [0, 0, 1]]).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    square = np.array([[0, 0], [0.5, 0], [0.5, 1], [0, 1]], np.float32)
    uvs = np.concatenate([square, square * [0.5, 1] + [0.75, 0]]).astype(np.float32)
    mesh = meshes.Mesh(vertices, np.zeros_like(vertices), faces)
    folder = tmp_path / "store" / "uv" / "k"
    run = made_up(
        tmp_path,
        sphere(),
        np.eye(4),
        uv={"charts": 2, "mesh": {"path": "uv.npz"}},
        masks={"masks": [], "label_names": ["background", "subject", "face"]},
        bake={
            "size": 64,
            "tiles": 1,
            "figures": {"unseen": 0.5},
            "maps": {n: {"files": {"exr": {"path": f"{n}.exr"}}} for n in ("f0", "roughness", "region")},
        },
    )
    meshes.save(folder / "uv.npz", mesh, meshes.Charts(uvs, faces))
    bake = tmp_path / "store" / "bake" / "k"
    code = np.zeros((64, 64, 1), np.float32)
    code[:16] = 2  # the upper quarter of both charts
    code[:, 32:48] = 1  # between the charts: never counted
    f0 = np.where(code == 2, 0.03, 0.01).astype(np.float32)
    f0[:, 32:48] = 9
    f0[63, 0] = 0.05
    for name, values in (("region", code), ("f0", f0), ("roughness", np.full((64, 64, 1), 0.4, np.float32))):
        write_exr(bake / f"{name}.exr", values, ("Y",))
    figures, ranges = texture_of(run)
    assert figures == {"fragments": 1, "face_share": 0.25}
    assert ranges["face"] == {"share": [0.25], "f0": [0.03] * 3, "roughness": [0.4] * 3}
    assert ranges["whole"]["f0"] == [0.01, pytest.approx(0.015, abs=1e-4), 0.05] and set(ranges) == {
        "whole", "unlabelled", "face"}  # fmt: skip
    assert figures_of(run)["unseen"] == 0.5 and figures_of(run)["placed"] is None


def test_a_run_that_ended_early_has_what_it_has(tmp_path: Path) -> None:
    run = made_up(tmp_path, sphere(), np.eye(4), capture={"views": [{}, {}]}, poses={"cameras": [{}]})
    figures = figures_of(run)
    assert figures["photos"] == 2 and figures["placed"] == 1 and figures["mask_worst"] is None
    assert figures["psnr"] is None and figures["charts"] is None and texture_of(run) == ({}, {})
