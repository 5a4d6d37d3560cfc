"""Views of polarised pairs: the field is compared with the fitted photo, the asset with what it should show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.synthetic_results import write_results

from pipeline.artifacts import FileRef, Located
from pipeline.images import read_linear, write_exr
from stages.report.compare import judged_views
from stages.report.metrics import score


def test_the_asset_is_scored_against_the_photo_without_filters(tmp_path: Path) -> None:
    plain = write_results(tmp_path)
    capture, folder = plain.capture.artifact, plain.capture.folder
    views = []
    for view in capture.views:
        cross = read_linear(plain.capture.path(view.image))
        write_exr(folder / f"parallel/{view.index}.exr", (cross + 0.2) * 0.5)  # at half the exposure
        ref = FileRef.of(folder, f"parallel/{view.index}.exr")
        views.append(view.model_copy(update={"parallel": ref, "parallel_exposure": 0.5}))
    paired = replace(plain, capture=Located(capture.model_copy(update={"views": tuple(views)}), folder))
    both = list(zip(judged_views(plain), judged_views(paired), strict=True))
    assert both
    for without, with_pair in both:
        np.testing.assert_allclose(with_pair.photo, without.photo + 0.1, atol=2e-3)
        assert with_pair.model_scores == without.model_scores
        if with_pair.asset is not None:
            expected = score(with_pair.asset, without.photo + np.float32(0.1), without.mask)
            assert with_pair.asset_scores is not None and without.asset_scores is not None
            assert with_pair.asset_scores.psnr == pytest.approx(expected.psnr, abs=0.1)
            assert with_pair.asset_scores.psnr != pytest.approx(without.asset_scores.psnr, abs=0.1)
