"""Given masks and clean plates of photos, as other programs write them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.images import read_alpha, write_exr
from tests.support.textured_ball import flat

SIZE = (96, 80)


def test_a_clean_plate_with_clipped_pixels_leaves_those_of_its_photo(tmp_path: Path, gather) -> None:
    folder = tmp_path / "c"
    (folder / "clean_plate").mkdir(parents=True)
    for i, name in enumerate(("a.png", "b.png", "c.png")):
        for at, rows in ((folder, 8), (folder / "clean_plate", 30)):
            picture = flat(SIZE, i)
            picture[:rows] = 255
            cv2.imwrite(str(at / name), picture)
    found = gather(folder)
    for view in found.artifact.views:
        ends = cv2.imread(str(found.path(view.clipped)), cv2.IMREAD_UNCHANGED)
        assert view.plate is not None and ends[:8].all() and not ends[8:].any()


def written(path: Path, *planes: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".exr":
        write_exr(path, np.stack(planes, -1).astype(np.float32) / 255)
    else:
        deep = path.suffix == ".tif"
        cv2.imwrite(str(path), np.dstack(planes).astype(np.uint16) * 257 if deep else np.dstack(planes))


@pytest.mark.parametrize("suffix", [".png", ".tif", ".exr"])
def test_the_mask_of_an_opaque_picture_is_its_grey(tmp_path: Path, gather, suffix: str) -> None:
    """Photo editors save black and white with an alpha that is 255 everywhere; others cut the subject out by alpha."""
    folder = tmp_path / "c"
    folder.mkdir()
    subject, opaque = np.zeros((80, 96), np.uint8), np.full((80, 96), 255, np.uint8)
    subject[20:60, 30:70] = 255
    colours = np.full((80, 96), 90, np.uint8)
    for i, name in enumerate(("a", "b", "c")):
        cv2.imwrite(str(folder / f"{name}.jpg"), flat(SIZE, i))
    written(folder / f"mask/a{suffix}", subject, subject, subject, opaque)
    written(folder / f"mask/b{suffix}", colours, colours, colours, subject)
    written(folder / f"mask/c{suffix}", subject, subject, subject)
    found = gather(folder)
    assert not found.artifact.warnings
    for view in found.artifact.views:
        np.testing.assert_array_equal(read_alpha(found.path(view.mask)), subject / np.float32(255))


@pytest.mark.parametrize(("grey", "alpha", "what"), [(0, 255, "empty"), (255, 255, "full"), (255, 0, "empty")])
def test_four_channels_that_show_nothing_are_no_mask(tmp_path: Path, gather, grey: int, alpha: int, what: str) -> None:
    folder = tmp_path / "c"
    folder.mkdir()
    for i, name in enumerate(("a", "b", "c")):
        cv2.imwrite(str(folder / f"{name}.jpg"), flat(SIZE, i))
    planes = [np.full((80, 96), v, np.uint8) for v in (grey, grey, grey, alpha)]
    written(folder / "mask/b.png", *planes)
    capture = gather(folder).artifact
    assert [v.mask for v in capture.views] == [None] * 3 and f"b.png is {what}" in capture.warnings[0]
