"""Painted masks: a blemish vanishes in every function, and what is no mask is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.images import write_png
from stages.reflectance import stage
from stages.reflectance.build import _unmarked
from stages.reflectance.config import Config
from stages.reflectance.field import load
from stages.reflectance.layer import Layers
from stages.reflectance.paint import marked, read_masks, replaced
from stages.reflectance.split import Fitted
from tests.reflectance.test_field import ball, field_of  # noqa: F401  (a fixture)
from workflows.run.plan import make_plan
from workflows.run.request import RunRequest

SIDE = 128


def paint(folder: Path, side: int, low: float, high: float, name: str = "a.png") -> Path:
    """A mask of a square of the texture, from low to high along both sides."""
    y, x = (np.mgrid[0:side, 0:side] + 0.5) / side
    write_png(folder / name, ((x > low) & (x < high) & (y > low) & (y < high)).astype(np.float32)[..., None])
    return folder


@pytest.mark.parametrize("side", [SIDE, 512, 64, 100])
def test_a_mask_of_any_size_marks_the_same_place(tmp_path: Path, side: int) -> None:
    points = field_of(np.full(3, 0.5)).points
    found = marked(read_masks(paint(tmp_path, side, 0.25, 0.5)), points)
    row, column = (points.texel // SIDE + 0.5) / SIDE, (points.texel % SIDE + 0.5) / SIDE
    inside = (row > 0.25) & (row < 0.5) & (column > 0.25) & (column < 0.5)
    edge = (np.minimum(np.abs(row - 0.25), np.abs(row - 0.5)) < 1 / side) | (
        np.minimum(np.abs(column - 0.25), np.abs(column - 0.5)) < 1 / side
    )
    np.testing.assert_array_equal(found[~edge], inside[~edge])
    assert inside.sum() > 200


def test_masks_add_up_and_transparent_pixels_mark_nothing(tmp_path: Path) -> None:
    points = field_of(np.full(3, 0.5)).points
    paint(tmp_path, SIDE, 0.2, 0.3)
    image = np.ones((SIDE, SIDE, 4), np.float32)
    image[..., 3] = 0
    image[60:70, 60:70, 3] = 1
    write_png(tmp_path / "b.png", image)
    (tmp_path / "notes.txt").write_text("no mask")
    found = marked(read_masks(tmp_path), points)
    alone = marked(read_masks(paint(tmp_path / "c", SIDE, 0.2, 0.3)), points)
    row, column = points.texel // SIDE, points.texel % SIDE
    np.testing.assert_array_equal(found, alone | ((row >= 60) & (row < 70) & (column >= 60) & (column < 70)))


def test_a_made_up_blemish_vanishes_in_every_function() -> None:
    """Oracle: functions that are constant around the blemish are that constant in it."""
    points = field_of(np.full(3, 0.5)).points
    count, rng = len(points.texel), np.random.default_rng(0)
    near = points.position @ np.array([0.0, 0, 1]) / 0.1 > 0.9
    plain = {"albedo": 0.4, "lobes": 0.02, "rest": 0.01, "shadow": -0.25, "trust": 0.5}
    arrays: dict[str, Any] = {n: np.full((count, 3), v, np.float32) for n, v in plain.items()}
    for values in arrays.values():
        values[near] += rng.uniform(0.1, 0.3, (int(near.sum()), 3)).astype(np.float32)
    normal = points.normal.astype(np.float32)
    normal[near] = [1, 0, 0]
    parts = Fitted(
        normal=normal,
        error=np.zeros(count, np.float32),
        layers=Layers.empty(count),
        **{k: v.astype(np.float32) for k, v in arrays.items()},
    )
    found = _unmarked(parts, near, points)
    np.testing.assert_allclose(found.shadow, plain["shadow"], atol=2e-3)
    np.testing.assert_allclose(found.trust, plain["trust"], atol=2e-3)
    np.testing.assert_allclose(found.normal[near], points.normal[near], atol=1e-6)
    for name in ("albedo", "lobes", "rest"):
        filled = replaced(arrays[name], near, np.ones(count, bool), points.position)
        np.testing.assert_allclose(filled, plain[name], atol=1e-4)
        assert np.abs(arrays[name][near] - plain[name]).min() > 0.05
    assert _unmarked(parts, np.zeros(count, bool), points) is parts
    with pytest.raises(StageError, match="leave nothing"):
        replaced(arrays["albedo"], near, near, points.position)


def test_the_stage_replaces_what_is_painted(ball: stage.Inputs, tmp_path: Path) -> None:  # noqa: F811
    """Outside of the masks nothing changes; inside every map does, and follows its surroundings."""
    fields = []
    for name, folder in (("plain", ""), ("painted", str(tmp_path / "masks"))):
        work = tmp_path / name
        work.mkdir()
        stage.run(ball, Config(size=64, paint=folder), Context(work, work / "scratch"))
        fields.append(load(work / "reflectance"))
        place = int(fields[0].points.texel[(fields[0].points.normal @ [0.6, 0, 0.8]).argmax()])
        mask = np.zeros((64, 64, 1), np.float32)
        mask[place // 64 - 4 : place // 64 + 5, place % 64 - 4 : place % 64 + 5] = 1
        write_png(tmp_path / "masks" / "blemish.png", mask)
    plain, painted = fields
    marks = marked(read_masks(tmp_path / "masks"), plain.points) & plain.known
    assert 10 < marks.sum() < 0.1 * len(marks)
    for name in ("albedo", "lobes", "normal", "rest"):
        a, b = plain.arrays[name], painted.arrays[name]
        # the last bit of a half float: the rim is continued by the same system
        np.testing.assert_allclose(a[~marks & plain.known], b[~marks & plain.known], rtol=1e-3, atol=1e-6)
        assert (np.abs(a - b)[marks].max(1) > 1e-4).mean() > 0.5
    np.testing.assert_array_equal(plain.known, painted.known)  # it still throws shadows
    np.testing.assert_allclose(painted.normal[marks], plain.points.normal[marks], atol=2e-3)
    assert painted.albedo[marks].std(0).max() < plain.albedo[marks].std(0).max()  # the stripes are gone


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda f: None, "no such folder"),
        (lambda f: f.mkdir(), "no PNG file"),
        (lambda f: write_png(f / "a.png", np.ones((8, 12, 1), np.float32)), "12 x 8"),
        (lambda f: write_png(f / "a.png", np.zeros((8, 8, 1), np.float32)), "marks nothing"),
        (lambda f: (f.mkdir(), (f / "a.png").write_bytes(b"torn")), "a.png"),
    ],
)
def test_what_is_no_mask_is_named_before_anything_runs(tmp_path: Path, make: Any, told: str) -> None:
    (tmp_path / "photos").mkdir()
    make(tmp_path / "paint")
    request = RunRequest(capture=str(tmp_path / "photos"), out=str(tmp_path / "out"),
                         sets=(f"reflectance.paint={tmp_path / 'paint'}",))  # fmt: skip
    with pytest.raises(StageError, match=told):
        make_plan(request)
    assert not (tmp_path / "out").exists()


def test_the_masks_content_is_part_of_the_key_and_their_place_is_not(tmp_path: Path) -> None:
    first = Config(paint=str(paint(tmp_path / "a", 32, 0.2, 0.4))).model_dump()
    moved = Config(paint=str(paint(tmp_path / "b", 32, 0.2, 0.4))).model_dump()
    changed = Config(paint=str(paint(tmp_path / "a", 32, 0.2, 0.5))).model_dump()
    assert first == moved and first != changed and "paint" not in first
    assert Config().model_dump()["paint_digest"] == ""
