"""Clipped pixels, exposures and white balance: what is written of them, and when EXIF is not believed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.artifacts import CameraSet, FileRef, Located, MaskSet, ViewMask
from pipeline.capture_artifacts import Capture
from pipeline.colour import srgb_from_linear
from pipeline.images import read_alpha
from stages.capture.photometry import clipped, exposures, mean_light
from stages.inverse_rendering.load_views import read_views
from stages.inverse_rendering.ray_sampling import PhotoView, PixelTable
from tests.capture.test_capture_files import exif_jpeg, place_block

NOISE = cv2.GaussianBlur(np.random.default_rng(5).random((160, 200, 3)), (0, 0), 2)
RADIANCE = ((NOISE - NOISE.min()) / np.ptp(NOISE)) * 0.2 + 0.02


def test_clipped_is_the_end_of_the_range() -> None:
    eight = np.zeros((4, 5, 3), np.uint8)
    eight[1, 2, 1], eight[0, 0, 2], eight[3, 3] = 255, 253, 252
    assert [tuple(p) for p in np.argwhere(clipped(eight))] == [(0, 0), (1, 2)]
    assert clipped(eight.astype(np.uint16) * 257).sum() == 2
    assert not clipped(
        np.dstack([eight[..., 1:2] * 0, eight[..., :1] * 0, eight[..., :1] * 0, eight[..., :1] + 255])
    ).any()
    assert clipped(np.full((2, 2, 1), 255, np.uint8)).all()
    linear = np.random.default_rng(0).random((40, 50, 3)).astype(np.float32) * 9
    assert not clipped(linear).any()  # one largest value is no end of a sensor
    assert clipped(np.minimum(linear, 4)).sum() == (linear.max(2) >= 4).sum()
    assert not clipped(np.zeros((40, 50, 3), np.float32)).any()


def test_mean_light_is_linear() -> None:
    grey = np.array([[0, 255]], np.uint8)
    assert mean_light(grey) == pytest.approx(0.5)


def test_exposures_where_the_photos_bear_them_out() -> None:
    rng = np.random.default_rng(0)
    e = np.array([1.0, 2.0, 4.0, 2.0, 1.0, 8.0, 2.0])
    light = 0.03 * e * rng.uniform(0.8, 1.2, 7)
    found = exposures(list(e), list(light))
    assert found == pytest.approx(e / 2)
    assert exposures(list(e), [0.1] * 7) is None  # evened out by the converter, or lit by a flash
    assert exposures([*e[:6], None], list(light)) is None
    assert exposures([1.0, 1.01, 1.0], [0.1, 0.2, 0.1]) is None
    assert exposures([], []) is None and exposures([1.0, 2.0], [0.0, 0.0]) is None


def test_pixels_of_held_out_photos_decide_nothing() -> None:
    e, fitted = [1.0, 2.0, 4.0, 2.0, 1.0, 64.0], [True] * 5 + [False]
    right = [0.01, 0.02, 0.04, 0.02, 0.01]
    assert exposures(e, [*right, 1e-6], fitted) == exposures(e, [*right, 1.0], fitted) == [0.5, 1, 2, 1, 0.5, 32]
    assert exposures(e, [*right, 1e-6]) is None  # if it were asked
    assert exposures(e, [0.02, 0.02, 0.02, 0.02, 0.02, 0.6], fitted) is None
    assert exposures([1.0, 1.0, 2.0], [0.1, 0.1, 0.2], [True, True, False]) is None  # nothing to tell it by
    assert exposures([1.0, 2.0], [0.1, 0.2], [False, False]) is None
    many = exposures([1.0, 2.0, 4.0, 64, 64, 64, 64], [0.1, 0.2, 0.4, 1, 1, 1, 1], [True] * 3 + [False] * 4)
    assert many == [0.5, 1, 2, 32, 32, 32, 32]  # the median is that of the fitted ones


def photos(folder: Path, believed: bool) -> None:
    for i, iso in enumerate((100, 200, 400, 200)):
        light = RADIANCE * (iso / 200 if believed else 1)
        image = np.round(srgb_from_linear(light.clip(0, 1)) * 255).astype(np.uint8)
        image[:4, : 5 * i] = 255
        block = place_block("<", iso=iso)
        (folder / f"{i}.jpg").write_bytes(exif_jpeg(block, image))


@pytest.mark.parametrize("believed", [True, False])
def test_exif_is_where_the_calibration_starts(tmp_path: Path, gather, believed: bool) -> None:
    photos(tmp_path, believed)
    found: Located[Capture] = gather(tmp_path)
    views = found.artifact.views
    assert [v.exposure for v in views] == ([0.5, 1, 2, 1] if believed else [1] * 4)
    assert any("exposures differ by a factor of 4" in w for w in found.artifact.warnings) == believed
    assert found.artifact.colours_drift  # its white balance was automatic
    assert views[0].clipped is None and views[3].clipped is not None
    ends = read_alpha(found.path(views[3].clipped))
    assert ends.shape == (160, 200) and ends[:3, :14].all() and not ends[8:].any()


def test_a_held_out_photo_alone_is_no_drift(tmp_path: Path, gather) -> None:
    """The white balance of these photos is automatic; that of the others is not said."""
    photos(tmp_path, True)
    for i in (1, 2, 3):
        image = np.round(srgb_from_linear(RADIANCE.clip(0, 1)) * 255).astype(np.uint8)
        (tmp_path / f"{i}.jpg").unlink()
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.roll(image, i, 1)[..., ::-1])
    assert gather(tmp_path).artifact.colours_drift
    assert not gather(tmp_path, holdout="names:0.jpg").artifact.colours_drift


def test_the_fit_starts_from_one_exposure_and_takes_clipped_pixels_as_limits(tmp_path: Path, gather) -> None:
    photos(tmp_path, True)
    found: Located[Capture] = gather(tmp_path)
    (tmp_path / "m").mkdir()
    camera = {"name": "", "width": 200, "height": 160, "K": ((300.0, 0, 100), (0, 300.0, 80), (0, 0, 1)),
              "world_from_cam": tuple(map(tuple, np.eye(4))), "distortion": (0.0,) * 5}  # fmt: skip
    poses = CameraSet(source="given", metric=True, capture_from_asset=(), roi_radius=1,
                      cameras=[{"index": i, **camera} for i in range(4)])  # fmt: skip
    alpha = np.zeros((160, 200), np.uint8)
    alpha[:100] = 255
    cv2.imwrite(str(tmp_path / "m" / "a.png"), alpha)
    ref = FileRef.of(tmp_path / "m", "a.png")
    masks = Located(
        MaskSet(masks=[ViewMask(index=i, mask=ref, source="", coverage=0.6) for i in range(4)]), tmp_path / "m"
    )
    views = read_views(found, poses, masks, [0, 1, 2, 3], 1024)
    levels = [float(v.rgb[20:].mean()) for v in views]
    assert levels == pytest.approx([levels[1]] * 4, rel=0.02)
    assert views[0].clipped is None and views[3].clipped is not None

    def limits(view: PhotoView, side: int) -> int:
        table = PixelTable([view], side, "cpu")
        return int((table.bound[table.inside] > 0).any(-1).sum())

    ends = int((views[3].clipped[:100] > 0).sum())
    assert ends >= 4 * 15 and limits(views[0], 200) == 0 and limits(views[3], 200) == ends
    assert limits(views[3], 50) == int((views[3].clipped[:100].reshape(25, 4, 50, 4).max((1, 3)) > 0).sum())
    sizes = {len(PixelTable([view], 50, "cpu").inside) for view in (views[0], views[3])}
    assert len(sizes) == 1  # no pixel is left out
