"""Cameras and masks on the page: the drawing, the table worst first, the outlines."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.synthetic_results import SyntheticResults, write_results

from pipeline.artifacts import FileRef, FittedPhoto, Located
from pipeline.directions import count_seen
from stages.report.capture_figures import KINDS, _axes, camera_kinds, captured, outlined


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> SyntheticResults:
    return write_results(tmp_path_factory.mktemp("results"))


def changed(results: SyntheticResults, folder: Path) -> SyntheticResults:
    """With sparse points, errors, agreements, a lost photo and a dropped mask."""
    points = np.random.default_rng(0).normal(scale=0.05, size=(4000, 3)).astype(np.float32)
    np.savez(folder / "points.npz", points=points)
    poses = results.poses.artifact
    errors = {c.name: 0.1 * (c.index + 1) for c in poses.cameras}
    poses = poses.model_copy(update={"points": FileRef.of(folder, "points.npz"), "view_errors_px": errors,
                                     "unregistered": ("lost<1>.jpg", "soft.jpg"),
                                     "left_out": {"soft.jpg": "blurred: hardly any detail"}})  # fmt: skip
    masks = results.masks.artifact
    kept = tuple(m.model_copy(update={"hull_iou": 0.9 + 0.01 * m.index}) for m in masks.masks)
    masks = masks.model_copy(update={"masks": kept, "dropped": (kept[0].index,)})
    return replace(results, poses=Located(poses, folder), masks=Located(masks, results.masks.folder))


def test_drawing_table_and_outlines(results: SyntheticResults, tmp_path: Path) -> None:
    found = captured(changed(results, tmp_path), 180, 5)
    cameras = results.poses.artifact.cameras
    assert found.drawing.count("<title>") == 2 * len(cameras)  # from two sides
    assert found.drawing.count(KINDS["mask dropped"]) == 2 and "nan" not in found.drawing
    numbers = [float(n) for n in re.findall(r"[ML](-?[\d.]+) ", found.drawing)]
    assert min(numbers) >= 0 and max(numbers) <= 840
    errors = [row.error_px for row in found.rows]
    assert errors == sorted(errors, reverse=True) and len(errors) == len(cameras)
    worst = sorted(0.9 + 0.01 * c.index for c in cameras)[:5]
    assert [p.caption.split(",")[1] for p in found.outlines] == [f" {w:.3f}" for w in worst]
    assert "not fitted" in found.outlines[0].caption and found.more == len(cameras) - 5
    assert "lost<1>.jpg: no camera pose was found" in found.lost
    assert "soft.jpg: no camera pose was found; blurred: hardly any detail" in found.lost


def test_given_cameras_without_points_and_no_masks_shown(results: SyntheticResults) -> None:
    found = captured(results, 180, 0)
    assert "<svg" in found.drawing and found.outlines == [] and all(row.error_px is None for row in found.rows)


def test_spectator_sees_up_as_up() -> None:
    right, up = _axes(0.0, 0.0)
    np.testing.assert_allclose([right, up], [[1, 0, 0], [0, 1, 0]], atol=1e-12)
    right, up = _axes(0.0, 90.0)  # from above: the face, +Z, points down the page
    np.testing.assert_allclose([right, up], [[1, 0, 0], [0, 0, -1]], atol=1e-12)


def test_sphere_shows_what_no_photo_sees(results: SyntheticResults, tmp_path: Path) -> None:
    counts = count_seen(np.array([[0, 0, 1.0], [0.1, 0, 0.995], [-0.1, 0, 0.995]]))  # from the front alone
    poses = results.poses.artifact.model_copy(update={"seen_directions": counts})
    found = captured(replace(results, poses=Located(poses, tmp_path)), 180, 0)
    front, behind = ([p for p in re.findall(r'points="([\d.]+),[^"]*" fill="(#\w+)"', found.sphere)
                      if (float(p[0]) > 210) == side] for side in (False, True))  # fmt: skip
    assert len(front) == len(behind) == 144 and "nan" not in found.sphere
    nobody, few, many = (colour for _, colour in found.seen)
    assert {c for _, c in behind} == {nobody} and {c for _, c in front} == {nobody, few, many}
    assert "the back (0% seen)" in found.hidden and not any("front" in h for h in found.hidden)
    assert captured(results, 180, 0).sphere == "" or results.poses.artifact.seen_directions


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_outline_lies_on_the_mask(kind: type) -> None:
    alpha = np.zeros((80, 120), np.float32)
    alpha[20:60, 30:90] = 1
    top = np.iinfo(kind).max if np.issubdtype(kind, np.integer) else 1
    image = np.full((80, 120, 3), top // 2 if top > 1 else 0.2, kind)
    drawn = outlined(image, alpha, 120)
    red = (drawn[..., 0] > 200) & (drawn[..., 2] < 60)
    assert (
        drawn.shape == (80, 120, 3) and red[20, 30:90].all() and red[20:60, 30].all() and red.sum() == 2 * (40 + 60) - 4
    )
    assert outlined(image, alpha, 60).shape == (40, 60, 3)


def test_fitted_photos_have_their_error_and_weight_in_the_table(results: SyntheticResults) -> None:
    index = next(i for i, kind in camera_kinds(results).items() if kind == "fitted")
    photo = FittedPhoto(index=index, psnr=31.25, weight=0.625, low_share=0.125)
    rows = captured(results, 180, 0, [photo]).rows
    names = {c.index: c.name for c in results.poses.artifact.cameras}
    assert [row.name for row in rows if row.fit is photo] == [names[index]]
    assert all(row.fit is None for row in rows if row.name != names[index])
