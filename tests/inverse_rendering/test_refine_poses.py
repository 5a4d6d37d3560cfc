"""Which cameras the fit moves, by how much, in which gauge; and how they reach the later stages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.artifacts import Camera, CameraSet, FittedFace, RefinedCamera
from pipeline.fitted_cameras import cameras_of
from pipeline.maths.rigid_motion import camera_of_moved, motion_between, motion_matrix
from pipeline.transforms import F64, rows
from stages.inverse_rendering import refine_poses
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.refine_poses import Evidence, PoseHistory, in_gauge, weighed
from stages.inverse_rendering.registration import NOTHING, Registered
from tests.support.balls import Ball
from tests.support.posed_head import pose_at

NOISE = np.random.default_rng(0)


def told(xi: F64, apart: float = 0.0, gain: float = 0.1) -> Registered:
    """A photo's motion in pixels along six axes, whose halves differ by noise."""
    off = apart * NOISE.standard_normal(6)
    return Registered(xi, np.stack([xi + off, xi - off]), np.eye(6), gain, 0.02)


def test_the_factor_is_the_posterior_mean_of_gaussian_motions() -> None:
    """Motions of variance 4 a component, seen with noise of variance 1: 4 / (4 + 1) of what is seen."""
    rng = np.random.default_rng(1)
    true = 2 * rng.standard_normal((4000, 6))
    halves = true[:, None] + np.sqrt(2) * rng.standard_normal((4000, 2, 6))
    found = [Registered(h.mean(0), h, np.eye(6), 0.1, 0.02) for h in halves]
    evidence = weighed(found, [1.0] * len(found), wanted=False)
    seen = halves.mean(1)
    best = float((seen * true).sum() / (seen * seen).sum())
    assert evidence.factor == pytest.approx(best, abs=0.01) == pytest.approx(0.8, abs=0.02)
    assert evidence.motion == pytest.approx(2 * np.sqrt(6), rel=0.05)
    assert evidence.noise == pytest.approx(np.sqrt(6), rel=0.05)


def test_noise_alone_moves_nothing() -> None:
    rng = np.random.default_rng(2)
    halves = rng.standard_normal((200, 2, 6))
    found = [Registered(h.mean(0), h, np.eye(6), 0.1, 0.02) for h in halves]
    assert weighed(found, [1.0] * 200, wanted=True).factor < 0.1


@pytest.mark.parametrize(("pixels", "share", "moves"), [(0.1, 1, False), (0.3, 1, True), (0.3, 0.2, False)])
def test_small_or_unconfirmed_motions_leave_the_cameras(pixels: float, share: float, moves: bool) -> None:
    found = [told(pixels * np.eye(6)[n % 6], gain=0.1 if n < share * 20 else 0.0) for n in range(20)]
    assert (weighed(found, [1.0] * 20, wanted=False).factor > 0) == moves
    assert weighed(found, [1.0] * 20, wanted=True).factor > 0.9


def test_one_photo_does_not_decide_for_the_others() -> None:
    found = [told(np.zeros(6)) for _ in range(19)] + [told(5 * np.eye(6)[0])]
    assert weighed(found, [1.0] * 20, wanted=True).motion < 0.1


def test_photos_without_evidence() -> None:
    assert weighed([], [], wanted=True) == Evidence(0.0, 0.0, 0.0, 0)
    assert weighed([NOTHING] * 9, [1.0] * 9, wanted=True).factor == 0
    assert weighed([told(np.ones(6))], [1.0], wanted=True).factor == 0, "one view"


# ------------------------------------------------------------------ gauge
FIRST = [pose_at(a) for a in np.linspace(0, 350, 12)]


def test_a_common_motion_and_scale_are_taken_back() -> None:
    common = motion_matrix(np.array([0.01, -0.02, 0.015, 0.003, 0.001, -0.002]))
    moved = [common @ p for p in FIRST]
    for p in moved:
        p[:3, 3] *= 1.02
    for a, b in zip(in_gauge(moved, FIRST), FIRST, strict=True):
        np.testing.assert_allclose(a, b, atol=3e-4)


def test_the_difference_between_cameras_stays() -> None:
    six = np.array([0.01, 0.0, -0.01, 0.001, 0.002, 0.0])
    moved = [camera_of_moved(p, six * (n == 3)) for n, p in enumerate(FIRST)]
    found = in_gauge(moved, FIRST)
    apart = motion_between(FIRST[3], found[3]) - motion_between(FIRST[4], found[4])
    np.testing.assert_allclose(apart, six, atol=2e-4)
    mean = np.mean([motion_between(a, b) for a, b in zip(FIRST, found, strict=True)], 0)
    np.testing.assert_allclose(mean[:3], 0, atol=1e-5)


# ------------------------------------------------------------------ views
VIEWS = Ball(views=6).photos()


def refined_with(monkeypatch: pytest.MonkeyPatch, found: list[Registered]) -> tuple[PoseHistory, list[PhotoView]]:
    history, given = PoseHistory.of(VIEWS), iter(found)
    monkeypatch.setattr(refine_poses, "pair_of", lambda *a: type("P", (), {"factor": 2}))
    monkeypatch.setattr(refine_poses, "response_of", lambda *a: np.eye(3))
    monkeypatch.setattr(refine_poses, "register", lambda pair: next(given))
    settings = type("S", (), {"image_side": 96, "samples": 6, "refine_poses": "auto"})
    return history, history.refine(None, VIEWS, settings, "cpu")  # type: ignore[arg-type]


def test_only_confirmed_photos_move(monkeypatch: pytest.MonkeyPatch) -> None:
    six = np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])
    signs = [1, -1, 1, -1, 0, 0]
    found = [told(s * 0.02 * six) if s else told(six, gain=0.0) for s in signs]
    found = [replace(r, G=1e4 * np.eye(6)) for r in found]
    monkeypatch.setattr(Registered, "pixels", lambda self, xi: 1.0)
    history, views = refined_with(monkeypatch, found)
    turned = [motion_between(a.world_from_cam, b.world_from_cam)[2] for a, b in zip(VIEWS, views, strict=True)]
    np.testing.assert_allclose(turned, 0.006 * np.array(signs) * history.evidence[0].factor, atol=1e-4)
    facts = history.facts(views, "auto")
    assert facts["refined"] and facts["confirmed"] == 4
    cameras = history.cameras(views, dict.fromkeys(range(6), 192))
    assert cameras[0].pixels == pytest.approx(2 * 2 * 1e2 * 0.006 * history.evidence[0].factor, rel=0.05)


def test_exact_cameras_stay_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    history, views = refined_with(monkeypatch, [told(1e-3 * np.ones(6)) for _ in VIEWS])
    assert all(np.array_equal(a.world_from_cam, b.world_from_cam) for a, b in zip(VIEWS, views, strict=True))
    assert history.cameras(views, {}) == ()
    assert history.facts(views, "auto")["refined"] is False


def test_a_checkpoint_keeps_poses_and_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    history, views = refined_with(monkeypatch, [told((-1) ** n * np.ones(6)) for n in range(6)])
    again = PoseHistory.of(VIEWS)
    back = again.restore(VIEWS, history.stored(views))
    assert all(np.array_equal(a.world_from_cam, b.world_from_cam) for a, b in zip(views, back, strict=True))
    assert again.evidence == history.evidence
    assert again.facts(back, "auto") == history.facts(views, "auto")


def test_later_stages_use_refined_cameras_of_fitted_photos_only() -> None:
    def camera(i: int) -> Camera:
        return Camera(
            index=i, name=f"{i}.jpg", width=4, height=4, K=rows(np.eye(3)), world_from_cam=rows(FIRST[i]),
            distortion=(0,) * 5,
        )  # fmt: skip

    poses = CameraSet(
        source="given", metric=True, capture_from_asset=rows(np.eye(4)), roi_radius=0.1,
        cameras=tuple(camera(i) for i in range(3)),
    )  # fmt: skip
    moved = RefinedCamera(index=1, world_from_cam=rows(FIRST[5]), pixels=1.0)
    found = cameras_of(poses, FittedFace.model_construct(refined=(moved,)))
    assert [c.world_from_cam for c in found.cameras] == [rows(FIRST[0]), rows(FIRST[5]), rows(FIRST[2])]
    assert found.cameras[1].name == "1.jpg"
    assert cameras_of(poses, FittedFace.model_construct(refined=())) is poses


@pytest.mark.parametrize("factor", [2, 4])
def test_motions_are_told_in_pixels_of_the_fits_photos(monkeypatch: pytest.MonkeyPatch, factor: int) -> None:
    """A photo is compared on blocks of `factor` of its pixels; here the fit's photos have the photos' own size."""
    six = np.array([0.0, 0.3, 0.0, 0.0, 0.4, 0.0])  # half a block
    history, given = PoseHistory.of(VIEWS), iter([told(six) for _ in VIEWS])
    monkeypatch.setattr(refine_poses, "pair_of", lambda *a: type("P", (), {"factor": factor}))
    monkeypatch.setattr(refine_poses, "response_of", lambda *a: np.eye(3))
    monkeypatch.setattr(refine_poses, "register", lambda pair: next(given))
    settings = type("S", (), {"image_side": max(VIEWS[0].size), "samples": 6, "refine_poses": "auto"})
    history.refine(None, VIEWS, settings, "cpu")  # type: ignore[arg-type]
    assert history.evidence[0].motion == pytest.approx(0.5 * factor)
