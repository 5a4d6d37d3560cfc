"""The masks stage from end to end on small synthetic captures: a lit ball before several kinds of background."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.artifacts import Camera, CameraSet, FileRef, Located, MaskSet
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.contract import execute
from pipeline.errors import Cancelled, StageError, UsageError
from pipeline.images import read_alpha, write_png
from pipeline.store import Store
from pipeline.transforms import matrix, pixel_centres, rays, rigid, rows
from stages.masks import segment
from stages.masks.sources import PhotoToMask
from stages.masks.stage import STAGE, Config, Inputs
from tests.masks.test_masks_user_model import write_red_detector

F32 = npt.NDArray[np.float32]
SIZE, RADIUS, ROI = 128, 0.1, 0.13


def camera(index: int, count: int) -> Camera:
    y = 1 - 2 * (index + 0.5) / count
    turn = (index + 0.5) * np.pi * (3 - np.sqrt(5))
    centre = np.array([np.sqrt(1 - y * y) * np.cos(turn), y, np.sqrt(1 - y * y) * np.sin(turn)])
    x = np.cross(-centre, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    world_from_cam = rigid(np.stack([x, np.cross(-centre, x), -centre], 1), centre)
    K = np.array([[380, 0, SIZE / 2], [0, 380, SIZE / 2], [0, 0, 1.0]])
    return Camera(index=index, name=f"{index}.png", width=SIZE, height=SIZE, K=rows(K),
                  world_from_cam=rows(world_from_cam), distortion=(0, 0, 0, 0, 0))  # fmt: skip


def ball_alpha(c: Camera, radius: float = RADIUS) -> F32:
    origin, d = rays(matrix(c.K), matrix(c.world_from_cam), np.zeros(5), pixel_centres(SIZE, SIZE))
    along = -(d @ origin)
    passed = np.sqrt(np.maximum(origin @ origin - along**2, 0))
    return np.asarray((0.5 + (radius - passed) * 380 / along).clip(0, 1).reshape(SIZE, SIZE), np.float32)


@dataclass
class Scene:
    """A capture under construction in a folder."""

    folder: Path
    cameras: list[Camera]
    views: list[CaptureView]

    def inputs(self) -> Inputs:
        capture = Capture(kind="photos", views=tuple(self.views))
        poses = CameraSet(source="given", metric=True, capture_from_asset=rows(np.eye(4)), roi_radius=ROI,
                          cameras=tuple(self.cameras))  # fmt: skip
        return Inputs(Located(capture, self.folder), Located(poses, self.folder))

    def give(self, index: int, alpha: F32) -> None:
        write_png(self.folder / f"m{index}.png", alpha)
        self.views[index] = self.views[index].model_copy(update={"mask": FileRef.of(self.folder, f"m{index}.png")})

    def repaint(self, index: int, image: F32) -> None:
        write_png(self.folder / f"{index}.png", image)
        self.views[index] = self.views[index].model_copy(update={"image": FileRef.of(self.folder, f"{index}.png")})


def paint(alpha: F32, background: F32 | float) -> F32:
    shade = np.array([0.75, 0.6, 0.5]) * np.linspace(0.8, 1.1, SIZE)[:, None, None]
    back = np.broadcast_to(np.asarray(background, np.float64), (SIZE, SIZE, 3))
    return np.asarray(alpha[..., None] * shade + (1 - alpha[..., None]) * back, np.float32)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Twelve views of a ball before black, the third held out."""
    return build(tmp_path / "capture", 12, 0.0)


def build(folder: Path, count: int, background: F32 | float) -> Scene:
    folder.mkdir()
    cameras = [camera(i, count) for i in range(count)]
    views = []
    for c in cameras:
        write_png(folder / c.name, paint(ball_alpha(c), background))
        views.append(CaptureView(index=c.index, name=c.name, image=FileRef.of(folder, c.name), width=SIZE,
                                 height=SIZE, holdout=c.index == 2))  # fmt: skip
    return Scene(folder, cameras, views)


def run(scene: Scene, store: Path, **settings: Any) -> tuple[MaskSet, list[F32]]:
    done = execute(STAGE, scene.inputs(), Config(hull_cells=32, **settings), Store(store))
    return done.located.artifact, [read_alpha(done.located.path(m.mask)) for m in done.located.artifact.masks]


def iou(a: F32, b: F32) -> float:
    return float(((a >= 0.5) & (b >= 0.5)).sum() / ((a >= 0.5) | (b >= 0.5)).sum())


def test_keyed_capture(scene: Scene, tmp_path: Path) -> None:
    found, alphas = run(scene, tmp_path / "s")
    assert [m.index for m in found.masks] == list(range(12)) and {m.source for m in found.masks} == {"key"}
    assert found.dropped == () and found.warnings == ()
    for m, alpha, c in zip(found.masks, alphas, scene.cameras, strict=True):
        truth = ball_alpha(c)
        assert alpha.shape == (SIZE, SIZE) and iou(alpha, truth) > 0.99
        assert m.coverage == pytest.approx(float(alpha.mean()), abs=2e-3)
        assert m.hull_iou is not None and m.hull_iou > 0.93
        assert m.mask.path == f"masks/{m.index}.png"
        assert ((alpha > 0.1) & (alpha < 0.9)).any()  # soft


def test_same_content_same_manifest(scene: Scene, tmp_path: Path) -> None:
    """And labels by name: to a network that calls hair what is red the whole ball is hair."""
    net = {"hair_model": str(write_red_detector(tmp_path / "net.onnx", 32)), "hair_model_side": 32}
    first, second = run(scene, tmp_path / "a", **net)[0], run(scene, tmp_path / "b", **net)[0]
    assert first == second and first.label_names == ("background", "subject", "face", "eyes", "hair")
    assert all("hair" in m.labelled and "eyes" not in m.labelled and m.labels is not None for m in first.masks)
    file = next((tmp_path / "a").rglob("labels/5.png"))
    codes = np.round(255 * read_alpha(file))
    assert set(np.unique(codes)) <= {0, 1, 4} and (codes == 4).mean() > 0.9 * first.masks[5].coverage


def test_given_masks_are_kept_exactly(scene: Scene, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    given = {}
    for i, c in enumerate(scene.cameras[:-1]):
        alpha = ball_alpha(c)
        edge = (alpha > 0) & (alpha < 1)
        alpha[edge] = rng.integers(1, 255, int(edge.sum())) / 255  # soft edges that no method would make up
        given[i] = (alpha * 255).round().astype(np.uint8)
        scene.give(i, alpha)
    found, alphas = run(scene, tmp_path / "s")
    assert [m.source for m in found.masks] == ["given"] * 11 + ["key"]
    for i, levels in given.items():
        assert ((alphas[i] * 255).round().astype(np.uint8) == levels).all()
    ignored, _ = run(scene, tmp_path / "s", method="key")
    assert {m.source for m in ignored.masks} == {"key"}


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_an_empty_and_a_full_given_mask_are_dropped_and_named(scene: Scene, tmp_path: Path, value: float) -> None:
    for i, c in enumerate(scene.cameras):
        scene.give(i, ball_alpha(c))
    scene.give(4, np.full((SIZE, SIZE), value, np.float32))
    found, _ = run(scene, tmp_path / "s")
    assert found.dropped == (4,) and any("view 4 (4.png)" in w for w in found.warnings)
    told = {f.check: f for f in found.findings}["masks_empty_or_full"]
    assert told.level == "usable" and told.views == ("4.png",)
    others = [m.hull_iou for m in found.masks if m.index != 4]
    assert min(v for v in others if v is not None) > 0.9  # it had no vote


def test_given_mask_of_another_size(scene: Scene, tmp_path: Path) -> None:
    scene.give(5, np.ones((SIZE, SIZE // 2), np.float32))
    with pytest.raises(StageError, match=r"does not have the photo's size[\s\S]*view 5[\s\S]*64 x 128"):
        run(scene, tmp_path / "s")


def test_given_but_missing(scene: Scene, tmp_path: Path) -> None:
    scene.give(0, ball_alpha(scene.cameras[0]))
    with pytest.raises(UsageError, match=r"without a mask[\s\S]*1\.png"):
        run(scene, tmp_path / "s", method="given")


def test_key_where_there_is_nothing_to_key(tmp_path: Path) -> None:
    ramp = np.linspace(0.1, 0.9, SIZE)[None, :, None].repeat(SIZE, 0).repeat(3, 2).astype(np.float32)
    with pytest.raises(StageError, match="not of one colour"):
        run(build(tmp_path / "capture", 6, ramp), tmp_path / "s", method="key")


@pytest.mark.parametrize("factor", [0.6, 1.25])
def test_outlier_among_given_masks_is_dropped(scene: Scene, tmp_path: Path, factor: float) -> None:
    for i, c in enumerate(scene.cameras):
        scene.give(i, ball_alpha(c, RADIUS * (factor if i == 7 else 1)))
    found, alphas = run(scene, tmp_path / "s")
    assert found.dropped == (7,)
    assert any("view 7 (7.png)" in w for w in found.warnings)
    assert found.masks[7].source == "given" and iou(alphas[7], ball_alpha(scene.cameras[7])) < 0.8  # left as it was
    others = [m.hull_iou for m in found.masks if m.index != 7]
    assert min(v for v in others if v is not None) > 0.9  # the wrong one did not spoil the hull


def test_held_out_view_never_votes(scene: Scene, tmp_path: Path) -> None:
    for i, c in enumerate(scene.cameras):
        scene.give(i, ball_alpha(c))
    before, _ = run(scene, tmp_path / "s")
    scene.give(2, ball_alpha(scene.cameras[2], 0.5 * RADIUS))
    after, _ = run(scene, tmp_path / "s")
    assert [m.hull_iou for m in after.masks if m.index != 2] == [m.hull_iou for m in before.masks if m.index != 2]
    assert after.dropped == () and "view 2 (2.png) is held out and its mask may be wrong" in after.warnings[0]


@pytest.mark.slow
def test_computed_outlier_is_mended(scene: Scene, tmp_path: Path) -> None:
    """Half of the ball in one photo is in black shadow: keying loses it, the other views know better."""
    c = scene.cameras[6]
    image = paint(ball_alpha(c), 0.0)
    image[:, : SIZE // 2] *= 0.02
    scene.repaint(6, image)
    lost, alphas = run(scene, tmp_path / "s", resegment=False)
    assert lost.dropped == (6,) and iou(alphas[6], ball_alpha(c)) < 0.7
    mended, alphas = run(scene, tmp_path / "s")
    assert mended.dropped == () and mended.masks[6].source == "key+hull"
    assert iou(alphas[6], ball_alpha(c)) > 0.85


@pytest.mark.parametrize(("wrong", "mended"), [(2, True), (5, False)])
def test_nothing_is_mended_by_a_hull_that_most_masks_contradict(
    wrong: int, mended: bool, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Masks of another half of the ball in each wrong view leave a hull that is no ball: no mask becomes worse by it.
    What a vote of the masks completes (stages.masks.complete_mask) comes before that hull."""

    def half(view: PhotoToMask, *_: object) -> tuple[F32, str]:
        alpha = ball_alpha(view.camera)
        if view.index >= 12 - wrong:
            alpha[(slice(None), slice(64, None)) if view.index % 2 else (slice(64, None),)] = 0
        return alpha, "person"

    monkeypatch.setattr(segment, "mask", half)
    found, alphas = run(scene, tmp_path / "s", faces=False)
    good = [iou(a, ball_alpha(c)) for a, c in zip(alphas, scene.cameras, strict=True)]
    assert min(good[: 12 - wrong]) > 0.99 and min(good) > (0.9 if mended else 0.49)
    assert mended or {f.level for f in found.findings if f.check == "mask_agreement"} == {"unusable"}


def test_view_that_shows_nothing_is_dropped(scene: Scene, tmp_path: Path) -> None:
    scene.repaint(8, np.zeros((SIZE, SIZE, 3), np.float32))
    found, _ = run(scene, tmp_path / "s")
    assert found.dropped == (8,)
    assert any("view 8 (8.png)" in w and "is empty" in w for w in found.warnings), found.warnings


def test_too_few_usable_views(scene: Scene, tmp_path: Path) -> None:
    for i in range(3, 12):
        scene.repaint(i, np.zeros((SIZE, SIZE, 3), np.float32))
    with pytest.raises(StageError, match="too few views have a mask"):
        run(scene, tmp_path / "s", method="key")


def test_object_before_clutter(tmp_path: Path) -> None:
    """Neither a person nor a uniform background: colour statistics around the region of interest."""
    clutter = np.random.default_rng(5).uniform(0, 1, (8, 8, 3)).repeat(16, 0).repeat(16, 1) * (0.2, 0.5, 0.9)
    scene = build(tmp_path / "capture", 9, clutter.astype(np.float32))
    found, alphas = run(scene, tmp_path / "s")
    assert {m.source.split("+")[0] for m in found.masks} == {"grabcut"}
    assert np.mean([iou(a, ball_alpha(c)) for a, c in zip(alphas, scene.cameras, strict=True)]) > 0.9


def test_cancelled(scene: Scene, tmp_path: Path) -> None:
    asked = iter([False, False, True])
    with pytest.raises(Cancelled):
        execute(
            STAGE, scene.inputs(), Config(hull_cells=32), Store(tmp_path / "s"), cancelled=lambda: next(asked, True)
        )


def test_a_held_out_mask_ends_where_the_hull_of_the_others_does(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A chair beside the ball in the held-out photo and in a fitted one; masks of half of the ball, which lack a part
    of the hull's core; and a small thing beside the ball that looks like it, which may be the subject's in a photo that
    carved nothing: it goes only if many photos contradict it."""
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    added = {"chair": (abs(x) < 45) & (y > 0), "thing": (abs(y) < 5) & (x > 0) & (x < 56), "half": np.zeros_like(x > 0)}

    def made(what: str) -> Any:
        def mask(view: PhotoToMask, *_: Any) -> tuple[F32, str]:
            alpha = ball_alpha(scene.cameras[view.index])
            if view.index in (2, 7):
                alpha = np.where(added[what], np.float32(1), alpha * ((x <= 0) | (what != "half")))
            return np.asarray(alpha, np.float32), "grabcut"

        return mask

    own = ball_alpha(scene.cameras[2])
    scene.repaint(2, paint(np.maximum(own, added["thing"]).astype(np.float32), 0.0))
    for what, enough, source in (
        ("chair", 0.12, "grabcut+hull"),
        ("half", 0.12, "grabcut+hull"),
        ("thing", 2.0, "grabcut"),
        ("thing", 0.12, "grabcut+hull"),
    ):
        monkeypatch.setattr(segment, "mask", made(what))
        monkeypatch.setattr(segment.beyond_hull, "many", lambda _, share=enough: share)
        found, alphas = run(scene, tmp_path / f"{what} {enough}", faces=False)
        assert found.masks[2].source == source and found.masks[7].source == "grabcut+hull"
        for i in (2, 7):
            assert iou(alphas[i], ball_alpha(scene.cameras[i])) > 0.9


def test_a_hole_in_one_mask_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A window through the subject that one photo has: too small for the rest of the check, yet a tunnel."""
    scene = build(tmp_path / "capture", 12, 0.0)
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    spot = np.hypot(x - 4, y + 3) < 2.5

    def made(view: PhotoToMask, *_: Any) -> tuple[F32, str]:
        alpha = ball_alpha(scene.cameras[view.index])
        return np.where(spot & (view.index == 5), np.float32(0), alpha), "grabcut"

    monkeypatch.setattr(segment, "mask", made)
    found, alphas = run(scene, tmp_path / "a")
    assert [m.index for m in found.masks if m.source == "grabcut+hull"] == [5] and (alphas[5][spot] > 0.5).all()
    monkeypatch.setattr(segment, "HOLE", 1.0)
    _, alphas = run(scene, tmp_path / "b")
    assert (alphas[5][spot] == 0).all()


def test_inverted_masks_are_turned_and_named(scene: Scene, tmp_path: Path) -> None:
    for c in scene.cameras:
        alpha = ball_alpha(c)
        scene.give(c.index, 1 - alpha if c.index in (4, 7) else alpha)
    found, alphas = run(scene, tmp_path / "s")
    assert [m.index for m in found.masks if m.source == "given, inverted"] == [4, 7] and found.dropped == ()
    assert all(iou(a, ball_alpha(c)) > 0.99 for a, c in zip(alphas, scene.cameras, strict=True))
    assert "(4.png)" in found.warnings[0] and "white on the subject" in found.warnings[0]


def test_clean_plates(tmp_path: Path) -> None:
    """A busy background that the subject's colours occur in, exposed a little differently, with noise."""
    random = np.random.default_rng(6)
    busy = np.kron(random.uniform(0.1, 0.95, (8, 8, 3)), np.ones((16, 16, 1))).astype(np.float32)
    scene = build(tmp_path / "capture", 12, busy)
    for c in scene.cameras:
        noise = random.normal(scale=0.012, size=(2, SIZE, SIZE, 3))
        scene.repaint(c.index, (paint(ball_alpha(c), busy) + noise[0]).clip(0, 1))
        write_png(scene.folder / f"p{c.index}.png", (1.06 * busy + noise[1]).clip(0, 1))
        plate = FileRef.of(scene.folder, f"p{c.index}.png")
        scene.views[c.index] = scene.views[c.index].model_copy(update={"plate": plate})
    found, alphas = run(scene, tmp_path / "s")
    assert {m.source.split("+")[0] for m in found.masks} == {"plate"} and found.dropped == ()
    assert min(iou(a, ball_alpha(c)) for a, c in zip(alphas, scene.cameras, strict=True)) > 0.93
    scene.views[4] = scene.views[4].model_copy(update={"plate": None})
    with pytest.raises(UsageError, match="without a clean plate"):
        run(scene, tmp_path / "s", method="plate")
