"""The capture stage end to end on small folders: what passes, and every way in which a capture can be bad."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.errors import StageError, UsageError
from pipeline.images import write_exr
from pipeline.transforms import matrix
from stages.capture.quality import blurred
from stages.capture.stage import Config
from tests.capture.test_capture_files import camera_block, exif_jpeg
from tests.support.textured_ball import flat

SIZE = (96, 80)


def rewrite(folder: Path, params: dict, **changes: object) -> None:
    (folder / "params.json").write_text(json.dumps(params | changes))


def refused(gather, folder: Path, **settings: object) -> StageError:
    with pytest.raises(StageError) as caught:
        gather(folder, **settings)
    return caught.value


def test_facescape_with_masks_and_an_invalid_view(facescape, gather) -> None:
    folder, params = facescape
    rewrite(folder, params, **{"4_valid": False, "4_Rt": "nonsense of a view that is left out"})
    (folder / "mask").mkdir()
    mask = np.zeros((80, 96), np.uint8)
    mask[20:60, 30:70] = 255
    cv2.imwrite(str(folder / "mask" / "1.png"), mask)
    found = gather(folder, holdout="every:5:2")
    capture = found.artifact
    assert [v.index for v in capture.views] == [0, 1, 2, 3, 5]
    assert [v.index for v in capture.views if v.holdout] == [2]
    assert capture.left_out == ("4.jpg: params.json marks it invalid",)
    assert "only 1 of 5 views have a given mask" in capture.warnings
    view = capture.views[1]
    assert (view.width, view.height) == SIZE and view.camera_group == "96x80 | B1"
    assert view.image.path == "photos/1_1.jpg"
    assert found.path(view.image).read_bytes() == (folder / "1.jpg").read_bytes()
    assert found.path(view.mask).read_bytes() == (folder / "mask" / "1.png").read_bytes()


def test_given_cameras_project_as_opencv_does_half_a_pixel_on(facescape, gather) -> None:
    """Oracle: cv2.projectPoints with the file's own numbers; it has the first pixel's centre at 0."""
    from pipeline.transforms import project

    folder, params = facescape
    rng = np.random.default_rng(0)
    d = [0.05, -0.02, 0.003, -0.002, 0.01]
    rewrite(folder, params, **{f"{i}_distortion": d for i in range(6)})
    points = rng.uniform(-0.1, 0.1, (20, 3))
    for view in gather(folder).artifact.views:
        K, Rt = (np.array(params[f"{view.index}_{k}"]) for k in ("K", "Rt"))
        expected = cv2.projectPoints(points, cv2.Rodrigues(Rt[:, :3])[0], Rt[:, 3], K, np.array(d))[0][:, 0]
        camera = view.camera
        uv, z = project(matrix(camera.K), matrix(camera.cam_from_world), np.array(camera.distortion), points)
        np.testing.assert_allclose(uv, expected + 0.5, atol=1e-9)
        np.testing.assert_allclose(z, (points @ Rt[:, :3].T + Rt[:, 3])[:, 2])


def test_missing_photo_of_a_named_view_is_told(facescape, gather) -> None:
    folder, _ = facescape
    (folder / "3.jpg").unlink()
    capture = gather(folder).artifact
    assert capture.left_out == ("3: its photo is missing",) and "view 3" in capture.warnings[0]


def plain(folder: Path, names: tuple[str, ...] = ("a.jpg", "b.jpg", "c.jpg")) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), flat(SIZE, i))
    return folder


@pytest.mark.parametrize(("names", "indices"), [
    (("00007.jpg", "9.png", "10.jpg"), [7, 9, 10]),
    (("img1.jpg", "img10.jpg", "img2.jpg"), [0, 1, 2]),
    (("01.jpg", "1.jpg", "2.jpg"), [0, 1, 2]),
])  # fmt: skip
def test_indices_of_plain_photos(tmp_path: Path, gather, names: tuple[str, ...], indices: list[int]) -> None:
    capture = gather(plain(tmp_path / "c", names)).artifact
    assert [v.index for v in capture.views] == indices
    assert all(v.camera is None for v in capture.views)


def test_hold_out_by_name(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c", ("a.jpg", "b.jpg", "c.jpg", "d.jpg"))
    assert [v.name for v in gather(folder, holdout="names:b").artifact.views if v.holdout] == ["b.jpg"]
    assert "matches no view" in gather(folder, holdout="every:50:49").artifact.warnings[0]
    with pytest.raises(UsageError, match="e.jpg"):
        gather(folder, holdout="names:e.jpg")
    error = refused(gather, folder, holdout="names:a,b")
    assert "2 to fit, 2 held out" in error.value and "at least 3" in error.limit


def test_settings_are_checked_at_once() -> None:
    with pytest.raises(UsageError):
        Config(holdout="every:2:2")
    with pytest.raises(ValidationError):
        Config(min_views=2)


def test_a_turned_photo_is_written_upright_and_its_mask_with_it(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c", ("a.jpg", "b.jpg", "c.jpg"))
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (80, 96, 3), np.uint8), (0, 0), 3)
    (folder / "a.jpg").write_bytes(exif_jpeg(camera_block("<", 6), picture))
    (folder / "mask").mkdir()
    stored = np.zeros((80, 96), np.uint8)
    stored[10:30, 5:50] = 255
    cv2.imwrite(str(folder / "mask" / "a.png"), stored)
    found = gather(folder)
    view = found.artifact.views[0]
    assert (view.width, view.height, view.name, view.image.path) == (80, 96, "a.jpg", "photos/0_a.png")
    upright = cv2.imread(str(found.path(view.image)), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(upright, cv2.imread(str(folder / "a.jpg"), cv2.IMREAD_COLOR))
    mask = cv2.imread(str(found.path(view.mask)), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask, cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE))
    assert view.camera_group == "80x96 | Maker M 7 85mm | 85.00 mm"
    assert view.focal_px == pytest.approx(127 / 43.2666 * np.hypot(80, 96), rel=1e-4)


def test_a_given_camera_belongs_to_the_stored_pixels(facescape, gather) -> None:
    folder, _ = facescape
    picture = flat(SIZE, 0)
    (folder / "0.jpg").write_bytes(exif_jpeg(camera_block("<", 6), picture))
    view = gather(folder).artifact.views[0]
    assert (view.width, view.height, view.image.path) == (*SIZE, "photos/0_0.jpg")


def test_exr_and_sixteen_bit_photos(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c")
    cv2.imwrite(str(folder / "d.png"), flat(SIZE, 3).astype(np.uint16) * 257)
    write_exr(folder / "e.exr", np.linspace(0, 1, 80 * 96 * 3, dtype=np.float32).reshape(80, 96, 3))
    assert len(gather(folder).artifact.views) == 5
    write_exr(folder / "e.exr", np.full((80, 96, 3), np.nan, np.float32))
    assert "not finite" in refused(gather, folder).what


def test_the_same_photo_twice_is_told_and_used_once(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c")
    (folder / "z.jpg").write_bytes((folder / "a.jpg").read_bytes())
    capture = gather(folder).artifact
    assert len(capture.views) == 3 and len(capture.left_out) == 1
    assert capture.left_out[0].startswith("z.jpg: it is the same file as a.jpg")
    assert "z.jpg" in capture.warnings[0] and "or remove it" in capture.warnings[0]


def test_the_same_photo_under_two_cameras_is_told(facescape, gather) -> None:
    folder, _ = facescape
    (folder / "4.jpg").write_bytes((folder / "1.jpg").read_bytes())
    capture = gather(folder).artifact
    assert len(capture.views) == 6 and "4.jpg is the same file as 1.jpg" in capture.warnings[0]


@pytest.mark.parametrize(("copies", "refused_"), [(3, False), (4, True), (5, True)])
def test_most_photos_the_same_under_other_cameras_is_refused(facescape, gather, copies: int, refused_: bool) -> None:
    """Copies agree with each other: the comparison of cameras with photos called them good."""
    folder, _ = facescape
    for number in range(1, copies + 1):
        (folder / f"{number}.jpg").write_bytes((folder / "0.jpg").read_bytes())
    if not refused_:
        assert len(gather(folder).artifact.views) == 6
        return
    fault = refused(gather, folder)
    assert "copies of others" in fault.what and str(fault.where) == "0.jpg" and f"{copies} of 6" in str(fault.value)


def test_a_black_frame_is_left_out_and_named(facescape, gather) -> None:
    folder, _ = facescape
    cv2.imwrite(str(folder / "3.jpg"), np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    found = gather(folder)
    assert [v.index for v in found.artifact.views] == [0, 1, 2, 4, 5]
    assert "3.jpg is left out: it is blank" in found.artifact.warnings[0]
    assert "take the photo again" in found.artifact.warnings[0]
    assert not (found.folder / "photos" / "3_3.jpg").exists()


def test_a_blurred_third_is_left_out_and_named(tmp_path: Path, gather) -> None:
    folder, noise = tmp_path / "c", np.random.default_rng(1)
    folder.mkdir()
    for i in range(9):
        picture = cv2.GaussianBlur(noise.random((160, 200, 3)).astype(np.float32), (0, 0), 0.8)
        if i % 3 == 1:
            picture = cv2.GaussianBlur(picture, (0, 0), 4)
        cv2.imwrite(str(folder / f"{i}.png"), np.round(picture * 255).astype(np.uint8))
    capture = gather(folder).artifact
    assert [v.index for v in capture.views] == [0, 2, 3, 5, 6, 8]
    assert [w.split(" ")[0] for w in capture.warnings] == ["1.png", "4.png", "7.png"]
    assert all("take the photo again" in w and "capture.drop_blurred=false" in w for w in capture.warnings)
    assert len(gather(folder, drop_blurred=False).artifact.views) == 9


def test_held_out_photos_do_not_set_the_limit_for_blurred_ones(tmp_path: Path, gather) -> None:
    """Seven photos that are ten times as sharp as the five others would make these five look blurred. Of the five, one
    is; so is a held-out one."""
    flags = [True] * 5 + [False] * 8
    assert blurred([1.0] * 4 + [0.1, 0.1] + [10.0] * 7, flags) == [False] * 4 + [True] * 2 + [False] * 7
    assert blurred([0.1, 0.1, 1.0, 1.0], [True] * 4) == [False] * 4  # half of them: blur is normal here
    assert blurred([0.1, 0.1, 1.0, 1.0, 1.0, 0.1], [True] * 5 + [False]) == [True, True, False, False, False, True]
    assert blurred([1.0, 2.0], [False, False]) == [False, False]
    folder, noise = tmp_path / "c", np.random.default_rng(1)
    folder.mkdir()
    for i in range(11):  # the fitted ones, with odd numbers, are soft, the last of them very much
        soft = 3.0 if i == 9 else 1.2 if i % 2 else 0.5
        picture = cv2.GaussianBlur(noise.random((160, 200, 3)).astype(np.float32), (0, 0), soft)
        cv2.imwrite(str(folder / f"{i}.png"), np.round(picture * 255).astype(np.uint8))
    found = gather(folder, holdout="every:2:0").artifact
    assert [v.index for v in found.views if not v.holdout] == [1, 3, 5, 7] and len(found.left_out) == 1
    assert len(gather(folder, holdout="none").artifact.views) == 11 - 5  # all soft ones are less than a fifth as sharp


# ------------------------------------------------------------------ bad files
@pytest.mark.parametrize(("content", "says"), [
    (b"", "0 bytes"), (b"\xff\xd8\xff\xe0 no picture at all", "truncated"), (b"plain text", "10 bytes"),
])  # fmt: skip
def test_files_that_are_no_pictures(tmp_path: Path, gather, content: bytes, says: str) -> None:
    folder = plain(tmp_path / "c")
    (folder / "b.jpg").write_bytes(content)
    error = refused(gather, folder)
    assert error.where == "b.jpg" and says in error.value and "copy the file again" in error.remedy


def test_truncated_photos(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c", ("a.jpg", "b.jpg", "c.png"))
    for name in ("b.jpg", "c.png"):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: len(data) * 2 // 3])
        error = refused(gather, folder)
        assert error.where == name and "truncated" in error.value
        (folder / name).write_bytes(data)


def test_a_bomb_is_refused_before_anything_is_decoded(tmp_path: Path, gather, monkeypatch) -> None:
    """A JPEG whose frame header claims 65,535 x 65,535 pixels."""
    folder = plain(tmp_path / "c")
    data = bytearray((folder / "b.jpg").read_bytes())
    at = next(data.index(bytes([0xFF, m])) for m in (0xC0, 0xC2) if bytes([0xFF, m]) in data)
    data[at + 5 : at + 9] = b"\xff" * 4
    (folder / "b.jpg").write_bytes(data)
    decode, bomb = cv2.imdecode, bytes(data[at : at + 9])
    watch = lambda x, *a: pytest.fail("decoded") if bomb in x.tobytes() else decode(x, *a)  # noqa: E731
    monkeypatch.setattr(cv2, "imdecode", watch)
    error = refused(gather, folder)
    assert error.where == "b.jpg" and error.value == "65535 x 65535"


@pytest.mark.parametrize("name", ["params.json", "transforms.json"])
def test_a_description_of_absurd_size_is_not_read(tmp_path: Path, gather, name: str) -> None:
    folder = plain(tmp_path / "c")
    with (folder / name).open("wb") as f:
        f.write(b'{"frames": [{}], "0_K": ')
        f.truncate(3_000_000_000)  # sparse: takes no room on the disk
    error = refused(gather, folder)
    assert error.where == name and error.value == "3000 MB" and "64 MB" in error.limit


def test_tiny_photos(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c")
    cv2.imwrite(str(folder / "b.jpg"), flat((200, 32), 0))
    assert "200 x 32" in refused(gather, folder).value


def test_a_file_that_changes_under_way(tmp_path: Path) -> None:
    from pipeline.contract import Context
    from stages.capture.scan import scan_capture
    from stages.capture.stage import Inputs, run

    folder = plain(tmp_path / "c")
    source = scan_capture(folder)
    (folder / "b.jpg").write_bytes((folder / "a.jpg").read_bytes())
    with pytest.raises(StageError, match="changed while"):
        run(Inputs(source), Config(), Context(tmp_path / "w", tmp_path))


@pytest.mark.parametrize(("value", "what"), [(0, "empty"), (255, "full"), (100, "empty")])
def test_useless_masks_are_named_and_done_without(tmp_path: Path, gather, value: int, what: str) -> None:
    folder = plain(tmp_path / "c")
    (folder / "masks").mkdir()
    cv2.imwrite(str(folder / "masks" / "b.png"), np.full((80, 96), value, np.uint8))
    capture = gather(folder).artifact
    assert [v.mask for v in capture.views] == [None] * 3
    assert f"b.png is {what}" in capture.warnings[0] and "draw it again" in capture.warnings[0]


def test_a_mask_of_another_size_is_named_and_done_without(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c")
    (folder / "mask").mkdir()
    cv2.imwrite(str(folder / "mask" / "b.png"), np.eye(50, dtype=np.uint8) * 255)
    capture = gather(folder).artifact
    assert capture.views[1].mask is None
    assert "b.png has 50 x 50 pixels, its photo 96 x 80; export it at the photo's size" in capture.warnings[0]


def test_clean_plates_belong_to_their_photos(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c")
    (folder / "clean_plate").mkdir()
    cv2.imwrite(str(folder / "clean_plate" / "a.png"), flat(SIZE, 30))
    cv2.imwrite(str(folder / "clean_plate" / "b.jpg"), flat((90, 90), 30))
    capture = gather(folder).artifact
    assert capture.views[0].plate is not None and capture.views[0].plate.path == "plates/0_a.png"
    assert capture.views[1].plate is None and "clean plate of b.jpg has 90 x 90" in capture.warnings[0]


# ------------------------------------------------------------------ bad cameras
def broken(params: dict, key: str, row: int, column: int, value: float) -> dict:
    m = np.array(params[key], float)
    m[row, column] = value
    return {key: m.tolist()}


def mirrored(params: dict) -> dict:
    m = np.array(params["2_Rt"])
    m[0] *= -1
    return {"2_Rt": m.tolist()}


@pytest.mark.parametrize(("change", "key", "says"), [
    (lambda p: broken(p, "2_K", 0, 0, np.nan), "2_K", "not finite"),
    (lambda p: broken(p, "2_Rt", 1, 3, np.inf), "2_Rt", "not finite"),
    (lambda p: broken(p, "2_K", 0, 0, 0.0), "2_K", "singular"),
    (lambda p: {"2_K": np.zeros((3, 3)).tolist()}, "2_K", "singular"),
    (lambda p: broken(p, "2_K", 1, 1, -150.0), "2_K", "singular"),
    (lambda p: {"2_K": np.array(p["2_K"]).T.tolist()}, "2_K", "upper triangular"),
    (lambda p: {"2_K": [1, 2, 3]}, "2_K", "shape"),
    (lambda p: {"2_K": [[1, 2], [3]]}, "2_K", "numbers"),
    (lambda p: {"2_K": "abc"}, "2_K", "numbers"),
    (lambda p: {"2_K": None}, "2_K", "numbers"),
    (mirrored, "2_Rt", "left-handed"),
    (lambda p: {"2_Rt": (np.array(p["2_Rt"]) * 1.01).tolist()}, "2_Rt", "not orthonormal"),
    (lambda p: {"2_Rt": np.array(p["2_Rt"])[:, :3].tolist()}, "2_Rt", "shape"),
    (lambda p: {"2_distortion": [0.1, 0.2]}, "2_distortion", "coefficients"),
    (lambda p: {"2_width": 96.5}, "2_width", "whole number"),
    (lambda p: {"2_height": -1}, "2_height", "whole number"),
])  # fmt: skip
def test_bad_cameras_are_refused_by_key(facescape, gather, change, key: str, says: str) -> None:
    folder, params = facescape
    rewrite(folder, params, **change(params))
    error = refused(gather, folder)
    assert key in str(error.where) and says in error.what and error.remedy and str(error.limit)
    rewrite(folder, params, **change(params), **{"2_valid": False})
    assert len(gather(folder).artifact.views) == 5  # a view that is left out may hold anything


@pytest.mark.parametrize("key", ["K", "Rt", "distortion", "width", "height"])
def test_missing_keys_are_named(facescape, gather, key: str) -> None:
    folder, params = facescape
    del params[f"5_{key}"]
    rewrite(folder, params)
    assert f"5_{key}" in refused(gather, folder).where


def test_printed_rotations_pass_and_become_exact(facescape, gather) -> None:
    folder, params = facescape
    rewrite(folder, params, **{"2_Rt": np.round(params["2_Rt"], 4).tolist()})
    R = matrix(gather(folder).artifact.views[2].camera.cam_from_world)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R, np.array(params["2_Rt"])[:, :3], atol=1e-4)


def test_photos_of_other_sizes_than_declared(facescape, gather) -> None:
    folder, params = facescape
    rewrite(folder, params, **{"2_width": 192, "2_height": 160})
    error = refused(gather, folder)
    assert error.where == "2.jpg" and error.value == "96 x 80" and error.limit == "192 x 160"


def test_too_few_valid_views(facescape, gather) -> None:
    folder, params = facescape
    rewrite(folder, params, **{f"{i}_valid": False for i in range(4)})
    assert "2 to fit" in refused(gather, folder).value


def test_exif_pixel_width_of_zero_is_no_focal_length(tmp_path: Path, gather) -> None:
    folder = plain(tmp_path / "c")
    block = camera_block("<", 1).replace(struct.pack("<HHI", 0xA405, 3, 1) + struct.pack("<H", 127),
                                         struct.pack("<HHI", 0xA405, 3, 1) + struct.pack("<H", 0))  # fmt: skip
    (folder / "a.jpg").write_bytes(exif_jpeg(block, flat(SIZE, 0)))
    assert gather(folder).artifact.views[0].focal_px == pytest.approx(85 * 4000 / 30 * 96 / 4000, rel=1e-6)
