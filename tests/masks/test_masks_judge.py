"""What few photos of an arc leave unseen ends a run of a thing, but not of a head, which the template closes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts import Camera
from pipeline.hull import visual_hull
from pipeline.transforms import rows
from pipeline.verdict import Finding
from stages.masks.judge import hull_findings
from tests.masks.test_masks_stage import RADIUS, ROI, ball_alpha, camera
from tests.support.textured_ball import camera_on_orbit


def on_an_arc(count: int, half: float) -> list[Camera]:
    """Cameras within `half` degrees to the left and right of the front."""
    found = []
    for i, azimuth in enumerate(np.linspace(-half, half, count)):
        pose = camera_on_orbit(float(azimuth), 3.0 * (i % 2), 1.0, np.zeros(3))
        found.append(camera(i, count).model_copy(update={"world_from_cam": rows(pose)}))
    return found


def unseen(cameras: list[Camera], face: bool) -> Finding:
    hull = visual_hull(cameras, [ball_alpha(c) for c in cameras], [-2 * ROI] * 3, [2 * ROI] * 3, RADIUS / 10)
    return next(f for f in hull_findings(hull, cameras, ROI, False, face) if f.check == "hull_unseen")


@pytest.mark.parametrize(("face", "level"), [(True, "usable"), (False, "unusable")])
def test_an_arc_before_a_face_is_no_reason_to_stop(face: bool, level: str) -> None:
    found = unseen(on_an_arc(8, 10), face)
    assert found.value > 0.9 and found.level == level and found.remedy


@pytest.mark.parametrize("face", [True, False])
def test_all_around_is_good(face: bool) -> None:
    found = unseen([camera(i, 24) for i in range(24)], face)
    assert found.value < 0.15 and found.level == "good"
