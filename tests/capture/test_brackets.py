"""Exposure brackets through the capture stage: how they are recognised, merged, and every way in which they are bad."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.errors import StageError
from pipeline.images import read_alpha, read_linear
from stages.capture.scan import scan_capture
from tests.capture.test_capture_files import exif_jpeg, tiff_block
from tests.capture.test_hdr import photo, scene

BASE = 1 / 100  # seconds
STOPS = (-2.0, 0.0, 2.0)


def jpeg(image: np.ndarray, seconds: float | None) -> bytes:
    """A JPEG (RGB) with its exposure in EXIF."""
    entries = []
    if seconds is not None:
        entries = [
            (0x829A, 5, 1, struct.pack("<II", round(seconds * 1e6), 1_000_000)),
            (0x829D, 5, 1, struct.pack("<II", 8, 1)),
            (0x8827, 3, 1, struct.pack("<H", 100)),
        ]
    return exif_jpeg(tiff_block("<", [], entries), image[..., ::-1])


def radiance(view: int) -> np.ndarray:
    """Of one of the views; each differs."""
    return np.roll(scene(160, 200, 3.0), 9 * view, 0)


def bracketed(folder: Path, name: str = "{view}_ev{stops:+.0f}.jpg", exif: bool = True, views: int = 3) -> Path:
    """Views of three exposures each."""
    for v in range(views):
        for k, stops in enumerate(STOPS):
            path = folder / name.format(view="abcdefg"[v], stops=stops, k=k)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(jpeg(photo(radiance(v), 2.0**stops), BASE * 2**stops if exif else None))
    return folder


def refused(gather, folder: Path) -> StageError:
    with pytest.raises(StageError) as caught:
        gather(folder)
    return caught.value


@pytest.mark.parametrize("way", ["names", "folders", "list"])
def test_each_way_of_naming_gives_one_photo_a_view(tmp_path: Path, gather, way: str) -> None:
    folder = tmp_path / "c"
    if way == "names":
        bracketed(folder)
    elif way == "folders":
        bracketed(folder, "brackets/{view}/{k}.jpg")
    else:
        bracketed(folder, "{view}{k}.jpg")
        (folder / "brackets.json").write_text(json.dumps({v: [f"{v}{k}.jpg" for k in range(3)] for v in "abc"}))
    found = gather(folder)
    views = found.artifact.views
    assert [v.merged for v in views] == [3, 3, 3] and found.artifact.warnings == ()
    assert [v.exposure for v in views] == [1, 1, 1]
    gains = []
    for n, view in enumerate(views):
        values = read_linear(found.path(view.image)).astype(np.float64)
        assert view.image.path.endswith(".exr")
        true = radiance(n)[:, 8:-8]
        ratio = values[:, 8:-8] / true
        gains.append(float(np.median(ratio)))
        assert np.quantile(np.abs(ratio / gains[-1] - 1), 0.9) < 0.05
        assert view.clipped is None or read_alpha(found.path(view.clipped))[:, :-10].max() == 0
    assert max(gains) < 1.01 * min(gains)  # one unit
    middle = read_linear(found.path(views[0].image))[40:120, 50:150]
    assert np.quantile(middle.max(2), 0.99) <= 1.0


def test_the_setting_and_a_capture_without_brackets(tmp_path: Path, gather) -> None:
    folder = bracketed(tmp_path / "c")
    plain = gather(folder, brackets="off")
    assert [v.name for v in plain.artifact.views] == ["a_ev+0.jpg", "b_ev+0.jpg", "c_ev+0.jpg"]
    assert plain.path(plain.artifact.views[0].image).read_bytes() == (folder / "a_ev+0.jpg").read_bytes()
    assert {v.merged for v in plain.artifact.views} == {1}


def test_names_tell_the_exposure_where_exif_does_not(tmp_path: Path, gather) -> None:
    found = gather(bracketed(tmp_path / "c", exif=False)).artifact
    assert [v.merged for v in found.views] == [3, 3, 3]
    error = refused(gather, bracketed(tmp_path / "d", "brackets/{view}/{k}.jpg", exif=False))
    assert "exposure of a photo in a bracket is unknown" in str(error) and "brackets.json" in error.remedy


def test_seconds_in_the_list(tmp_path: Path, gather) -> None:
    folder = bracketed(tmp_path / "c", "{view}{k}.jpg", exif=False)
    listed = {v: {"photos": [f"{v}{k}.jpg" for k in range(3)], "seconds": [BASE / 4, BASE, BASE * 4]} for v in "abc"}
    (folder / "brackets.json").write_text(json.dumps(listed))
    assert [v.merged for v in gather(folder).artifact.views] == [3, 3, 3]


def test_names_that_contradict_exif(tmp_path: Path, gather) -> None:
    folder = bracketed(tmp_path / "c")
    (folder / "b_ev+2.jpg").write_bytes(jpeg(photo(radiance(1), 4.0), BASE))
    error = refused(gather, folder)
    assert "contradict the photos' EXIF" in str(error) and "b_ev+2.jpg" in error.where and "2.00 stops" in error.value


def test_sizes_that_differ(tmp_path: Path, gather) -> None:
    folder = bracketed(tmp_path / "c")
    (folder / "a_ev-2.jpg").write_bytes(jpeg(photo(radiance(0)[:-8], 0.25), BASE / 4))
    error = refused(gather, folder)
    assert "not of one size" in str(error) and "a_ev-2.jpg" in error.where and error.value == "200 x 152"


def test_one_exposure_only(tmp_path: Path, gather) -> None:
    folder = bracketed(tmp_path / "c")
    for stops in ("-2", "+2"):
        (folder / f"a_ev{stops}.jpg").unlink()
        (folder / f"b_ev{stops}.jpg").write_bytes((folder / "b_ev+0.jpg").read_bytes())
    for path in folder.glob("b_ev*.jpg"):  # three equal exposures without numbers that say otherwise
        path.rename(folder / path.name.replace("_ev-2", "1").replace("_ev+2", "2").replace("_ev+0", "0"))
    (folder / "brackets.json").write_text(json.dumps({"b": ["b1.jpg", "b0.jpg", "b2.jpg"]}))
    found = gather(folder).artifact
    assert [v.merged for v in found.views] == [1, 1, 3]
    told = " ".join(found.warnings)
    assert "b: the 3 photos of its bracket have one exposure" in told or "b0.jpg" in told


def test_a_view_that_moved_keeps_its_middle_exposure(tmp_path: Path, gather) -> None:
    folder = bracketed(tmp_path / "c")
    turned = radiance(1)
    turned[30:130, 60:160] = turned[30:130, 60:160][::-1, ::-1]
    (folder / "b_ev-2.jpg").write_bytes(jpeg(photo(turned, 0.25), BASE / 4))
    found = gather(folder)
    assert [v.merged for v in found.artifact.views] == [3, 1, 3]
    told = [w for w in found.artifact.warnings if "not merged" in w]
    assert len(told) == 1 and told[0].startswith("b_ev+0") and "b_ev-2.jpg" in told[0]
    a, b = (float(np.median(read_linear(found.path(v.image))[:, 40:90] / radiance(n)[:, 40:90]))
            for n, v in enumerate(found.artifact.views[:2]))  # fmt: skip
    assert b == pytest.approx(a, rel=0.03)  # the same unit


def test_pixels_that_contradict_exif(tmp_path: Path, gather) -> None:
    folder = bracketed(tmp_path / "c", "brackets/{view}/{k}.jpg")
    (folder / "brackets/c/0.jpg").write_bytes(jpeg(photo(radiance(2), 0.25), BASE))
    found = gather(folder).artifact
    assert [v.merged for v in found.views] == [3, 3, 1]
    assert any("stops darker than its exposure" in w for w in found.warnings)


@pytest.mark.parametrize("text", ["[]", "{", '{"a": 3}', '{"a": ["../x.jpg"]}', '{"a": ["gone.jpg"]}',
    '{"a": ["a_ev+0.jpg", "a_ev+0.jpg"]}', '{"a": {"photos": ["a_ev+0.jpg"], "seconds": [-1]}}',
    '{"a": {"photos": ["a_ev+0.jpg"], "seconds": [1, 2]}}', '{"z": ["a_ev+0.jpg", "b_ev+0.jpg"]}'])  # fmt: skip
def test_lists_that_are_none(tmp_path: Path, text: str) -> None:
    folder = bracketed(tmp_path / "c")
    (folder / "brackets.json").write_text(text)
    with pytest.raises(StageError):
        scan_capture(folder)


def test_a_folder_without_photos(tmp_path: Path) -> None:
    folder = bracketed(tmp_path / "c")
    (folder / "brackets/a").mkdir(parents=True)
    with pytest.raises(StageError, match="brackets can't be read"):
        scan_capture(folder)


def test_given_cameras_name_one_photo_of_each_bracket(facescape, gather) -> None:
    folder, _ = facescape
    for i in range(6):
        true = cv2.resize(radiance(i), (96, 80))
        (folder / f"{i}.jpg").write_bytes(jpeg(photo(true, 1.0), BASE))
        for k, stops in enumerate((-2.0, 2.0)):
            path = folder / f"brackets/{i}/{k}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(jpeg(photo(true, 2.0**stops), BASE * 2**stops))
    found = gather(folder).artifact
    assert [v.merged for v in found.views] == [3] * 6 and all(v.camera is not None for v in found.views)
    assert [v.index for v in found.views] == list(range(6))


def test_views_of_different_middle_exposures_have_one_unit(tmp_path: Path, gather) -> None:
    """The second view was photographed at twice the exposure throughout; a surface has one value nevertheless."""
    folder = bracketed(tmp_path / "c", "brackets/{view}/{k}.jpg")
    for k, stops in enumerate(STOPS):
        (folder / f"brackets/b/{k}.jpg").write_bytes(jpeg(photo(radiance(1), 2 * 2.0**stops), 2 * BASE * 2**stops))
    found = gather(folder)
    gains = [float(np.median(read_linear(found.path(v.image))[:, 8:-8] / radiance(n)[:, 8:-8]))
             for n, v in enumerate(found.artifact.views)]  # fmt: skip
    assert max(gains) < 1.02 * min(gains) and [v.exposure for v in found.artifact.views] == [1, 1, 1]


def test_a_turned_camera_turns_the_merged_photo_with_its_clipped_pixels(tmp_path: Path, gather) -> None:
    folder = tmp_path / "c"
    for n, view in enumerate("abc"):
        true = radiance(n).copy()
        true[20:60, 20:50] = 100.0  # clipped in every exposure
        for stops in STOPS:
            image = photo(true, 2.0**stops)[..., ::-1]
            entries = [(0x829A, 5, 1, struct.pack("<II", round(BASE * 2**stops * 1e6), 1_000_000)),
                       (0x829D, 5, 1, struct.pack("<II", 8, 1)), (0x8827, 3, 1, struct.pack("<H", 100))]  # fmt: skip
            turned = [(0x112, 3, 1, struct.pack("<H", 6))]
            folder.mkdir(exist_ok=True)
            data = exif_jpeg(tiff_block("<", turned, entries), image)
            (folder / f"{view}_ev{stops:+.0f}.jpg").write_bytes(data)
    found = gather(folder)
    view = found.artifact.views[0]
    assert (view.width, view.height) == (160, 200) and view.merged == 3 and view.clipped is not None
    values, ends = read_linear(found.path(view.image)), read_alpha(found.path(view.clipped)) > 0
    assert values.shape == (200, 160, 3) and ends.shape == (200, 160)
    assert ends[25:45, 105:135].all() and not ends[60:180].any()  # a quarter turn clockwise: (x, y) to (159 - y, x)


def test_held_out_views_do_not_decide_the_gain(tmp_path: Path, gather) -> None:
    """Four of seven views are far brighter; the gain is that of the others where the bright ones are held out."""
    folder = bracketed(tmp_path / "c", "brackets/{view}/{k}.jpg", views=7)
    for v, view in enumerate("defg"):
        for k, stops in enumerate(STOPS):
            data = jpeg(photo(4 * radiance(v + 3), 2.0**stops), BASE * 2**stops)
            (folder / f"brackets/{view}/{k}.jpg").write_bytes(data)

    def gain(**settings: object) -> float:
        found = gather(folder, **settings)
        return float(np.median(read_linear(found.path(found.artifact.views[0].image))[:, 8:-8] / radiance(0)[:, 8:-8]))

    held = gain(holdout="names:d,e,f,g")
    for view in "defg":
        for path in (folder / f"brackets/{view}").iterdir():
            path.unlink()
        (folder / f"brackets/{view}").rmdir()
    assert held == pytest.approx(gain(), rel=1e-3)
