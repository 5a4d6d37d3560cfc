"""Every format of given cameras: written here by the format's own formulas, read, and projected with."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from pipeline.capture_artifacts import CaptureView
from pipeline.errors import StageError
from pipeline.transforms import F64, inverse_rigid, matrix, project
from stages.capture.readers import find_reader
from stages.capture.readers.described import five_terms
from stages.capture.readers.idr import camera_of_projection
from stages.capture.readers.sizes import picture_size
from stages.capture.scan import scan_capture
from tests.support.textured_ball import camera_on_orbit, flat

SIZE = (96, 80)
F, CX, CY = 140.0, 50.5, 38.25
POINTS = np.random.default_rng(3).uniform(-0.2, 0.2, (20, 3))
POSES = [camera_on_orbit(25.0 * i, 8.0 * i - 10, 1.0, np.zeros(3)) for i in range(4)]  # world_from_cam, OpenCV axes
CAMS = [inverse_rigid(p) for p in POSES]


def pictures(folder: Path, names: list[str]) -> Path:
    for i, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), flat(SIZE, i))
    return folder


def plane(i: int) -> F64:
    """(N, 2) positions of POINTS on camera i's plane z = 1."""
    p = POINTS @ CAMS[i][:3, :3].T + CAMS[i][:3, 3]
    return p[:, :2] / p[:, 2:]


def seen_by(view: CaptureView, points: F64 = POINTS) -> F64:
    camera = view.camera
    assert camera is not None
    return project(matrix(camera.K), matrix(camera.cam_from_world), np.array(camera.distortion), points)[0]


def close(view: CaptureView, uv: F64, tolerance: float = 1e-6) -> None:
    np.testing.assert_allclose(seen_by(view), uv, rtol=0, atol=tolerance)


# ------------------------------------------------------------------ transforms.json
def transforms(folder: Path, **more: object) -> dict:
    """Four frames with instant-ngp's keys, OpenGL axes."""
    opengl = [p @ np.diag([1.0, -1, -1, 1]) for p in POSES]
    names = [f"images/{i:03d}.png" for i in range(4)]
    pictures(folder, names)
    data = {"fl_x": F, "fl_y": F + 2, "cx": CX, "cy": CY, "w": SIZE[0], "h": SIZE[1], **more,
            "frames": [{"file_path": "./" + n, "transform_matrix": m.tolist()}
                       for n, m in zip(names, opengl, strict=True)]}  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(data))
    return data


def test_transforms_json(tmp_path: Path, gather) -> None:
    transforms(tmp_path / "c")
    capture = gather(tmp_path / "c").artifact
    assert capture.kind == "transforms" and [v.index for v in capture.views] == [0, 1, 2, 3]
    for i, view in enumerate(capture.views):
        x, y = plane(i).T
        close(view, np.stack([F * x + CX, (F + 2) * y + CY], 1))


def test_transforms_json_with_opencv_and_fisheye_lenses(tmp_path: Path, gather) -> None:
    d = {"k1": -0.2, "k2": 0.05, "p1": 0.003, "p2": -0.002}
    transforms(tmp_path / "a", camera_model="OPENCV", **d)
    K = np.array([[F, 0, CX], [0, F + 2, CY], [0, 0, 1]])
    for i, view in enumerate(gather(tmp_path / "a").artifact.views):
        rvec = cv2.Rodrigues(CAMS[i][:3, :3])[0]
        uv, _ = cv2.projectPoints(POINTS, rvec, CAMS[i][:3, 3], K, np.array([-0.2, 0.05, 0.003, -0.002]))
        close(view, uv[:, 0])
    transforms(tmp_path / "b", camera_model="OPENCV_FISHEYE", k1=0.02, k2=-0.01, k3=0.003, k4=-0.001)
    for i, view in enumerate(gather(tmp_path / "b").artifact.views):
        rvec = cv2.Rodrigues(CAMS[i][:3, :3])[0]
        uv, _ = cv2.fisheye.projectPoints(
            POINTS[:, None], rvec, CAMS[i][:3, 3], K, np.array([0.02, -0.01, 0.003, -0.001])
        )
        inside = ((uv[:, 0] > 0) & (uv[:, 0] < SIZE)).all(1)
        np.testing.assert_allclose(seen_by(view)[inside], uv[inside, 0], atol=0.25)


def test_transforms_json_with_an_angle_and_no_size(tmp_path: Path, gather) -> None:
    data = transforms(tmp_path / "c")
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del data[key]
    data["camera_angle_x"] = 2 * np.arctan(SIZE[0] / 2 / F)
    (tmp_path / "c" / "transforms.json").write_text(json.dumps(data))
    for i, view in enumerate(gather(tmp_path / "c").artifact.views):
        close(view, F * plane(i) + np.array(SIZE) / 2)


def test_transforms_json_that_lists_absent_files(tmp_path: Path, gather) -> None:
    transforms(tmp_path / "c")
    (tmp_path / "c" / "images" / "001.png").unlink()
    capture = gather(tmp_path / "c").artifact
    assert [v.index for v in capture.views] == [0, 2, 3] and capture.left_out == ("001.png: its photo is missing",)
    assert "images/001.png" in capture.warnings[0] and "put the photo back" in capture.warnings[0]
    for i in (0, 2, 3):
        (tmp_path / "c" / "images" / f"{i:03d}.png").unlink()
    with pytest.raises(StageError, match="no photos") as caught:
        scan_capture(tmp_path / "c")
    assert "images/000.png" in str(caught.value) and "remove the file" in caught.value.remedy


@pytest.mark.parametrize(("change", "says"), [
    (lambda d: d["frames"][1].pop("transform_matrix"), "no pose"),
    (lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(0, 9.0), "not orthonormal"),
    (lambda d: d["frames"][1].update(transform_matrix="x"), "not a table"),
    (lambda d: d.update(fl_x="wide"), "not a number"),
    (lambda d: d.update(fl_x=-5), "singular"),
    (lambda d: d.update(frames=[]), "has no frames"),
    (lambda d: [d.pop(k) for k in ("fl_x", "fl_y")], "no focal length"),
])  # fmt: skip
def test_bad_transforms_json(tmp_path: Path, change: Callable[[dict], object], says: str) -> None:
    data = transforms(tmp_path / "c")
    change(data)
    (tmp_path / "c" / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(StageError, match=says) as caught:
        scan_capture(tmp_path / "c")
    assert "transforms.json" in caught.value.where


# ------------------------------------------------------------------ IDR, NeuS
def test_idr_npz(tmp_path: Path, gather) -> None:
    folder = pictures(tmp_path / "c", [f"image/{i:06d}.png" for i in range(4)])
    K = np.array([[F, 0.5, CX], [0, F + 2, CY], [0, 0, 1]])
    data = {}
    for i, cam in enumerate(CAMS):
        P = np.eye(4)
        P[:3] = K @ cam[:3] * (-3.7 if i == 2 else 0.2 + i)  # projections are known up to a factor
        data[f"world_mat_{i}"], data[f"scale_mat_{i}"] = P, np.eye(4)
        (folder / "mask").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "mask" / f"{i:03d}.png"), np.eye(96, dtype=np.uint8)[:80] * 255)
    np.savez(folder / "cameras_sphere.npz", **data)
    capture = gather(folder).artifact
    assert capture.kind == "idr" and all(v.mask for v in capture.views)
    for i, view in enumerate(capture.views):
        x, y = plane(i).T
        close(view, np.stack([F * x + 0.5 * y + CX + 0.5, (F + 2) * y + CY + 0.5], 1))  # first pixel's centre at 0


def test_a_projection_without_a_camera() -> None:
    with pytest.raises(StageError, match="is no camera"):
        camera_of_projection(np.ones((3, 4)), "P")


# ------------------------------------------------------------------ Metashape
METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1"><sensors><sensor id="0" label="cam" type="frame">
<resolution width="96" height="80"/><calibration type="frame" class="adjusted"><resolution width="96" height="80"/>
<f>140</f><cx>2.5</cx><cy>-1.75</cy><b1>1.5</b1><b2>0.25</b2><k1>-0.1</k1><k2>0.02</k2><k3>-0.004</k3>{k4}
<p1>0.002</p1><p2>-0.003</p2></calibration></sensor></sensors><cameras>{cameras}</cameras>
<transform><rotation>0 0 1 1 0 0 0 1 0</rotation><translation>1 2 3</translation><scale>2.5</scale></transform>
</chunk></document>"""
CHUNK = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])  # world = 2.5 * CHUNK @ chunk + (1, 2, 3)


def metashape(folder: Path, k4: float) -> None:
    def camera(i: int) -> str:
        numbers = " ".join(f"{x:.17g}" for x in POSES[i].ravel())
        transform = f"<transform>{numbers}</transform>" if i < 4 else ""
        return f'<camera id="{i}" sensor_id="0" label="IMG_{i}">{transform}</camera>'

    pictures(folder, [f"IMG_{i}.jpg" for i in range(5)])
    POSES.append(np.eye(4))
    cameras = "".join(camera(i) for i in range(5))
    POSES.pop()
    k = f"<k4>{k4}</k4>" if k4 else ""
    (folder / "cameras.xml").write_text(METASHAPE.format(cameras=cameras, k4=k))


@pytest.mark.parametrize(("k4", "tolerance"), [(0.0, 1e-6), (0.003, 0.02)])
def test_metashape_xml(tmp_path: Path, gather, k4: float, tolerance: float) -> None:
    metashape(tmp_path / "c", k4)
    capture = gather(tmp_path / "c").artifact
    assert capture.kind == "metashape" and len(capture.views) == 4
    assert capture.left_out == ("IMG_4: not aligned in cameras.xml",)
    world = 2.5 * POINTS @ CHUNK.T + (1, 2, 3)
    for i, view in enumerate(capture.views):
        x, y = plane(i).T
        r2 = x * x + y * y
        bent = 1 - 0.1 * r2 + 0.02 * r2**2 - 0.004 * r2**3 + k4 * r2**4
        a = x * bent + 0.002 * (r2 + 2 * x * x) + 2 * -0.003 * x * y
        b = y * bent + -0.003 * (r2 + 2 * y * y) + 2 * 0.002 * x * y
        uv = np.stack([48 + 2.5 + a * 140 + a * 1.5 + b * 0.25, 40 - 1.75 + b * 140], 1)
        np.testing.assert_allclose(seen_by(view, world), uv, rtol=0, atol=tolerance)


def test_bad_metashape_xml(tmp_path: Path) -> None:
    metashape(tmp_path / "c", 0)
    path = tmp_path / "c" / "cameras.xml"
    good = path.read_text()
    for change, says in (
        (good.replace("<f>140</f>", "<f>wide</f>"), "not a table of numbers"),
        (good.replace('type="frame" class', 'type="fisheye" class'), "lens model is not supported"),
        (good[:-30], "can't be read"),
        (good.replace("2.5</scale>", "-1</scale>"), "no scale"),
    ):
        path.write_text(change)
        with pytest.raises(StageError, match=says):
            scan_capture(tmp_path / "c")


# ------------------------------------------------------------------ RealityScan
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" xcr:PosePrior="exact"
 xcr:FocalLength35mm="{f35}" xcr:PrincipalPointU="{u}" xcr:PrincipalPointV="{v}" xcr:DistortionModel="{model}">
<xcr:Rotation>{R}</xcr:Rotation><xcr:Position>{c}</xcr:Position>
<xcr:DistortionCoeficients>{d}</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"""


def realityscan(folder: Path, d: str, model: str = "brown4t2") -> None:
    pictures(folder, [f"IMG_{i}.jpg" for i in range(5)])
    for i in range(4):
        text = XMP.format(f35=F * 36 / 96, u=(CX - 48) / 96, v=(CY - 40) / 96, d=d, model=model,
                          R=" ".join(f"{x:.17g}" for x in CAMS[i][:3, :3].ravel()),
                          c=" ".join(f"{x:.17g}" for x in POSES[i][:3, 3]))  # fmt: skip
        (folder / f"IMG_{i}.xmp").write_text(text)


@pytest.mark.parametrize(("k4", "tolerance"), [(0.0, 1e-6), (0.003, 0.02)])
def test_realityscan_xmp(tmp_path: Path, gather, k4: float, tolerance: float) -> None:
    realityscan(tmp_path / "c", f"-0.1 0.02 -0.004 {k4} 0.002 -0.003")
    capture = gather(tmp_path / "c").artifact
    assert capture.kind == "realityscan" and len(capture.views) == 4
    assert "IMG_4.jpg: it was not registered" in capture.left_out[0]
    for i, view in enumerate(capture.views):
        x, y = plane(i).T
        r2 = x * x + y * y
        bent = 1 - 0.1 * r2 + 0.02 * r2**2 - 0.004 * r2**3 + k4 * r2**4
        a = x * bent - 0.003 * (r2 + 2 * x * x) + 2 * 0.002 * x * y
        b = y * bent + 0.002 * (r2 + 2 * y * y) + 2 * -0.003 * x * y
        close(view, np.stack([F * a + CX, F * b + CY], 1), tolerance)


def test_realityscan_without_distortion_and_with_a_foreign_lens(tmp_path: Path, gather) -> None:
    realityscan(tmp_path / "a", "0.5 0 0 0 0 0", "perspective")
    for i, view in enumerate(gather(tmp_path / "a").artifact.views):
        close(view, F * plane(i) + (CX, CY))
    realityscan(tmp_path / "b", "0.5 0 0 0 0 0", "division")
    with pytest.raises(StageError, match="lens model is not supported"):
        scan_capture(tmp_path / "b")
    (tmp_path / "a" / "IMG_1.xmp").write_text("<xcr:Position capturingreality.com/ns/xcr")
    with pytest.raises(StageError, match="can't be read") as caught:
        scan_capture(tmp_path / "a")
    assert caught.value.where == "IMG_1.xmp"


# ------------------------------------------------------------------ COLMAP
LENSES = {
    "SIMPLE_PINHOLE": [F, CX, CY], "PINHOLE": [F, F + 2, CX, CY], "SIMPLE_RADIAL": [F, CX, CY, -0.1],
    "RADIAL": [F, CX, CY, -0.1, 0.03], "OPENCV": [F, F + 2, CX, CY, -0.1, 0.03, 0.002, -0.001],
    "FULL_OPENCV": [F, F + 2, CX, CY, -0.1, 0.03, 0.002, -0.001, 0.01, 0.02, 0.01, -0.01],
    "OPENCV_FISHEYE": [F, F + 2, CX, CY, 0.02, -0.01, 0.003, -0.001], "SIMPLE_RADIAL_FISHEYE": [F, CX, CY, 0.02],
    "RADIAL_FISHEYE": [F, CX, CY, 0.02, -0.01], "FOV": [F, F + 2, CX, CY, 0.4],
    "THIN_PRISM_FISHEYE": [F, F, CX, CY, 0.01, 0.0, 0.001, 0.001, 0.0, 0.0, 0.001, -0.001],
    "SIMPLE_DIVISION": [F, CX, CY, -0.05], "SIMPLE_FISHEYE": [F, CX, CY],
}  # fmt: skip


def colmap(folder: Path, model: str, text: bool) -> pycolmap.Camera:
    camera = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=LENSES[model], camera_id=1)
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(camera)
    for i, cam in enumerate(CAMS):
        image = pycolmap.Image(name=f"left/{i}.jpg", camera_id=1, image_id=i + 1)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam[:3]))
    (folder / "sparse" / "0").mkdir(parents=True)
    (made.write_text if text else made.write_binary)(str(folder / "sparse" / "0"))
    return camera


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", sorted(LENSES))
def test_colmap_models(tmp_path: Path, gather, model: str, text: bool) -> None:
    folder = pictures(tmp_path / "c", [f"images/left/{i}.jpg" for i in range(4)])
    camera = colmap(folder, model, text)
    capture = gather(folder).artifact
    assert capture.kind == "colmap" and len(capture.views) == 4
    exact = model in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
    for i, view in enumerate(capture.views):
        p = POINTS @ CAMS[i][:3, :3].T + CAMS[i][:3, 3]
        uv = np.array([camera.img_from_cam(q) for q in p])
        inside = ((uv > 0) & (uv < SIZE)).all(1)
        assert inside.sum() > 10
        np.testing.assert_allclose(seen_by(view)[inside], uv[inside], rtol=0, atol=1e-6 if exact else 0.25)


def test_colmap_photos_that_are_absent_and_damage(tmp_path: Path, gather) -> None:
    folder = pictures(tmp_path / "c", [f"images/{i}.jpg" for i in range(3)])  # found by name, not in left/
    colmap(folder, "PINHOLE", False)
    capture = gather(folder).artifact
    assert [v.index for v in capture.views] == [0, 1, 2] and "left/3.jpg" in capture.warnings[0]
    path = folder / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(StageError, match="COLMAP model"):
        scan_capture(folder)


# ------------------------------------------------------------------ in general
def test_a_lens_beyond_five_terms_is_refused() -> None:
    def folded(xy: F64) -> F64:
        return xy * (1 + np.sin(40 * xy)) * 50 + 48

    with pytest.raises(StageError, match="can't be described"):
        five_terms(folded, np.array([[50.0, 0, 48], [0, 50, 48], [0, 0, 1]]), 96, 96, "x")


def test_paths_that_lead_out_of_the_capture_are_not_followed(tmp_path: Path) -> None:
    data = transforms(tmp_path / "c")
    pictures(tmp_path, ["secret.png"])
    data["frames"][0]["file_path"] = "../secret.png"
    (tmp_path / "c" / "transforms.json").write_text(json.dumps(data))
    assert "secret.png" not in [Path(p.path).name for p in scan_capture(tmp_path / "c").artifact.photos]


def test_other_files_are_not_taken_for_cameras(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "c", ["a.jpg", "b.jpg", "c.jpg"])
    (folder / "notes.xml").write_text("<notes/>")
    (folder / "a.xmp").write_text("<x:xmpmeta xmlns:x='adobe:ns:meta/'>rating</x:xmpmeta>")
    np.savez(folder / "cameras.npz", a=1)
    assert find_reader(folder) is None


def test_sizes_from_headers(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.png", "c.tif"):
        cv2.imwrite(str(tmp_path / name), flat(SIZE, 0))
        assert picture_size(tmp_path / name) == SIZE
