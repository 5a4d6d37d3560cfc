"""One wrong mask, photo or camera among thirty: it is named, and costs next to nothing."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from pipeline.artifacts import CameraSet, FittedFace, MaskSet
from pipeline.capture_artifacts import Capture
from pipeline.demo.capture import write_demo_capture
from pipeline.images import read_exr, read_linear
from workflows.run.plan import make_plan
from workflows.run.request import RunRequest
from workflows.run.runner import run_stages

pytestmark = pytest.mark.slow

VIEWS, SIZE, WRONG = 30, 96, 9
TOLERANCE = 0.5  # dB
SMALL = (
    "inverse_rendering.steps=300",
    "inverse_rendering.batch=1024",
    "inverse_rendering.grid_cells=72",
    "inverse_rendering.levels=2",
    "inverse_rendering.hash_log2_size=14",
    "inverse_rendering.hash_fine=0.003",
)
U8 = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Fitted:
    """What a run says, and how well it shows the held-out views (dB over the true silhouettes)."""

    psnr: float
    views: tuple[int, ...]
    said: str


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Thirty small photos of the demo's head with given masks."""
    folder = tmp_path_factory.mktemp("thirty") / "capture"
    write_demo_capture(folder, views=VIEWS, size=SIZE, samples=8, mesh_step=0.003)
    (folder / "mask").mkdir()
    for i in range(VIEWS):
        shutil.copy(folder / "truth" / "alpha" / f"{i}.png", folder / "mask" / f"{i}.png")
    return folder


@pytest.fixture(scope="module")
def usual(intact: Path, tmp_path_factory: pytest.TempPathFactory) -> Fitted:
    return fit(intact, intact, tmp_path_factory.mktemp("usual"))


def fit(capture: Path, truth: Path, out: Path) -> Fitted:
    plan = make_plan(
        RunRequest(capture=str(capture), out=str(out), holdout="every:5:2", until="inverse_rendering", sets=SMALL)
    )
    done = {d.stage: d.located for d in run_stages(plan)}
    face, photos = done["inverse_rendering"], done["capture"].artifact
    assert isinstance(face.artifact, FittedFace) and isinstance(photos, Capture)
    assert isinstance(done["masks"].artifact, MaskSet) and isinstance(done["poses"].artifact, CameraSet)
    error, pixels = 0.0, 0
    for view in face.artifact.held_out:
        shown = encoded(read_exr(face.path(view.exr))[0][..., :3])
        photo = encoded(read_linear(truth / f"{view.index}.png"))
        inside = cv2.imread(str(truth / "truth" / "alpha" / f"{view.index}.png"), cv2.IMREAD_GRAYSCALE) > 127
        error += float(((shown - photo)[inside] ** 2).sum())
        pixels += 3 * int(inside.sum())
    said = "\n".join([*done["poses"].artifact.warnings, *done["masks"].artifact.warnings])
    return Fitted(-10 * float(np.log10(error / pixels)), face.artifact.fitted_views, said)


def encoded(linear: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    return np.asarray(np.clip(linear, 0, 1).astype(np.float64) ** (1 / 2.2))


def mask_of(folder: Path, change: Callable[[U8], U8]) -> None:
    path = folder / "mask" / f"{WRONG}.png"
    cv2.imwrite(str(path), change(np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)))


def empty(folder: Path) -> None:
    mask_of(folder, np.zeros_like)


def full(folder: Path) -> None:
    mask_of(folder, lambda m: np.full_like(m, 255))


def half(folder: Path) -> None:
    """Half of the subject is missing, as where a network takes a shirt for a chair."""

    def cut(m: U8) -> U8:
        out = m.copy()
        out[SIZE // 2 :] = 0
        return out

    mask_of(folder, cut)


def shifted(folder: Path) -> None:
    mask_of(folder, lambda m: np.roll(m, SIZE // 4, axis=1))


def another_person(folder: Path) -> None:
    """Somebody else's photo and mask under this view's name: smaller, elsewhere and in other colours."""
    for name in (f"{WRONG}.png", f"mask/{WRONG}.png"):
        picture = np.asarray(
            cv2.imread(str(folder / "20.png" if "/" not in name else folder / "mask/20.png")), np.uint8
        )
        small = cv2.resize(picture, (SIZE // 2, SIZE // 2), interpolation=cv2.INTER_AREA)
        out = np.zeros_like(picture)
        out[-SIZE // 2 :, : SIZE // 2] = small
        cv2.imwrite(str(folder / name), out if "/" in name else out[..., ::-1])


def camera(folder: Path) -> None:
    """The camera that belongs to another place of the ring."""
    params = json.loads((folder / "params.json").read_text())
    params[f"{WRONG}_Rt"] = params["25_Rt"]
    (folder / "params.json").write_text(json.dumps(params))


@pytest.mark.parametrize("spoil", [empty, full, half, shifted, another_person, camera], ids=lambda f: f.__name__)
def test_one_of_thirty(spoil: Callable[[Path], None], intact: Path, usual: Fitted, tmp_path: Path) -> None:
    ruined = tmp_path / "capture"
    shutil.copytree(intact, ruined)
    spoil(ruined)
    found = fit(ruined, intact, tmp_path / "out")
    assert usual.psnr - found.psnr < TOLERANCE, (usual.psnr, found.psnr)
    assert f"{WRONG}.png" in found.said, found.said
    assert set(found.views) >= set(usual.views) - {WRONG}
