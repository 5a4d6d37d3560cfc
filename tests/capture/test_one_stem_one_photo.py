"""Files with one stem are one photo: which is taken, and that no other one becomes a view."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from pipeline.capture_artifacts import CaptureSource
from stages.capture.scan import KINDS, scan_capture
from stages.capture.scan import _photos as listed
from tests.support.textured_ball import flat

IN_ORDER = ("exr", "tif", "png", "jpg", "heic", "dng")


def photos(folder: Path, *names: str) -> Path:
    """Pictures by name; those that OpenCV can't write have some bytes, for nothing decodes them here."""
    for i, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        kind = path.suffix.lower()
        own = kind in (".jpg", ".jpeg", ".png", ".tif", ".tiff")
        path.write_bytes(cv2.imencode(kind, flat((96, 80), i))[1].tobytes() if own else b"%d" % i)
    return folder


def found(folder: Path) -> CaptureSource:
    return scan_capture(folder).artifact


@pytest.mark.parametrize("first", range(len(IN_ORDER)))
def test_the_order_of_preference(tmp_path: Path, first: int) -> None:
    kinds = IN_ORDER[first:]
    source = found(photos(tmp_path, *(f"{n}.{k}" for n in "abc" for k in reversed(kinds))))
    assert [p.path for p in source.photos] == [f"{n}.{kinds[0]}" for n in "abc"]
    assert set(source.twins) == {f"{n}.{k}" for n in "abc" for k in kinds[1:]} and not source.passed_over


def test_every_kind_that_is_read_has_its_place() -> None:
    from stages.capture.readers.described import HEIF_SUFFIXES, PHOTO_SUFFIXES, RAW_SUFFIXES

    known = [s for kind in KINDS for s in kind]
    assert sorted(known) == sorted({*PHOTO_SUFFIXES, *HEIF_SUFFIXES, *RAW_SUFFIXES})


def test_the_twin_of_a_held_out_photo_is_not_fitted(tmp_path: Path, gather) -> None:
    folder = photos(tmp_path / "c", "a.jpg", "b.jpg", "c.jpg", "d.jpg", "a.TIF", "b.jpeg", "b.PNG")
    capture = gather(folder, holdout="names:a").artifact
    assert [(v.name, v.holdout) for v in capture.views] == [
        ("a.TIF", True), ("b.PNG", False), ("c.jpg", False), ("d.jpg", False),
    ]  # fmt: skip
    assert len(capture.warnings) == 1
    assert capture.warnings[0].startswith("3 files are not used") and "a.jpg, b.jpeg, b.jpg" in capture.warnings[0]


def test_one_suffix_alone_gives_no_warning(tmp_path: Path, gather) -> None:
    assert gather(photos(tmp_path / "c", "a.jpg", "b.png", "c.tif")).artifact.warnings == ()


def test_clean_plates_and_pairs_have_the_photos_format(tmp_path: Path) -> None:
    """They are compared with the photos: a TIFF of another curve beside them is passed over."""
    names = [f"{n}.jpg" for n in "abc"]
    both = [f"{folder}/{n}.{k}" for folder in ("clean_plate", "parallel") for n in "abc" for k in ("jpg", "tif")]
    source = found(photos(tmp_path, *names, *both))
    assert [p.path for p in source.plates] == [f"clean_plate/{n}" for n in names]
    assert [(p.cross, p.parallel.path) for p in source.pairs] == [(n, f"parallel/{n}") for n in names]
    assert source.twins == ("a.tif", "b.tif", "c.tif")


def test_exposures_of_a_view_in_two_formats(tmp_path: Path) -> None:
    stems = [f"{n}_ev{s}" for n in "abc" for s in ("-1", "+0", "+1")]
    source = found(photos(tmp_path, *(f"{s}.{k}" for s in stems for k in ("jpg", "tif"))))
    assert [p.path for p in source.photos] == ["a_ev+0.tif", "b_ev+0.tif", "c_ev+0.tif"]
    assert [{o.path for o in b.others} for b in source.brackets] == [{f"{n}_ev-1.tif", f"{n}_ev+1.tif"} for n in "abc"]
    assert len(source.twins) == 9


def test_a_list_of_exposures_decides_which_file_is_the_photo(tmp_path: Path) -> None:
    folder = photos(tmp_path, *(f"{n}{i}.{k}" for n in "abc" for i in range(2) for k in ("jpg", "tif")))
    (folder / "brackets.json").write_text(json.dumps({n: [f"{n}0.jpg", f"{n}1.jpg"] for n in "abc"}))
    source = found(folder)
    assert [p.path for p in source.photos] == ["a1.jpg", "b1.jpg", "c1.jpg"]
    assert [o.path for b in source.brackets for o in b.others] == ["a0.jpg", "b0.jpg", "c0.jpg"]


def test_a_file_that_the_cameras_name_is_taken(tmp_path: Path) -> None:
    folder = photos(tmp_path, "a_ev0.tif", "a_ev0.jpg", "a_ev1.tif", "a_ev1.jpg", "b_ev0.png")
    assert [p.name for p in listed(folder)] == ["a_ev0.tif", "a_ev1.tif", "b_ev0.png"]
    assert [p.name for p in listed(folder, [folder / "a_ev0.jpg"])] == ["a_ev0.jpg", "a_ev1.jpg", "b_ev0.png"]


def test_given_cameras_name_their_files(facescape) -> None:
    """Exposures and second photos beside them have the format of the file that the cameras were made for."""
    folder, _ = facescape
    photos(folder / "parallel", *(f"{i}.{k}" for i in range(6) for k in ("jpg", "tif")))
    source = found(folder)
    assert [(p.cross, p.parallel.path) for p in source.pairs] == [(f"{i}.jpg", f"parallel/{i}.jpg") for i in range(6)]
    assert [p.path for p in source.photos] == [f"{i}.jpg" for i in range(6)] and not source.twins
