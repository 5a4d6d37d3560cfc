"""A mask gets the part that it lacks and the others need, before a hull contradicts the other masks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.needed_parts import needed_parts
from stages.masks import segment
from stages.masks.complete_mask import completed
from stages.masks.region import F32, U8
from stages.masks.sources import PhotoToMask
from tests.masks.test_masks_stage import SIZE, ball_alpha, build, iou, run
from tests.pipeline.test_needed_parts import ALPHAS, CAMERAS, EVERY, ROI, TORSO, lacking


# ------------------------------------------------------------------ colours
def photo(of_torso: tuple[int, int, int]) -> U8:
    """The first view's bust before a wall, with a torso of its own colour."""
    body = ALPHAS[0] > 0.5
    image = np.where(body[..., None], (200, 150, 120), (90, 110, 160)).astype(np.float64)
    image[body & TORSO] = of_torso
    return np.asarray((image + np.random.default_rng(3).normal(0, 2, image.shape)).clip(0, 255), np.uint8)


def test_a_part_is_completed_up_to_its_own_outline() -> None:
    masks = lacking(TORSO, 0)
    found = needed_parts(CAMERAS, masks, EVERY, ROI)
    assert found.hull is not None
    new = completed(photo((40, 120, 90)), masks[0] > 0.5, found.parts[0], found.hull, CAMERAS[0], 0)
    assert new is not None and iou(new.astype(np.float32), ALPHAS[0]) > 0.98


def test_a_part_of_the_walls_colour_is_not_guessed() -> None:
    """The torso looks like the wall, and the mask has its outline wrong: the colours do not show where it ends."""
    masks = lacking(TORSO, 0)
    found = needed_parts(CAMERAS, masks, EVERY, ROI)
    assert found.hull is not None
    assert completed(photo((90, 110, 160)), masks[0] > 0.5, found.parts[0], found.hull, CAMERAS[0], 0) is None


# ------------------------------------------------------------------ the stage
@pytest.mark.parametrize("shown", [True, False])
def test_masks_without_a_part_of_the_subject_do_not_cut_the_others(
    shown: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three of 24 masks lack a side of the ball. shown: whether their photos show where it ends; else the photos are
    black, and these masks stay as they are, but carve nothing."""
    scene = build(tmp_path / "capture", 24, 0.0)
    x = np.mgrid[:SIZE, :SIZE][1] - SIZE / 2
    bad = (4, 9, 15)
    if not shown:
        for i in bad:
            scene.repaint(i, np.zeros((SIZE, SIZE, 3), np.float32))

    def made(view: PhotoToMask, *_: Any) -> tuple[F32, str]:
        alpha = ball_alpha(scene.cameras[view.index])
        return np.where((x > 14) & (view.index in bad), np.float32(0), alpha), "grabcut"

    monkeypatch.setattr(segment, "mask", made)
    found, alphas = run(scene, tmp_path / "a", faces=False)
    for i, (m, alpha) in enumerate(zip(found.masks, alphas, strict=True)):
        if i not in bad:
            assert m.source == "grabcut" and iou(alpha, ball_alpha(scene.cameras[i])) > 0.99
        elif shown:
            assert m.source == "grabcut+hull" and iou(alpha, ball_alpha(scene.cameras[i])) > 0.95
    if not shown:
        assert set(found.dropped) <= set(bad)
