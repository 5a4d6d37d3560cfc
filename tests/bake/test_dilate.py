"""Empty texels repeat the nearest covered one."""

from __future__ import annotations

import numpy as np
import pytest

from stages.bake.dilate import nearest_rows


def test_nearest_texels_are_found_across_bands_and_holes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Band by band as over the whole picture; and where a band's surroundings are empty, further away."""
    rng = np.random.default_rng(2)
    covered = rng.random((96, 64)) < 0.02
    covered[40:70] = False
    rows, columns = np.nonzero(covered)
    for halo in (512, 4):
        monkeypatch.setattr("stages.bake.dilate.HALO", halo)
        for first in range(0, 96, 8):
            got = nearest_rows(covered, first, first + 8)
            for r, c in ((0, 0), (3, 31), (7, 63)):
                away = (rows - first - r) ** 2 + (columns - c) ** 2
                y, x = divmod(int(got[r, c]), 64)
                assert covered[y, x]
                if halo == 512:
                    assert (y - first - r) ** 2 + (x - c) ** 2 == away.min()
