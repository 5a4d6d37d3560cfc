"""What a held-out photo's camera does to colours is known from the fitted photos by the same kind of camera."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.artifacts import Camera, CameraSet, FileRef
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.transforms import rows
from stages.inverse_rendering.held_out_colour import (
    LEAST,
    Interpolation,
    choose,
    held_out_colours,
    interpolate,
    places,
)


def capture(groups: str, held: tuple[int, ...], exposure: float = 1.0) -> Capture:
    """One photo a letter, which names its kind of camera."""
    ref = FileRef(path="a.png", sha256="0" * 64, size=1)
    views = (
        CaptureView(
            index=i,
            name=f"{i}.png",
            image=ref,
            width=8,
            height=8,
            camera_group=g,
            holdout=i in held,
            exposure=exposure if i in held else 1.0,
        )
        for i, g in enumerate(groups)
    )
    return Capture(kind="facescape", views=tuple(views))


def model(matrices: np.ndarray, calibrated: bool = True) -> Any:
    return SimpleNamespace(calibration=lambda: torch.from_numpy(matrices), spec=SimpleNamespace(calibrated=calibrated))


def cameras(angles: dict[int, float]) -> CameraSet:
    """Cameras on a circle, by their photo's index."""
    out = []
    for index, angle in angles.items():
        pose = np.eye(4)
        pose[:3, 3] = np.sin(angle), 0.0, np.cos(angle)
        out.append(
            Camera(
                index=index,
                name=f"{index}.png",
                width=8,
                height=8,
                K=rows(np.eye(3)),
                world_from_cam=rows(pose),
                distortion=(0.0,) * 5,
            )
        )
    return CameraSet(
        source="given", metric=True, capture_from_asset=rows(np.eye(4)), roi_radius=0.2, cameras=tuple(out)
    )


def circle(count: int) -> CameraSet:
    return cameras({i: 2 * np.pi * i / count for i in range(count)})


def test_the_mean_of_its_own_kind() -> None:
    rng = np.random.default_rng(0)
    matrices = np.eye(3) + 0.1 * rng.normal(size=(4, 3, 3))
    photos = capture("ababac", held=(4, 5), exposure=2.0)
    found = held_out_colours(model(matrices), photos, circle(6), fitted=(0, 1, 2, 3))
    assert np.asarray(found.responses[4]) == pytest.approx(2 * (matrices[0] + matrices[2]) / 2)
    assert np.asarray(found.responses[5]) == pytest.approx(2 * np.eye(3))  # no fitted photo by that camera
    assert found.facts["by"] == "mean"


def test_nothing_where_cameras_agree() -> None:
    found = held_out_colours(model(np.full((3, 3, 3), 7.0), False), capture("aaaa", held=(1,)), circle(4), (0, 2, 3))
    assert found.responses == {1: ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}
    assert found.facts == {}


def gains(angle: np.ndarray) -> np.ndarray:
    """A smooth response by direction."""
    return np.asarray(np.eye(3) * (1 + 0.4 * np.cos(angle))[:, None, None])


def test_an_exposure_that_follows_the_direction() -> None:
    """Photos in a random order, so that time tells nothing."""
    count, held = 24, (3, 11, 17)
    rng = np.random.default_rng(2)
    angle = rng.permutation(2 * np.pi * np.arange(count) / count)
    true = gains(angle)
    fitted = [i for i in range(count) if i not in held]
    found = held_out_colours(
        model(true[fitted]), capture("a" * count, held), cameras(dict(enumerate(angle.tolist()))), fitted
    )
    assert found.facts["by"] == "direction" and found.facts["photos"] == len(fitted)
    for i in held:
        assert np.asarray(found.responses[i]) == pytest.approx(true[i], abs=0.02)
        assert np.abs(true[fitted].mean(0) - true[i]).max() > 0.05


def test_clouds_that_follow_time() -> None:
    """Photos from directions in a random order."""
    count, held = 40, (5, 19, 33)
    rng = np.random.default_rng(3)
    true = gains(np.linspace(0, 2 * np.pi, count))
    angles = dict(enumerate(rng.uniform(0, 2 * np.pi, count).tolist()))
    fitted = [i for i in range(count) if i not in held]
    found = held_out_colours(model(true[fitted]), capture("a" * count, held), cameras(angles), fitted)
    assert found.facts["by"] == "time"
    for i in held:
        assert np.asarray(found.responses[i]) == pytest.approx(true[i], abs=0.02)


@pytest.mark.parametrize("seed", range(20))
def test_responses_without_order_keep_their_mean(seed: int) -> None:
    """Gains that are noise. The error rate over these seeds is 0."""
    rng = np.random.default_rng(seed)
    matrices = np.eye(3) * (1 + 0.1 * rng.normal(size=(30, 1, 1)))
    angle = 2 * np.pi * np.arange(30) / 30
    known = places(range(30), {i: np.array([np.sin(a), 0, np.cos(a)]) for i, a in enumerate(angle)}, range(30))
    assert choose(matrices, known).by == "mean"


def test_the_error_is_that_of_leaving_out_each_photo() -> None:
    """Against an interpolation without the photo, solved for each anew."""
    rng = np.random.default_rng(4)
    x = np.sort(rng.uniform(0, 1, (16, 1)), axis=0)
    matrices = np.eye(3) + 0.3 * np.sin(7 * x)[..., None] * rng.normal(size=(1, 3, 3))
    how = choose(matrices, {"time": x})
    assert how.by == "time"
    errors = []
    mean = matrices.mean(0)
    for i in range(len(x)):
        rest = np.arange(len(x)) != i
        k = np.exp(-((x[rest] - x[rest].T) ** 2) / (2 * how.length**2)) + how.noise * np.eye(rest.sum())
        near = np.exp(-((x[i] - x[rest, 0]) ** 2) / (2 * how.length**2))
        errors.append(mean + np.tensordot(near @ np.linalg.inv(k), matrices[rest] - mean, 1) - matrices[i])
    assert how.error == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=1e-9)
    of_mean = [np.delete(matrices, i, 0).mean(0) - matrices[i] for i in range(len(x))]
    assert how.of_mean == pytest.approx(np.sqrt(np.mean(np.square(of_mean))), rel=1e-9)


def test_far_from_all_photos_it_is_their_mean() -> None:
    matrices = gains(np.linspace(0, 1, LEAST))
    how = Interpolation("time", 0.1, 0.1, 0.0, 0.0)
    found = interpolate(how, matrices, {"time": np.linspace(0, 1, LEAST)[:, None]}, {"time": np.array([[1e9], [0.5]])})
    assert found[0] == pytest.approx(matrices.mean(0), rel=1e-12)
    assert np.isfinite(found).all()


def test_extremes() -> None:
    """Cameras in one place, a camera in the origin, one photo, responses that are all equal, and huge ones."""
    one = np.zeros((LEAST, 3))
    known = places(range(LEAST), dict(enumerate(one)), range(LEAST))
    assert np.array_equal(known["direction"], one)
    for matrices in (gains(np.linspace(0, 3, LEAST)), np.ones((LEAST, 3, 3)), 1e6 * gains(np.linspace(0, 3, LEAST))):
        how = choose(matrices, {"direction": known["direction"]})
        assert how.by == "mean"
        assert interpolate(how, matrices, known, known) == pytest.approx(
            np.broadcast_to(matrices.mean(0), (LEAST, 3, 3))
        )
    alone = held_out_colours(model(np.full((1, 3, 3), 2.0)), capture("aa", held=(1,)), circle(2), (0,))
    assert np.asarray(alone.responses[1]) == pytest.approx(np.full((3, 3), 2.0))
