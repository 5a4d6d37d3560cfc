"""Masks of linear photos of floats, which have no white of their own: they do not depend on the unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import FileRef
from pipeline.colour import linear_from_srgb
from pipeline.images import read_encoded, write_exr
from stages.masks.photos import photos_of, white_of
from stages.masks.region import eight_bit
from tests.masks.test_masks_stage import Scene, ball_alpha, build, iou, run


def linear(scene: Scene, unit: float, plates: bool = False) -> Scene:
    """The same views as EXR in this unit."""
    for i, view in enumerate(scene.views):
        image = linear_from_srgb(read_encoded(scene.folder / f"{i}.png") / 255.0) * unit
        write_exr(scene.folder / f"{i}.exr", image.astype(np.float32))
        change = {"image": FileRef.of(scene.folder, f"{i}.exr")}
        if plates:
            write_exr(scene.folder / f"p{i}.exr", np.full(image.shape, 0.2 * unit, np.float32))
            change["plate"] = FileRef.of(scene.folder, f"p{i}.exr")
        scene.views[i] = view.model_copy(update=change)
    return scene


@pytest.mark.parametrize("plates", [False, True])
def test_masks_do_not_depend_on_the_unit(tmp_path: Path, plates: bool) -> None:
    background = float(0.2**0.4545) if plates else 0.0
    found = {}
    for unit in (1.0, 0.01, 30.0):
        scene = linear(build(tmp_path / f"c{unit}", 6, background), unit, plates)
        manifest, found[unit] = run(scene, tmp_path / f"s{unit}")
        assert {m.source for m in manifest.masks} == {"plate" if plates else "key"} and manifest.dropped == ()
        assert all(iou(a, ball_alpha(c)) > 0.98 for a, c in zip(found[unit], scene.cameras, strict=True))
    for unit in (0.01, 30.0):
        for a, b in zip(found[unit], found[1.0], strict=True):
            assert np.abs(a - b).max() < 0.02 and np.abs(a - b).mean() < 1e-4


def test_one_white_for_all_photos_decided_by_the_fitted_ones(tmp_path: Path) -> None:
    """A dark photo stays darker than the others, and the held-out one decides nothing."""
    scene = linear(build(tmp_path / "c", 4, 0.0), 1.0)
    for i, level in enumerate((1.0, 2.0, 500.0, 4.0)):
        write_exr(scene.folder / f"{i}.exr", np.full((128, 128, 3), level, np.float32))
        scene.views[i] = scene.views[i].model_copy(update={"image": FileRef.of(scene.folder, f"{i}.exr")})
    inputs = scene.inputs()
    assert white_of(inputs.capture, inputs.capture.artifact.views, lambda: None) == 2
    shown = [photo.read()[0, 0, 0] for photo, _ in photos_of(inputs.capture, inputs.poses.artifact)]
    assert shown == [188, 255, 255, 255]  # half of the white, encoded as sRGB


def test_photos_of_integers_keep_their_white(tmp_path: Path) -> None:
    scene = build(tmp_path / "c", 4, 0.5)
    inputs = scene.inputs()
    assert white_of(inputs.capture, inputs.capture.artifact.views, lambda: None) == 1
    for photo, camera in photos_of(inputs.capture, inputs.poses.artifact):
        np.testing.assert_array_equal(photo.read(), read_encoded(scene.folder / camera.name))
    for kind in (np.uint8, np.uint16):
        levels = np.arange(0, np.iinfo(kind).max, 7, dtype=kind).reshape(1, -1, 1)
        np.testing.assert_array_equal(eight_bit(levels, 0.3), eight_bit(levels))


def test_black_photos_have_no_white(tmp_path: Path) -> None:
    scene = linear(build(tmp_path / "c", 4, 0.0), 0.0)
    inputs = scene.inputs()
    assert white_of(inputs.capture, inputs.capture.artifact.views, lambda: None) == 1
