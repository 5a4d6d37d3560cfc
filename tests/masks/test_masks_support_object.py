"""Objects that no network knows: what the sparse points say, and the stage on a textured ball on a textured table."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import Camera, CameraSet, FileRef, Located
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.contract import execute
from pipeline.errors import StageError
from pipeline.images import read_alpha, write_png
from pipeline.store import Store
from pipeline.support import Support, find_support, is_level
from pipeline.transforms import F64, matrix, pixel_centres, rays, rows
from stages.masks import sources
from stages.masks.region import Disc
from stages.masks.sources import PhotoToMask
from stages.masks.stage import STAGE, Config, Inputs
from stages.masks.support_object import base_of, cut_by_points, distinct, find_supported_object, silhouette_of_points
from tests.support.textured_ball import camera_on_orbit

WIDTH, HEIGHT, RADIUS, ROI = 160, 120, 0.1, 0.16
TABLE = -0.08  # the table's height: the ball stands in it a little, as a bust does on its base
K = np.array([[180.0, 0, WIDTH / 2], [0, 180, HEIGHT / 2], [0, 0, 1]])


def cameras(count: int = 10) -> list[Camera]:
    poses = [camera_on_orbit(360 * i / count, 25 + 20 * (i % 2), 0.45, np.zeros(3)) for i in range(count)]
    return [Camera(index=i, name=f"{i}.png", width=WIDTH, height=HEIGHT, K=rows(K), world_from_cam=rows(p),
                   distortion=(0, 0, 0, 0, 0)) for i, p in enumerate(poses)]  # fmt: skip


def points(on_ball: int = 1500, on_table: int = 900, seed: int = 1) -> F64:
    random = np.random.default_rng(seed)
    ball = random.normal(size=(4 * on_ball, 3))
    ball *= RADIUS / np.linalg.norm(ball, axis=1, keepdims=True)
    ball = ball[ball[:, 1] > TABLE][:on_ball]
    table = random.uniform(-0.4, 0.4, (on_table, 3)) * (1, 0, 1) + (0, TABLE, 0)
    table = table[np.hypot(table[:, 0], table[:, 2]) > 0.08]
    stray = random.uniform(-0.3, 0.3, (20, 3))
    return np.concatenate([ball, table, stray]) + random.normal(scale=3e-4, size=(len(ball) + len(table) + 20, 3))


def view(camera: Camera, grey: bool) -> tuple[np.ndarray, np.ndarray]:
    """Picture (H, W, 3) and truth (H, W): a bumpy ball on a smooth table of nearly the same brightness."""
    origin, d = rays(matrix(camera.K), matrix(camera.world_from_cam), np.zeros(5), pixel_centres(WIDTH, HEIGHT))
    b = d @ origin
    inside = b * b - (origin @ origin - RADIUS**2)
    t = -b - np.sqrt(np.maximum(inside, 0))
    to_table = np.where(d[:, 1] < 0, (TABLE - origin[1]) / np.minimum(d[:, 1], -1e-9), np.inf)
    ball = (inside > 0) & (t < to_table)
    p = origin + np.where(ball, t, np.minimum(to_table, 5))[:, None] * d
    bumps = np.sin(p @ [210, 90, 40]) * np.sin(p @ [-60, 190, 80]) * np.sin(p @ [50, -40, 230])
    value = np.where(ball, 0.6 + 0.35 * bumps, 0.52 + 0.03 * np.sin(25 * p[:, 0]))
    colour = np.where(ball[:, None], [1, 0.9, 0.7], [0.7, 0.9, 1.0]) if not grey else 1.0
    return (value[:, None] * colour * np.ones(3)).reshape(HEIGHT, WIDTH, 3).clip(0, 1), ball.reshape(HEIGHT, WIDTH)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_the_table_is_found_and_the_ball_stands_on_it() -> None:
    found = find_supported_object(points(), cameras(), ROI, 0)
    assert found is not None and found.support is not None
    np.testing.assert_allclose(found.support.normal, [0, 1, 0], atol=0.02)
    assert found.support.offset == pytest.approx(TABLE, abs=0.002)
    assert np.abs(np.linalg.norm(found.points, axis=1) - RADIUS).max() < 0.02  # strays are gone


def test_a_ball_alone_has_no_support_and_few_points_no_object() -> None:
    centres = np.array([matrix(c.world_from_cam)[:3, 3] for c in cameras()])
    assert find_support(points(1500, 0), centres, ROI, 0) is None
    assert find_supported_object(points(60, 30), cameras(), ROI, 0) is None
    floating = find_supported_object(points(1500, 0), cameras(), ROI, 0)
    assert floating is not None and floating.support is None and len(floating.points) >= 1300


def test_a_ceiling_is_no_support() -> None:
    upside_down = points() * (1, -1, 1)
    centres = np.array([matrix(c.world_from_cam)[:3, 3] for c in cameras()])
    assert find_support(upside_down, centres, ROI, 0) is None


def test_a_wall_is_not_level() -> None:
    around = np.array([matrix(c.world_from_cam)[:3, 3] for c in cameras()])
    before_a_wall = np.array([camera_on_orbit(a, 5, 0.45, np.zeros(3))[:3, 3] for a in range(-70, 71, 20)])
    assert is_level(Support(np.array([0.0, 1, 0]), TABLE), around)
    assert not is_level(Support(np.array([0.0, 0, 1]), -0.2), before_a_wall)


def test_projected_points_fill_the_silhouette() -> None:
    found = find_supported_object(points(), cameras(), ROI, 0)
    assert found is not None
    for c in cameras():
        inside, gap = silhouette_of_points(c, found.points, ROI, HEIGHT, WIDTH)
        assert gap >= 1 and iou(inside, view(c, True)[1]) > 0.9


def test_a_smooth_base_without_points_is_of_the_object() -> None:
    """No points on the lowest 8 cm: what is below the lowest ones is asked of the photo, down to the table."""
    everything = points()
    bare = everything[(everything[:, 1] < TABLE + 0.01) | (everything[:, 1] > TABLE + 0.08)]
    found = find_supported_object(bare, cameras(), ROI, 0)
    assert found is not None and found.support is not None
    height = found.base @ found.support.normal - found.support.offset
    assert abs(height.min()) < 1e-9 and np.quantile(found.points[:, 1], 0.05) > TABLE + 0.06  # strays
    bottom, top = np.quantile(found.points @ found.support.normal - found.support.offset, [0.05, 1])
    assert height.max() <= bottom + 0.3 * (top - bottom) + 1e-9  # what is higher may hang over
    assert len(base_of(found.points, None)) == 0
    cut_off = replace(found, base=found.base[:0])
    cut = []
    for c in cameras()[::3]:
        picture, truth = view(c, True)
        image = np.round(picture * 255).astype(np.uint8)
        cut.append([iou(cut_by_points(image, c, x, WIDTH, 0), truth) for x in (found, cut_off)])
    whole, lower = np.array(cut).T
    assert whole.min() > 0.97 and (whole > lower).all() and lower.min() < 0.9


def test_grey_photos_get_their_texture_as_colours() -> None:
    grey, colour = (np.round(view(cameras()[0], g)[0] * 255).astype(np.uint8) for g in (True, False))
    assert distinct(colour) is colour and np.ptp(distinct(grey).astype(int), axis=2).max() > 20


@pytest.mark.slow
@pytest.mark.parametrize("grey", [True, False])
def test_the_stage_cuts_out_the_ball(tmp_path: Path, grey: bool) -> None:
    folder = tmp_path / "capture"
    folder.mkdir()
    np.savez(folder / "points.npz", points=points().astype(np.float32))
    views = []
    for c in cameras():
        write_png(folder / c.name, view(c, grey)[0])
        views.append(CaptureView(index=c.index, name=c.name, image=FileRef.of(folder, c.name), width=WIDTH,
                                 height=HEIGHT))  # fmt: skip
    poses = CameraSet(source="colmap", metric=False, capture_from_asset=rows(np.eye(4)), roi_radius=ROI,
                      cameras=tuple(cameras()), points=FileRef.of(folder, "points.npz"))  # fmt: skip
    inputs = Inputs(Located(Capture(kind="photos", views=tuple(views)), folder), Located(poses, folder))
    done = execute(STAGE, inputs, Config(hull_cells=48), Store(tmp_path / "s")).located
    assert {m.source.split("+")[0] for m in done.artifact.masks} == {"object"} and done.artifact.dropped == ()
    ious = [iou(read_alpha(done.path(m.mask)) >= 0.5, view(c, grey)[1])
            for m, c in zip(done.artifact.masks, cameras(), strict=True)]  # fmt: skip
    assert np.mean(ious) > 0.95 and min(ious) > 0.9
    bare = poses.model_copy(update={"points": None})
    with pytest.raises(StageError, match="no object is found"):
        execute(STAGE, Inputs(inputs.capture, Located(bare, folder)), Config(method="object"), Store(tmp_path / "s"))


@pytest.mark.parametrize(
    ("sides", "points_at_hand", "wanted"),
    [
        ([0.95] * 12, True, "person"),  # a person
        ([0.95] * 11 + [0.3], True, "person"),  # one odd view
        ([1.0] * 8 + [0.0] * 4, True, "object"),  # a statue: a person from most sides only
        ([1.0] * 8 + [0.0] * 4, False, "person"),  # nothing else to go by
        ([0.0] * 12, False, "grabcut"),
    ],
)
def test_a_statue_is_no_person(
    sides: list[float], points_at_hand: bool, wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = iter(sides)
    monkeypatch.setattr(sources, "_share_of_centre", lambda *_: next(said))
    monkeypatch.setattr(sources, "_agrees_better", lambda *_: False)
    noise = np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)  # no background of one colour
    camera = cameras(1)[0]
    views = [PhotoToMask(i, str(i), camera, Disc(16, 16, 8, 0.0), False, lambda: noise, None) for i in range(12)]
    solid = find_supported_object(points(), cameras(), ROI, 0) if points_at_hand else None
    assert solid is not None or not points_at_hand
    assert sources.plan(views, "auto", 0.5, 64, 0, 1.0, lambda: solid).method == wanted


@pytest.mark.parametrize(
    ("of_network", "wanted"),
    [
        ("whole", "person"),
        ("upper half", "object"),  # the carved hair of a statue, another part in each photo
    ],
)
def test_masks_that_contradict_each_other_are_no_person(
    of_network: str, wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The network is sure of a person in all photos; what it marks decides."""
    pictures = [np.round(view(c, False)[0] * 255).astype(np.uint8) for c in cameras()]
    truth = {p.tobytes(): view(c, False)[1] for c, p in zip(cameras(), pictures, strict=True)}

    def network(image: np.ndarray, *_: object) -> np.ndarray:
        inside = truth[image.tobytes()].copy()
        rows = np.flatnonzero(inside.any(1))
        if of_network != "whole":
            inside[rows[0] + int(len(rows) * (0.35 + 0.3 * (image[0, 0, 0] % 2))) :] = False
        return inside

    monkeypatch.setattr(sources, "person_mask", network)
    monkeypatch.setattr(sources, "_share_of_centre", lambda *_: 1.0)
    solid = find_supported_object(points(), cameras(), ROI, 0)
    assert solid is not None
    views = [PhotoToMask(c.index, c.name, c, Disc(80, 60, 60, 0.0), False, partial(np.copy, p), None)
             for c, p in zip(cameras(), pictures, strict=True)]  # fmt: skip
    assert sources.plan(views, "auto", 0.5, 160, 0, 1.0, lambda: solid).method == wanted
