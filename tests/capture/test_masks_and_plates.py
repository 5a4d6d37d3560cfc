"""Given masks and clean plates of photos, as other programs write them."""

from __future__ import annotations

from pathlib import Path

import cv2

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
