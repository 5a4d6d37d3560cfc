"""What silhouettes show beyond the possible space: a head with a strand of hair beside it, in photos from the front."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from pipeline.fields.geometry import GridSdf
from pipeline.maths.tracing import box_interval
from stages.inverse_rendering import choose_start
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.dense_stereo import pixel_rays
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.keep_silhouettes import F32, F64, Bool, bound_with_silhouettes, start_with_silhouettes
from stages.inverse_rendering.keep_silhouettes import HAIR as DETAIL
from stages.inverse_rendering.ray_sampling import PhotoView

CELL, COUNT, SIDE = 0.01, 64, 120
LO = np.full(3, -0.31)
NODE = np.stack(np.meshgrid(*(LO[a] + CELL * np.arange(COUNT) for a in range(3)), indexing="ij"), -1)
FRONT = np.array([0.0, 0.0, 1.0])
STRAND = 0.2  # metres from the middle of the head


CENTRES = [np.array([x, 0.0, 1.0]) for x in (-0.1, 0.0, 0.1)]  # of the cameras


def visual_hull(middle: list[float], radius: float) -> F64:
    """What the photos leave of a ball: the cones of its silhouettes, here cut off in front and behind."""
    cones = [np.abs(NODE[..., 2]) - 0.25]
    for centre in CENTRES:
        away, axis = NODE - centre, np.array(middle) - centre
        far, length = np.linalg.norm(away, axis=-1), float(np.linalg.norm(axis))
        angle = np.arccos(np.clip(away @ axis / (far * length), -1, 1))
        cones.append(far * np.sin(angle - np.arcsin(radius / length)))
    return np.asarray(np.max(cones, axis=0))


HEAD, HAIR = visual_hull([0, 0, 0], 0.08), visual_hull([STRAND, 0, 0], 0.035)
BOUND = (np.linalg.norm(NODE, axis=-1) - 0.12).astype(np.float32)


def start(values: F64 | F32) -> Start:
    return Start(values.astype(np.float32), LO.astype(np.float32), CELL)


def met(surface: GridSdf, K: F64, pose: F64, side: int) -> Bool:
    """(side, side) pixels whose rays meet the surface."""
    rows, columns = (x.ravel() for x in np.mgrid[:side, :side])
    o, d, _ = pixel_rays(K, pose, rows, columns)
    return np.asarray(surface.trace(o, d, *box_interval(o, d, *surface.box()))[1]).reshape(side, side)


def views(hull: Start) -> list[PhotoView]:
    """Three photos, from the front and from 6 degrees to its sides, with the hull's silhouettes as masks."""
    out = []
    for centre in CENTRES:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.diag([1.0, -1.0, -1.0]), centre
        K = np.array([[150.0, 0, SIDE / 2], [0, 150.0, SIDE / 2], [0, 0, 1]])
        alpha = met(hull.surface("cpu"), K, pose, SIDE).astype(np.float32)
        out.append(PhotoView(0, np.zeros((SIDE, SIDE, 3), np.float32), alpha, K, pose, np.zeros(5)))
    return out


def kept(bound: F32) -> Bool:
    """Nodes of the hair that the bound leaves."""
    return np.asarray((bound < 0) & (HAIR < 0))


BOTH = start(np.minimum(HEAD, HAIR))
VIEWS = views(BOTH)


def test_a_strand_that_silhouettes_show_is_kept() -> None:
    assert not kept(BOUND).any()
    found = bound_with_silhouettes(BOTH, BOUND, FRONT, VIEWS)
    left = start(np.maximum(BOTH.values, found)).surface("cpu")
    before = start(np.maximum(BOTH.values, BOUND)).surface("cpu")
    for view in VIEWS:
        shown = met(left, view.K, view.world_from_cam, SIDE)
        inner = view.alpha > 0
        for _ in range(DETAIL.border + 1):
            inner[1:-1, 1:-1] &= inner[2:, 1:-1] & inner[:-2, 1:-1] & inner[1:-1, 2:] & inner[1:-1, :-2]
        assert shown[inner].mean() > 0.98
        assert met(before, view.K, view.world_from_cam, SIDE)[inner].mean() < 0.96


def test_it_is_kept_at_the_side_of_the_head_and_not_in_front_of_it() -> None:
    found = bound_with_silhouettes(BOTH, BOUND, FRONT, VIEWS)
    z = NODE[kept(found)][:, 2]
    assert -0.15 < z.mean() < -0.02 and z.max() < 0.1
    turned = NODE[kept(bound_with_silhouettes(BOTH, BOUND, -FRONT, VIEWS))][:, 2]
    assert turned.mean() > 0.02  # where the face looks decides, not the cameras
    face = (NODE[..., 2] > 0) & (np.abs(NODE[..., 0]) < 0.08)
    assert np.array_equal(found[face], BOUND[face])


@pytest.mark.parametrize("thick", [0.02, 0.05])
def test_what_is_kept_has_a_thickness(thick: float) -> None:
    """Along the rays, as far as S + u / 2 exceeds its least by no more than this."""
    thin, found = (kept(bound_with_silhouettes(BOTH, BOUND, FRONT, VIEWS, thick=t)) for t in (0.0, thick))
    assert (found | ~thin).all()
    assert np.ptp(NODE[found][:, 2]) > np.ptp(NODE[thin][:, 2]) + thick
    cost = BOUND + 0.5 * NODE[..., 2]
    assert cost[found].max() < cost[thin].max() + thick + 0.5 * CELL
    assert BOUND[found].max() < BOUND[thin].max() + CELL  # toward the head
    assert ndimage.label(found)[1] == 1  # no rags
    face = (NODE[..., 2] > 0) & (np.abs(NODE[..., 0]) < 0.08)
    assert np.array_equal(bound_with_silhouettes(BOTH, BOUND, FRONT, VIEWS, thick=thick)[face], BOUND[face])


def test_a_bound_that_empties_no_ray_stays() -> None:
    hull = start(HEAD)
    assert bound_with_silhouettes(hull, BOUND, FRONT, views(hull)) is BOUND
    assert bound_with_silhouettes(BOTH, BOUND, FRONT, []) is BOUND


@pytest.mark.parametrize("field", ["doubtful", "asked"])
def test_pixels_that_are_not_fitted_keep_nothing(field: str) -> None:
    # the columns of the strand in the middle photo
    beside = np.broadcast_to(np.arange(SIDE) >= SIDE / 2 + 18, (SIDE, SIDE))
    value = (~beside).astype(np.float32)
    one = replace(VIEWS[1], doubtful=beside) if field == "doubtful" else replace(VIEWS[1], asked=value)
    assert bound_with_silhouettes(BOTH, BOUND, FRONT, [one]) is BOUND
    assert bound_with_silhouettes(BOTH, BOUND, FRONT, [VIEWS[1]]) is not BOUND


def test_it_can_be_stopped() -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bound_with_silhouettes(BOTH, BOUND, FRONT, VIEWS, stop)


# ------------------------------------------------------------------ after stereo
NOSE = visual_hull([0.085, 0, 0], 0.02)  # beside the head, joined to it
POINTED = start(np.minimum(HEAD, NOSE))
SHORT = start((np.linalg.norm(NODE, axis=-1) - 0.078).astype(np.float32))  # depth maps that lost the nose


def test_a_start_fills_the_silhouettes_that_the_hull_fills() -> None:
    photos = views(POINTED)
    found = start_with_silhouettes(POINTED, SHORT, photos)
    beyond = (found.values < 0) & (POINTED.values > CELL)
    assert beyond.sum() == 0
    for view in photos:
        missing = [
            int(((view.alpha > 0) & ~met(s.surface("cpu"), view.K, view.world_from_cam, SIDE)).sum())
            for s in (SHORT, found)
        ]
        assert missing[0] > 30 and missing[1] < 0.25 * missing[0]


def test_what_is_kept_lies_nearest_to_the_start() -> None:
    """A hull is deep along the rays from the front; the nose is kept beside the head, not at the hull's ends."""
    found = start_with_silhouettes(POINTED, SHORT, views(POINTED))
    depth = NODE[(found.values < 0) & (NODE[..., 0] > 0.085)][:, 2]
    assert len(depth) > 5 and np.abs(depth).max() < 0.04
    assert np.abs(NODE[(POINTED.values < 0) & (NODE[..., 0] > 0.085)][:, 2]).max() > 0.2


def test_a_start_that_fills_all_silhouettes_stays_the_same_object() -> None:
    assert start_with_silhouettes(POINTED, POINTED, views(POINTED)) is POINTED
    assert start_with_silhouettes(POINTED, SHORT, []) is SHORT


def test_the_chosen_start_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choose_start, "stereo_start", lambda *_: (SHORT, {"start": "depth maps"}))
    photos = views(POINTED)
    found = choose_start.choose_start(POINTED, photos, None, Config(), "cpu")
    assert np.array_equal(found.start.values, start_with_silhouettes(POINTED, SHORT, photos).values)
    assert found.prior is POINTED and found.facts["stereo"] == {"start": "depth maps"}
