"""The written capture: complete, readable, and its photos, cameras, shape, skin and light agree."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR
import pytest
import trimesh

from pipeline.demo import capture, head, light, rig
from pipeline.demo.capture import write_demo_capture
from pipeline.demo.mesh import mesh_from_distance
from pipeline.demo.render import render, scene_from_mesh

F64 = npt.NDArray[np.float64]

VIEWS, SIZE = 13, 96
TINY: dict[str, Any] = {"views": 3, "size": 24, "samples": 2, "mesh_step": 0.006}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demo") / "capture"
    write_demo_capture(out, views=VIEWS, size=SIZE, samples=16, mesh_step=0.003)
    return out


def read_exr(path: Path) -> F64:
    with OpenEXR.File(str(path)) as file:
        return np.asarray(file.channels()["RGB"].pixels, dtype=np.float64)


def linear_photo(folder: Path, i: int) -> F64:
    image = cv2.imread(str(folder / f"{i}.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None and image.dtype == np.uint8
    x = image[..., ::-1] / 255.0
    return np.asarray(np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4))


def alpha_of(folder: Path, i: int) -> F64:
    image = cv2.imread(str(folder / "truth" / "alpha" / f"{i}.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None and image.shape == (SIZE, SIZE)
    return np.asarray(image / 255.0)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_folder_is_complete_and_in_facescape_format(folder: Path) -> None:
    params = json.loads((folder / "params.json").read_text())
    for i in range(VIEWS):
        k, rt = np.array(params[f"{i}_K"]), np.array(params[f"{i}_Rt"])
        assert k[0, 2] == k[1, 2] == (SIZE - 1) / 2, "pixel centres are integers"
        np.testing.assert_allclose(rt[:, :3] @ rt[:, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rt[:, :3]) == pytest.approx(1.0) and rt.shape == (3, 4)
        assert params[f"{i}_width"] == params[f"{i}_height"] == SIZE
        assert params[f"{i}_valid"] is True and len(params[f"{i}_distortion"]) == 5
        assert (folder / params[f"{i}_ori"]).is_file() and isinstance(params[f"{i}_sn"], str)
        assert (folder / "truth" / "alpha" / f"{i}.png").is_file()
        for name in ("albedo", "normal"):
            assert (folder / "truth" / name / f"{i}.exr").is_file() == (i % 5 == 2)
    assert len(list(folder.glob("*.png"))) == VIEWS
    assert not (folder / "mask").exists()


def test_photos_are_well_exposed_on_black(folder: Path) -> None:
    inside, outside = [], []
    for i in range(VIEWS):
        photo, alpha = cv2.imread(str(folder / f"{i}.png")), alpha_of(folder, i)
        assert photo is not None
        inside.append(photo[alpha == 1])
        outside.append(photo[alpha == 0])
        assert 0.2 < alpha.mean() < 0.6
    skin = np.concatenate(inside)
    assert 0.47 < skin.mean() / 255 < 0.62
    assert (skin == 255).mean() < 1e-3
    assert np.concatenate(outside).max() == 0


def projected_alpha(folder: Path, i: int, shift: float = 0.0) -> F64:
    """Coverage (H, W) by the truth mesh, filled at eight times the size and averaged."""
    params = json.loads((folder / "params.json").read_text())
    mesh = trimesh.load_mesh(folder / "truth" / "mesh_gt.ply")
    rt = np.array(params[f"{i}_Rt"])
    seen = np.array(params[f"{i}_K"]) @ (rt[:, :3] @ mesh.vertices.T + rt[:, 3:])
    xy = (seen[:2] / seen[2]).T + shift
    # Pixel centres at integers: the fine grid's centre of (0, 0) lies at -0.4375 of the coarse one's.
    fine = np.rint(((xy + 0.5) * 8 - 0.5) * 16).astype(np.int32)
    canvas = np.zeros((SIZE * 8, SIZE * 8), dtype=np.uint8)
    for triangle in fine[mesh.faces]:
        cv2.fillConvexPoly(canvas, triangle, 255, shift=4)
    return np.asarray(canvas.reshape(SIZE, 8, SIZE, 8).mean(axis=(1, 3)) / 255.0)


def overlap(a: F64, b: F64) -> float:
    """Soft intersection over union."""
    return float(np.minimum(a, b).sum() / np.maximum(a, b).sum())


@pytest.mark.parametrize("i", [0, 5, 12])
def test_truth_mesh_projects_onto_alpha(folder: Path, i: int) -> None:
    alpha = alpha_of(folder, i)
    assert overlap(alpha, projected_alpha(folder, i)) > 0.985
    assert overlap(alpha, projected_alpha(folder, i, shift=0.5)) < 0.98, "half a pixel must show"
    assert overlap(alpha, projected_alpha(folder, i)[:, ::-1]) < 0.95, "and so must a mirror"


def test_truth_mesh_is_the_distance_in_metres(folder: Path) -> None:
    mesh = trimesh.load_mesh(folder / "truth" / "mesh_gt.ply")
    assert mesh.is_watertight and mesh.volume > 0
    assert 20_000 < len(mesh.faces) < 75_000
    distance = np.abs(head.signed_distance(np.asarray(mesh.triangles_center)))
    assert np.median(distance) < 5e-5 and np.percentile(distance, 99) < 6e-4


def test_normals_look_at_the_camera_and_match_the_mesh(folder: Path) -> None:
    params = json.loads((folder / "params.json").read_text())
    for i in range(2, VIEWS, 5):
        normal, alpha = read_exr(folder / "truth" / "normal" / f"{i}.exr"), alpha_of(folder, i)
        inner = cv2.erode((alpha == 1).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        np.testing.assert_allclose(np.linalg.norm(normal[inner], axis=1), 1.0, atol=2e-3)
        rt = np.array(params[f"{i}_Rt"])
        assert (normal[inner] @ rt[2, :3] < 0.1).mean() > 0.999
        assert (normal[alpha == 0] == 0).all()


def test_photo_is_albedo_times_irradiance_and_a_little_gloss(folder: Path) -> None:
    """Diffuse light by quadrature of light.json explains the photo up to the specular lobe."""
    about = json.loads((folder / "truth" / "light.json").read_text())
    coefficients = np.array(about["coefficients"])
    z, weight = np.polynomial.legendre.leggauss(24)
    phi = np.arange(48) * 2 * np.pi / 48
    zz, pp = (x.ravel() for x in np.meshgrid(z, phi, indexing="ij"))
    ring = np.sqrt(1 - zz**2)
    w = np.stack([ring * np.cos(pp), ring * np.sin(pp), zz], axis=1)
    lit = np.repeat(weight, 48)[:, None] * 2 * np.pi / 48 * light.radiance(coefficients, w)
    i = 7
    normal, albedo = (read_exr(folder / "truth" / name / f"{i}.exr") for name in ("normal", "albedo"))
    inner = cv2.erode((alpha_of(folder, i) == 1).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    irradiance = np.maximum(normal[inner] @ w.T, 0.0) @ lit
    gloss = linear_photo(folder, i)[inner] - albedo[inner] / np.pi * irradiance
    assert 0.005 < np.median(gloss) < 0.05
    assert np.percentile(gloss, 1) > -0.015 and np.percentile(gloss, 99) < 0.3
    # The specular lobe carries the colour of the light, which is near white.
    spread = np.ptp(np.median(gloss, axis=0))
    assert spread < 0.2 * np.median(gloss)


def test_environment_picture_is_the_light(folder: Path) -> None:
    coefficients = np.array(json.loads((folder / "truth" / "light.json").read_text())["coefficients"])
    env = read_exr(folder / "truth" / "env.exr")
    assert coefficients.shape == (121, 3) and env.shape == (128, 256, 3) and env.min() > 0
    np.testing.assert_allclose(env, light.lat_long(coefficients, 128), rtol=1e-5)
    # Column 128 looks along +Z; the key box stands on +X, so left of it.
    assert env[40:90, 64:128].mean() > env[40:90, 128:192].mean()


@pytest.mark.slow
def test_equal_arguments_give_equal_bytes(tmp_path: Path) -> None:
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        write_demo_capture(tmp_path / name, **TINY, seed=seed)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert contents(tmp_path / "c")["0.png"] != contents(tmp_path / "a")["0.png"]


def test_finished_capture_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_demo_capture(tmp_path / "a", **TINY)
    monkeypatch.setattr(capture, "_write", lambda *_: pytest.fail("written twice"))
    write_demo_capture(tmp_path / "a", **TINY)
    with pytest.raises(FileExistsError, match="does not contain this demo capture"):
        write_demo_capture(tmp_path / "a", **TINY, seed=5)


@pytest.mark.parametrize("at", [0, 2])
def test_interrupted_write_leaves_nothing(tmp_path: Path, at: int) -> None:
    def stop(done: int, total: int, what: str) -> None:
        if done == at:
            raise KeyboardInterrupt(what)

    with pytest.raises(KeyboardInterrupt):
        write_demo_capture(tmp_path / "a", **TINY, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_progress_counts_up_to_the_total(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    write_demo_capture(tmp_path / "a", **TINY, progress=lambda done, total, _: seen.append((done, total)))
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert seen[0] == (0, 4) and seen[-1] == (4, 4)


@pytest.mark.parametrize("wrong", [{"views": 0}, {"size": 4}, {"samples": 3}, {"mesh_step": 1.0}])
def test_senseless_arguments_are_refused(tmp_path: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        write_demo_capture(tmp_path / "a", **{**TINY, **wrong})


def test_shadows_only_darken() -> None:
    mesh = mesh_from_distance(head.signed_distance, head.distance_and_gradient, head.BOUNDS, 0.004)
    coefficients = light.studio_coefficients(capture.EXPOSURE)
    camera = rig.rig_cameras(8, 32, 0)[4]
    open_, shadowed = (render(scene_from_mesh(mesh, coefficients, 4, 0, shadows=s), camera, 0) for s in (False, True))
    np.testing.assert_array_equal(open_.alpha, shadowed.alpha)
    assert (shadowed.radiance <= open_.radiance + 1e-9).all()
    assert 0.5 < shadowed.radiance.sum() / open_.radiance.sum() < 0.97


@pytest.mark.parametrize("views", [1, 3, 12, 40, 61])
def test_rig_gives_every_view_a_place_of_its_own(views: int) -> None:
    cameras = rig.rig_cameras(views, 64, 0)
    assert len(cameras) == views
    centres = np.array([camera.centre for camera in cameras])
    np.testing.assert_allclose(np.linalg.norm(centres - rig.TARGET, axis=1), 1.0, atol=0.06)
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1) + 10.0 * np.eye(views)
    assert apart.min() > 0.03
    if views >= 12:
        assert (centres[:, 2] > 0).mean() > 0.5, "most views see the face"
        assert (centres[:, 2] < -0.4).any(), "some see the back"


def test_a_polarised_pair_adds_up_to_the_plain_photo(folder: Path, tmp_path: Path) -> None:
    """P + X is what a camera without a filter shows, at its own exposure; and X has no mirror reflection: it is even
    where the plain photo is not."""
    out = tmp_path / "pairs"
    write_demo_capture(out, views=VIEWS, size=SIZE, samples=16, mesh_step=0.003, polarised=True)
    assert len(list((out / "parallel").glob("*.png"))) == VIEWS
    for i in (0, 6):
        plain, cross, parallel = (linear_photo(f, i) for f in (folder, out, out / "parallel"))
        inside = (alpha_of(folder, i) > 0.99) & (parallel.max(2) < 0.98)
        total = (cross + parallel)[inside] / capture.POLARISED_EXPOSURE
        assert np.abs(total - plain[inside]).mean() < 0.003 and np.abs(total - plain[inside]).max() < 0.02
        mirror = (parallel - cross)[inside] / capture.POLARISED_EXPOSURE
        assert mirror.min() > -0.012 and 0.005 < mirror.mean() < 0.2 * plain[inside].mean()
        assert np.ptp(mirror.mean(0)) < 0.1 * mirror.mean() + 0.004  # the mirror reflection has no colour of the skin


def test_the_plain_capture_keeps_its_hash() -> None:
    request = capture.Request(3, 24, 2, 0.006, 0, False)
    assert "polarised" not in request.plain()
    assert request.digest() != capture.Request(3, 24, 2, 0.006, 0, False, polarised=True).digest()
