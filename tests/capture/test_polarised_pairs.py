"""Polarised pairs through the capture stage, and the two parts of the light in them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline import polarised
from pipeline.errors import StageError
from pipeline.images import read_alpha, read_linear
from stages.capture.scan import scan_capture
from tests.capture.test_brackets import BASE, jpeg
from tests.capture.test_hdr import photo, scene


def parts(view: int) -> tuple[np.ndarray, np.ndarray]:
    """Diffuse and mirror part (H, W, 3) of a view."""
    diffuse = np.roll(scene(160, 200, 0.6), 9 * view, 0)
    y, x = np.mgrid[:160, :200]
    spot = 0.15 * np.exp(-((x - 100 - 5 * view) ** 2 + (y - 80) ** 2) / 800)
    return diffuse, np.repeat(spot[..., None], 3, 2)


def filtered(view: int) -> tuple[np.ndarray, np.ndarray]:
    """Cross- and parallel-polarised photos by Malus's law for unpolarised light, and none for what stays polarised."""
    diffuse, mirror = parts(view)
    return photo(0.5 * diffuse, 1.0), photo(0.5 * diffuse + mirror, 1.0)


def paired(
    folder: Path, cross: str = "{view}_cross.jpg", parallel: str = "{view}_parallel.jpg", views: int = 3
) -> Path:
    for v in range(views):
        for pattern, image in zip((cross, parallel), filtered(v), strict=True):
            path = folder / pattern.format(view="abcdef"[v], n=v)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(jpeg(image, BASE))
    return folder


def refused(gather, folder: Path) -> StageError:
    with pytest.raises(StageError) as caught:
        gather(folder)
    return caught.value


WAYS = [
    ("{view}_cross.jpg", "{view}_parallel.jpg"),
    ("{view}_x.jpg", "{view}_p.jpg"),
    ("cross/{view}.jpg", "parallel/{view}.jpg"),
    ("{view}.jpg", "parallel/{view}.jpg"),
]


@pytest.mark.parametrize(("cross", "parallel"), WAYS)
def test_each_way_of_naming(tmp_path: Path, gather, cross: str, parallel: str) -> None:
    found = gather(paired(tmp_path / "c", cross, parallel))
    capture = found.artifact
    assert len(capture.views) == 3 and capture.polarised and capture.warnings == ()
    for n, view in enumerate(capture.views):
        assert view.parallel is not None and view.parallel_exposure == 1
        one, two = read_linear(found.path(view.image)), read_linear(found.path(view.parallel))
        diffuse, mirror = parts(n)
        assert np.abs(2 * polarised.specular(one, two) - mirror).mean() < 0.006
        assert np.abs(2 * polarised.unpolarised(one, two) - diffuse - mirror).mean() < 0.006
        assert np.abs(2 * one - diffuse).mean() < 0.006


@pytest.mark.parametrize(("cross", "parallel"), WAYS)
def test_both_photos_of_a_pair_may_be_clipped(tmp_path: Path, gather, cross: str, parallel: str) -> None:
    """Also where both have one name: each has a picture of its own clipped pixels."""
    folder = tmp_path / "c"
    for n in range(3):
        for rows, name, image in zip((slice(8), slice(16)), (cross, parallel), filtered(n), strict=True):
            image[rows] = 255
            path = folder / name.format(view="abc"[n])
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(jpeg(image, BASE))
    found = gather(folder)
    for view in found.artifact.views:
        assert view.clipped is not None and view.parallel_clipped is not None
        ends, of_pair = (read_alpha(found.path(f))[:, :20] > 0 for f in (view.clipped, view.parallel_clipped))
        assert ends[:8].all() and not ends[9:].any() and of_pair[:16].all() and not of_pair[17:].any()


def test_the_setting_uses_the_cross_polarised_ones_as_any_photos(tmp_path: Path, gather) -> None:
    found = gather(paired(tmp_path / "c"), polarised="off").artifact
    assert [v.name for v in found.views] == ["a_cross.jpg", "b_cross.jpg", "c_cross.jpg"]
    assert not found.polarised


def test_with_given_cameras(facescape, gather) -> None:
    folder, _ = facescape
    (folder / "parallel").mkdir()
    for i in range(6):
        for at, image in zip((folder, folder / "parallel"), filtered(i), strict=True):
            (at / f"{i}.jpg").write_bytes(jpeg(cv2.resize(image, (96, 80)), BASE))
    found = gather(folder).artifact
    assert found.polarised and all(v.camera is not None and v.parallel is not None for v in found.views)
    (folder / "parallel/3.jpg").unlink()
    error = refused(gather, folder)
    assert "do not pair" in str(error) and "3.jpg" in error.value


def test_photos_without_the_other_half(tmp_path: Path) -> None:
    folder = paired(tmp_path / "c", views=4)
    (folder / "b_parallel.jpg").unlink()
    (folder / "d_cross.jpg").unlink()
    with pytest.raises(StageError) as caught:
        scan_capture(folder)
    assert "do not pair" in str(caught.value)
    assert "b_cross.jpg" in caught.value.value and "d_parallel.jpg" in caught.value.value


def test_a_photo_among_pairs_that_is_none(tmp_path: Path) -> None:
    folder = paired(tmp_path / "c")
    (folder / "single.jpg").write_bytes(jpeg(filtered(5)[0], BASE))
    with pytest.raises(StageError) as caught:
        scan_capture(folder)
    assert "single.jpg" in caught.value.value


def test_names_that_end_alike_by_chance_are_no_pairs(tmp_path: Path, gather) -> None:
    folder = tmp_path / "c"
    folder.mkdir()
    for n, name in enumerate(("left_p.jpg", "mid_p.jpg", "top_x.jpg")):
        (folder / name).write_bytes(jpeg(filtered(n)[0], BASE))
    found = gather(folder).artifact
    assert len(found.views) == 3 and not found.polarised


def test_sizes_that_differ(tmp_path: Path, gather) -> None:
    folder = paired(tmp_path / "c")
    (folder / "b_parallel.jpg").write_bytes(jpeg(filtered(1)[1][:-10], BASE))
    error = refused(gather, folder)
    assert "not of one size" in str(error) and "200 x 160 and 200 x 150" in error.value


def test_a_cross_photo_that_is_brighter(tmp_path: Path, gather) -> None:
    folder = paired(tmp_path / "c", "{view}_parallel.jpg", "{view}_cross.jpg")
    error = refused(gather, folder)
    assert "is brighter than its parallel" in str(error) and "exchange" in error.remedy


def test_exif_of_a_pair_makes_them_comparable(tmp_path: Path, gather) -> None:
    """The parallel photos at half the exposure are darker, and still show more light."""
    folder = paired(tmp_path / "c")
    for n, view in enumerate("abc"):
        diffuse, mirror = parts(n)
        (folder / f"{view}_parallel.jpg").write_bytes(jpeg(photo(0.5 * diffuse + mirror, 0.5), BASE / 2))
    found = gather(folder)
    view = found.artifact.views[0]
    assert view.parallel_exposure == pytest.approx(0.5, rel=1e-4)
    one, two = read_linear(found.path(view.image)), read_linear(found.path(view.parallel))
    assert np.abs(2 * polarised.specular(one, two, view.parallel_exposure) - parts(0)[1]).mean() < 0.008


def test_a_pair_whose_camera_moved_and_one_without_highlights(tmp_path: Path, gather) -> None:
    folder = paired(tmp_path / "c", views=4)
    shifted = np.roll(filtered(1)[1], (3, 5), (0, 1))
    (folder / "b_parallel.jpg").write_bytes(jpeg(shifted, BASE))
    (folder / "d_parallel.jpg").write_bytes(jpeg(filtered(3)[0], BASE))
    found = gather(folder).artifact
    assert [v.parallel is None for v in found.views] == [False, True, False, False]
    told = " ".join(found.warnings)
    assert "camera moved" in told and "(b_cross.jpg)" in told and "hardly differ (d_cross.jpg)" in told


def test_brackets_and_pairs_together_are_refused(tmp_path: Path) -> None:
    folder = paired(tmp_path / "c")
    for stops in ("-2", "0"):
        (folder / f"z_ev{stops}.jpg").write_bytes(jpeg(filtered(0)[0], BASE))
    with pytest.raises(StageError, match="both exposure brackets and polarised pairs"):
        scan_capture(folder)


def test_nothing_and_everything() -> None:
    black, white = np.zeros((2, 2, 3), np.float32), np.ones((2, 2, 3), np.float32)
    assert (polarised.specular(black, black) == 0).all() and (polarised.unpolarised(white, white) == 1).all()


def test_flash_that_fired_in_some_photos_only(tmp_path: Path, gather) -> None:
    import struct

    from tests.capture.test_capture_files import exif_jpeg, tiff_block

    folder = tmp_path / "c"
    folder.mkdir()
    for n, fired in enumerate((1, 1, 1, 16)):  # 16: off, as the camera was told
        block = tiff_block("<", [], [(0x9209, 3, 1, struct.pack("<H", fired))])
        (folder / f"{n}.jpg").write_bytes(exif_jpeg(block, filtered(n)[0][..., ::-1]))
    told = [w for w in gather(folder).artifact.warnings if "flash" in w]
    assert len(told) == 1 and "3 photos and not in 1" in told[0] and "3.jpg without flash" in told[0]
    (folder / "3.jpg").unlink()
    assert not [w for w in gather(folder).artifact.warnings if "flash" in w]


def test_a_cross_photo_is_compared_at_one_exposure(tmp_path: Path, gather) -> None:
    """Parallel photos that are brighter only because their exposure was longer."""
    folder = paired(tmp_path / "c")
    for n, view in enumerate("abc"):
        (folder / f"{view}_parallel.jpg").write_bytes(jpeg(photo(0.8 * 0.5 * parts(n)[0], 2.0), 2 * BASE))
    error = refused(gather, folder)
    assert "is brighter than its parallel" in str(error) and float(error.value.split()[0]) == pytest.approx(1.25, 0.02)
