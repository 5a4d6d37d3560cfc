"""Values that are none, in every description of cameras: each is named, with its place and what to do."""

from __future__ import annotations

import io
import json
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.errors import StageError
from stages.capture.exif import Exif
from stages.capture.photometry import exposures
from stages.capture.readers.colmap_files import miscounted
from stages.capture.readers.values import flag, label, number, pixels, printable, table, words
from stages.capture.scan import scan_capture
from tests.capture.test_capture_readers import colmap, metashape, pictures, realityscan, transforms
from tests.capture.test_capture_run import plain, refused, rewrite
from tests.support.textured_ball import flat


# ------------------------------------------------------------------ one value
@pytest.mark.parametrize("value", ["1", True, None, [1], {}, float("nan"), float("inf"), 1e300, 10**400])
def test_no_numbers(value: object) -> None:
    with pytest.raises(StageError) as caught:
        number(value, "file, key")
    assert caught.value.where == "file, key" and len(str(caught.value)) < 500


@pytest.mark.parametrize("value", ["x", None, [[1], [2, 3]], [1, "2"], [[[1]]], [True], [[]] * 3 + [1], [1e300],
                                   [10**400], list(range(65)), [[0] * 10_000] * 10_000])  # fmt: skip
def test_no_tables(value: object) -> None:
    with pytest.raises(StageError):
        table(value, "here")


def test_tables_numbers_and_words_that_are_ones() -> None:
    assert table([[1, 2.5], [3, 4]], "x").tolist() == [[1, 2.5], [3, 4]]
    assert table(3, "x").shape == () and table([1, 2], "x").shape == (2,)
    assert number(-2, "x") == -2 and pixels(96.0, "x") == 96 and label(7, "x") == "7"
    assert words(" 1 2e3\n-3 ", 3, "x", "mend").tolist() == [1, 2000, -3]
    for text in ("1 2", "1 2 x", "1 2 nan", "1 2 1e300", "1 " * 100_000):
        with pytest.raises(StageError):
            words(text, 3, "x", "mend")


def test_flags_sizes_and_names() -> None:
    assert [flag(v, "x") for v in (True, False, 1, 0)] == [True, False, True, False]
    for bad in ("false", "true", 2, 0.0, None, []):
        with pytest.raises(StageError, match="neither true nor false"):
            flag(bad, "x")
    for bad in ("96px", 0, -1, 96.5, True, float("nan"), 10**9, None):
        with pytest.raises(StageError, match="whole number"):
            pixels(bad, "x")
    for bad in (None, 1.5, ["a"], "a\0b", "a" * 20_000):
        with pytest.raises(StageError, match="not text"):
            label(bad, "x")
    assert label("\ud800", "x").isascii() and len(printable("a" * 5000)) < 130


# ------------------------------------------------------------------ FaceScape
@pytest.mark.parametrize(("key", "value", "says"), [
    ("3_valid", "false", "neither true nor false"),
    ("3_K", [[1e300, 0, 1], [0, 1e300, 1], [0, 0, 1]], "too large"),
    ("3_K", [[1e13, 0, 1], [0, 1e13, 1], [0, 0, 1]], "focal length"),
    ("3_K", [[3, 0, 1], [0, 3, 1], [0, 0, 1]], "focal length"),
    ("3_K", [[150, 0, 1e6], [0, 150, 1], [0, 0, 1]], "principal point"),
    ("3_distortion", [1e14, 0, 0, 0, 0], "distortion is too large"),
    ("3_distortion", [10**400, 0, 0, 0, 0], "too large"),
    ("3_width", "96", "whole number"),
    ("3_sn", ["a"], "not text"),
    ("9999999999_K", [], "too long"),
])  # fmt: skip
def test_bad_params(facescape, gather, key: str, value: object, says: str) -> None:
    folder, params = facescape
    rewrite(folder, params, **{key: value})
    error = refused(gather, folder)
    assert says in error.what and "params.json" in str(error.where)


def test_a_camera_at_the_end_of_the_world(facescape, gather) -> None:
    folder, params = facescape
    far = np.array(params["3_Rt"])
    far[2, 3] = 1e12
    rewrite(folder, params, **{"3_Rt": far.tolist()})
    assert "too far away" in refused(gather, folder).what


# ------------------------------------------------------------------ transforms.json
@pytest.mark.parametrize(("change", "says"), [
    (lambda d: d.update(w="96px"), "whole number"),
    (lambda d: d.update(fl_x=0, camera_angle_x=0.7), "singular"),
    (lambda d: [d.pop("fl_x"), d.pop("fl_y"), d.update(camera_angle_x=4.0)], "angle of view"),
    (lambda d: d.update(is_fisheye="false"), "neither true nor false"),
    (lambda d: d.update(k1=1e14), "distortion is too large"),
    (lambda d: d.update(camera_model="OPENCV_FISHEYE", k1=1e14), "distortion is too large"),
    (lambda d: d.update(cx=True), "not a number"),
    (lambda d: d["frames"][0].update(file_path=["a"]), "not text"),
    (lambda d: d["frames"][0].update(mask_path=False), "not text"),
    (lambda d: d["frames"][0].update(mask_path=[]), "not text"),
    (lambda d: d.update(camera_model="EQUIRECTANGULAR"), "lens model is not supported"),
    (lambda d: d.update(camera_model="SIMPLE_RADIAL_FISHEYE"), "lens model is not supported"),
])  # fmt: skip
def test_bad_values_in_transforms(tmp_path: Path, change: Callable[[dict], object], says: str) -> None:
    data = transforms(tmp_path / "c")
    change(data)
    (tmp_path / "c" / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(StageError, match=says) as caught:
        scan_capture(tmp_path / "c")
    assert "transforms.json" in caught.value.where


@pytest.mark.parametrize("name", ["a" * 5000, "b/" * 3000 + "c.png", "\ud800.png", "e" * 252])
def test_a_name_that_no_file_can_have_is_a_photo_that_is_missing(tmp_path: Path, gather, name: str) -> None:
    data = transforms(tmp_path / "c")
    data["frames"][0]["file_path"] = name
    (tmp_path / "c" / "transforms.json").write_text(json.dumps(data))
    capture = gather(tmp_path / "c").artifact
    assert len(capture.views) == 3 and "put the photo back" in capture.warnings[0]
    assert len(capture.warnings[0]) < 300
    capture.canonical_json().encode()


# ------------------------------------------------------------------ IDR
def npz(claimed: str | None = None) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **{f"world_mat_{i}": np.eye(4) for i in range(4)})
    if claimed is None:
        return stream.getvalue()
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {claimed}, }}".ljust(117).encode() + b"\n"
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("world_mat_0.npy", b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header)
    return stream.getvalue()


@pytest.mark.parametrize("data", [
    b"PK\3\4 nonsense", npz()[:300], npz("(1000000000000,)"), npz("(-1, 4)"), npz("nonsense("), b"",
])  # fmt: skip
def test_an_npz_that_is_none(tmp_path: Path, data: bytes) -> None:
    folder = pictures(tmp_path / "c", [f"image/{i}.png" for i in range(4)])
    (folder / "cameras_sphere.npz").write_bytes(data)
    with pytest.raises(StageError, match="can't be read|has no cameras") as caught:
        scan_capture(folder)
    assert caught.value.where == "cameras_sphere.npz"


# ------------------------------------------------------------------ Metashape, RealityScan, COLMAP
@pytest.mark.parametrize(("old", "new", "says"), [
    ('width="96"', 'width="x"', "not a table of numbers"),
    ('width="96"', 'width="-96"', "whole number"),
    ("<f>140</f>", "<f>1e30</f>", "too large"),
    ("<k1>-0.1</k1>", "<k1>1e9</k1>", "distortion is too large"),
    ("2.5</scale>", "1e-300</scale>", "no scale"),
    ("0 0 1 1 0 0 0 1 0", "0 0 9 1 0 0 0 1 0", "not orthonormal"),
    ('encoding="UTF-8"', 'encoding="klingon"', "can't be read"),
    ("<camera id", '<camera enabled="no" id', "neither true nor false"),
    ("<camera id", '<camera enabled="" id', "neither true nor false"),
])  # fmt: skip
def test_bad_values_in_metashape(tmp_path: Path, old: str, new: str, says: str) -> None:
    metashape(tmp_path / "c", 0)
    path = tmp_path / "c" / "cameras.xml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(StageError, match=says):
        scan_capture(tmp_path / "c")


def test_bad_values_in_realityscan(tmp_path: Path) -> None:
    realityscan(tmp_path / "c", "1e12 0 0 0 0 0")
    with pytest.raises(StageError, match="distortion is too large"):
        scan_capture(tmp_path / "c")


@pytest.mark.parametrize(("name", "at"), [("images.bin", 0), ("images.bin", 8 + 64 + 11), ("cameras.bin", 0),
                                          ("points3D.bin", 0), ("frames.bin", 8 + 64), ("rigs.bin", 12)])  # fmt: skip
def test_a_colmap_count_beyond_the_file(tmp_path: Path, name: str, at: int) -> None:
    folder = pictures(tmp_path / "c", [f"images/left/{i}.jpg" for i in range(4)])
    colmap(folder, "OPENCV", False)
    files = sorted((folder / "sparse" / "0").iterdir())
    assert miscounted(files) is None
    path = folder / "sparse" / "0" / name
    data = path.read_bytes()
    path.write_bytes(data[:at] + b"\xff\xff\xff\x7f" + data[at + 4 :])
    with pytest.raises(StageError, match="COLMAP model can't be read") as caught:
        scan_capture(folder)
    assert name in caught.value.value


def test_a_colmap_name_that_is_no_text(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "c", [f"images/left/{i}.jpg" for i in range(4)])
    colmap(folder, "OPENCV", False)
    path = folder / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"left/3", b"l\xfft/3"))
    with pytest.raises(StageError, match="COLMAP model can't be read"):
        scan_capture(folder)


# ------------------------------------------------------------------ photos
def test_photos_of_other_formats_are_told_with_their_names(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c", tuple(f"{i}.png" for i in range(10)))
    for name in [*(f"h{i}.cr3" for i in range(6)), "z.webp"]:
        (folder / name).write_bytes(b"x")
    told = gather(folder).artifact.warnings
    assert len(told) == 1 and "7 pictures are not used" in told[0] and "h0.cr3" in told[0] and "z.webp" in told[0]
    assert "convert them to JPEG, PNG, TIFF or EXR" in told[0]


@pytest.mark.parametrize("suffix", [".gif", ".psd", ".CR3", ".3fr", ".RAF", ".rw2", ".webp", ".avif"])
def test_photos_of_another_format_alone_are_refused_by_name(tmp_path: Path, suffix: str) -> None:
    for i in range(3):
        (tmp_path / f"p{i}{suffix}").write_bytes(b"x")
    with pytest.raises(StageError, match="no photos") as caught:
        scan_capture(tmp_path)
    assert f"p0{suffix}" in str(caught.value) and "convert them" in caught.value.remedy


@pytest.mark.parametrize("name", ["e.jpg", "mask/a.png", "params.json", "transforms.json", "cameras_sphere.npz"])
@pytest.mark.parametrize("kind", ["dangling", "loop", "pipe"])
def test_what_is_no_file_is_refused_by_name(tmp_path: Path, name: str, kind: str) -> None:
    folder = plain(tmp_path / "c")
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("nowhere" if kind == "dangling" else path.name)
    with pytest.raises(StageError, match="no file") as caught:
        scan_capture(folder)
    assert str(path) in str(caught.value)


def test_a_photo_s_name_that_is_not_utf8(tmp_path: Path) -> None:
    folder = plain(tmp_path / "c")
    (folder / "a.jpg").rename(os.fsdecode(os.fsencode(folder) + b"/\xff.jpg"))
    with pytest.raises(StageError, match="not UTF-8") as caught:
        scan_capture(folder)
    assert "udcff" in str(caught.value.where) and "rename" in caught.value.remedy
    str(caught.value).encode()


def test_a_folder_with_a_photo_s_name_is_no_photo(tmp_path: Path) -> None:
    realityscan(tmp_path / "c", "0 0 0 0 0 0")
    (tmp_path / "c" / "folder.jpg").mkdir()
    assert len(scan_capture(tmp_path / "c").artifact.photos) == 4


@pytest.mark.parametrize("kind", [np.int16, np.int8, np.int32])
def test_pixels_with_a_sign_are_not_read(tmp_path: Path, gather, kind: type) -> None:
    folder = plain(tmp_path / "c")
    cv2.imwrite(str(folder / "d.tiff"), flat((96, 80), 3).astype(kind))
    error = refused(gather, folder)
    assert "pixel format is not supported" in error.what and error.where == "d.tiff"


def test_another_format_under_a_photo_s_name(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c")
    ok, data = cv2.imencode(".bmp", flat((96, 80), 3))
    assert ok
    (folder / "d.jpg").write_bytes(data.tobytes())
    assert "can't be decoded" in refused(gather, folder).what


def test_damaged_metadata_say_nothing_of_lens_and_light() -> None:
    assert Exif(focal_35mm=4e9).focal_px(96, 80) is None and Exif(focal_35mm=1e-9).focal_px(96, 80) is None
    assert exposures([1e-12, 1.0, 2.0], [1e-12, 0.5, 1.0]) is None
    assert exposures([0.25, 1.0, 2.0], [0.12, 0.5, 1.0]) == [0.25, 1.0, 2.0]
