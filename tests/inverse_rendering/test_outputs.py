"""What a held-out photo's camera does to colours is known from the fitted photos by the same kind of camera."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.artifacts import FileRef
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.colour import as_photographed
from stages.inverse_rendering.outputs import held_out_responses


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


def test_the_mean_of_its_own_kind() -> None:
    rng = np.random.default_rng(0)
    matrices = np.eye(3) + 0.1 * rng.normal(size=(4, 3, 3))
    found = held_out_responses(model(matrices), capture("ababac", held=(4, 5), exposure=2.0), fitted=(0, 1, 2, 3))
    assert np.asarray(found[4]) == pytest.approx(2 * (matrices[0] + matrices[2]) / 2)
    assert np.asarray(found[5]) == pytest.approx(2 * np.eye(3))  # no fitted photo by that camera


def test_nothing_where_cameras_agree() -> None:
    found = held_out_responses(model(np.full((3, 3, 3), 7.0), False), capture("aaaa", held=(1,)), fitted=(0, 2, 3))
    assert found == {1: ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}


def test_a_response_acts_on_colours_alone() -> None:
    """Against the product written out, pixel by pixel."""
    rng = np.random.default_rng(1)
    rgba, response = rng.random((2, 3, 4), np.float32), rng.random((3, 3))
    out = as_photographed(rgba, response.tolist())
    for y, x in np.ndindex(2, 3):
        for k in range(3):
            assert out[y, x, k] == pytest.approx(sum(response[k, j] * rgba[y, x, j] for j in range(3)), rel=1e-5)
    assert np.array_equal(out[..., 3], rgba[..., 3])
    assert not np.shares_memory(out, rgba)
