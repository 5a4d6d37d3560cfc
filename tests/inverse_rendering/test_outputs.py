"""The outputs of a fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.colour import as_photographed
from pipeline.contract import Context
from pipeline.lighting.surroundings import Backdrop, Surroundings
from stages.inverse_rendering import outputs
from stages.inverse_rendering.ray_sampling import PhotoView


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


def test_surroundings_are_those_of_the_first_capture_in_its_own_colours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photos of the second capture have another light; the responses are those of each photo's place in the model."""
    rng, side = np.random.default_rng(0), 40
    matrices = rng.uniform(0.7, 1.4, (4, 3))[:, None] * np.eye(3)
    monkeypatch.setattr(outputs, "response_of", lambda model, number: matrices[number])
    views = []
    for n in range(4):
        rgb = (0.3 * matrices[n].diagonal() + rng.normal(0, 0.003, (side, side, 3))).astype(np.float32)
        alpha, pose = np.zeros((side, side), np.float32), np.eye(4)
        alpha[15:25, 15:25] = 1
        pose[:3, :3] = np.array([[np.cos(n), 0, np.sin(n)], [0, 1, 0], [-np.sin(n), 0, np.cos(n)]])
        K = np.array([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]])
        views.append(PhotoView(n, rgb * (2 if n == 1 else 1), alpha, K, pose, np.zeros(5), second=n == 1))
    found = outputs.write_surroundings(None, views, Context(tmp_path, tmp_path / "scratch"))  # type: ignore[arg-type]
    assert found is not None
    np.testing.assert_allclose(found.radiance[found.share > 0.99], 0.3, rtol=0.1)
    read = Surroundings.load(tmp_path / outputs.SURROUNDINGS)
    np.testing.assert_array_equal(read.radiance, found.radiance)
    blank = [replace(v, alpha=np.ones_like(v.alpha)) for v in views]
    elsewhere = Context(tmp_path / "none", tmp_path / "scratch")
    assert outputs.write_surroundings(None, blank, elsewhere) is None  # type: ignore[arg-type]
    assert not (tmp_path / "none" / outputs.SURROUNDINGS).exists()


@pytest.mark.parametrize(("count", "asked"), [(0, 0), (5, 5), (1000, outputs.SURROUNDED)])
def test_so_many_photos_are_asked_evenly(
    count: int, asked: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Backdrop] = []
    monkeypatch.setattr(outputs, "response_of", lambda model, number: np.full((3, 3), number))
    monkeypatch.setattr(outputs, "surroundings", seen.extend)
    one = PhotoView(0, np.zeros((2, 2, 3), np.float32), np.zeros((2, 2), np.float32), np.eye(3), np.eye(4), np.zeros(5))
    assert outputs.write_surroundings(None, [one] * count, Context(tmp_path, tmp_path)) is None  # type: ignore[arg-type]
    numbers = np.array([b.response[0, 0] for b in seen])
    assert len(numbers) == asked
    if count:
        assert numbers[0] < count / asked and numbers[-1] >= count - 1 - count / asked and np.ptp(np.diff(numbers)) <= 1
