"""Copies of a small demo capture, ruined in one way each: what the judges of the early stages must find.

A capture is a folder in FaceScape's format; `params.json` holds `{i}_K`, `{i}_Rt` and so on for photo `{i}.png`.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts import CameraSet, Located, MaskSet
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context
from pipeline.verdict import Finding
from stages.capture import stage as capture_stage
from stages.capture.scan import scan_capture
from stages.masks import stage as masks_stage
from stages.poses import stage as poses_stage

U8 = npt.NDArray[np.uint8]
VIEWS, SIZE = 20, 128
STAGES = ("capture", "poses", "masks")


@dataclass
class Early:
    """What the stages before the fit made of a folder."""

    findings: dict[str, Finding]
    made: dict[str, object] = field(default_factory=dict)


def run_early(folder: Path, work: Path, until: str = "masks", **settings: dict[str, object]) -> Early:
    """capture, poses and masks without a store. settings: of a stage, by its name."""
    places = {s: work / s for s in STAGES}
    for place in places.values():
        place.mkdir(parents=True)

    def context(name: str) -> Context:
        scratch = work / f"{name}.scratch"
        scratch.mkdir()
        return Context(places[name], scratch)

    out = Early({})

    def add(name: str, artifact: Capture | CameraSet | MaskSet) -> None:
        out.made[name] = artifact
        out.findings |= {f.check: f for f in artifact.findings}

    found = capture_stage.run(capture_stage.Inputs(scan_capture(folder)),
                              capture_stage.Config(**settings.get("capture", {})), context("capture"))  # fmt: skip
    add("capture", found)
    if until == "capture":
        return out
    capture = Located(found, places["capture"])
    cameras = poses_stage.run(poses_stage.Inputs(capture), poses_stage.Config(**settings.get("poses", {})),
                              context("poses"))  # fmt: skip
    add("poses", cameras)
    if until == "poses":
        return out
    inputs = masks_stage.Inputs(capture, Located(cameras, places["poses"]))
    add("masks", masks_stage.run(inputs, masks_stage.Config(**settings.get("masks", {})), context("masks")))
    return out


# ------------------------------------------------------------------ ways to ruin a capture
def copied(source: Path, folder: Path) -> Path:
    """A copy without the truth, which no stage may see."""
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("truth", "demo.json"))
    return folder


def photos(folder: Path) -> list[int]:
    """Numbers of the photos."""
    return sorted(int(p.stem) for p in folder.glob("*.png"))


def repaint(folder: Path, change: Callable[[U8], U8], which: Iterable[int] | None = None) -> None:
    """Write photos anew. change: (H, W, 3) 8 bit to the same."""
    for i in photos(folder) if which is None else which:
        path = str(folder / f"{i}.png")
        cv2.imwrite(path, change(np.asarray(cv2.imread(path), np.uint8)))


def blurred(sigma: float) -> Callable[[U8], U8]:
    """A photo out of focus."""
    return lambda image: np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)


def brighter(factor: float) -> Callable[[U8], U8]:
    """A photo whose stored values are so many times as large."""
    return lambda image: np.asarray((image.astype(np.float32) * factor).clip(0, 255), np.uint8)


def params(folder: Path, change: Callable[[dict[str, object], int], None] | None = None) -> dict[str, object]:
    """The cameras, changed view by view and written back."""
    path = folder / "params.json"
    content: dict[str, object] = json.loads(path.read_text())
    if change is not None:
        for i in photos(folder):
            change(content, i)
        path.write_text(json.dumps(content))
    return content


def centre_of(content: dict[str, object], i: int) -> npt.NDArray[np.float64]:
    """(3,) where a camera stands."""
    m = np.array(content[f"{i}_Rt"], np.float64)
    return np.asarray(-m[:, :3].T @ m[:, 3], np.float64)


def azimuth(content: dict[str, object], i: int) -> float:
    """Degrees around +Y from the face."""
    c = centre_of(content, i)
    return float(np.degrees(np.arctan2(c[0], c[2])))


def keep(folder: Path, which: Iterable[int]) -> None:
    """Take the other photos and their cameras out."""
    wanted = set(which)
    gone = [i for i in photos(folder) if i not in wanted]
    content = params(folder)
    for i in gone:
        (folder / f"{i}.png").unlink()
        for name in [k for k in content if k.startswith(f"{i}_")]:
            del content[name]
    (folder / "params.json").write_text(json.dumps(content))


def give_masks(source: Path, folder: Path, change: Callable[[U8, int], U8] = lambda alpha, _: alpha) -> None:
    """The demo's true masks beside the photos. change: (H, W) 8 bit and the photo's number, to a mask."""
    (folder / "masks").mkdir()
    for i in photos(folder):
        alpha = np.asarray(cv2.imread(str(source / "truth" / "alpha" / f"{i}.png"), cv2.IMREAD_GRAYSCALE), np.uint8)
        cv2.imwrite(str(folder / "masks" / f"{i}.png"), change(alpha, i))


def resize(folder: Path, edge: int) -> None:
    """Smaller photos, with their cameras."""
    scale = edge / SIZE
    repaint(folder, lambda image: np.asarray(cv2.resize(image, (edge, edge), interpolation=cv2.INTER_AREA), np.uint8))

    def change(content: dict[str, object], i: int) -> None:
        K = np.array(content[f"{i}_K"], np.float64)
        K[:2, 2] += 0.5
        K[:2] *= scale
        K[:2, 2] -= 0.5
        content |= {f"{i}_K": K.tolist(), f"{i}_width": edge, f"{i}_height": edge}

    params(folder, change)


def moved(image: U8, x: int, y: int) -> U8:
    """A photo or mask of a subject that stands elsewhere; black where nothing was."""
    shift = np.array([[1, 0, x], [0, 1, y]], np.float64)
    return np.asarray(cv2.warpAffine(image, shift, image.shape[1::-1]), np.uint8)


def near_each_other(folder: Path, degrees: float) -> None:
    """All cameras within so many degrees of the front."""
    content = params(folder)
    count = len(photos(folder))
    for n, i in enumerate(photos(folder)):
        a = np.radians(degrees) * (n / (count - 1) - 0.5)
        back = np.array([np.sin(a), 0.02 * (n % 2), np.cos(a)])
        back /= np.linalg.norm(back)
        right = np.cross([0.0, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        turn = np.stack([right, -np.cross(back, right), -back])
        content[f"{i}_Rt"] = np.concatenate([turn, -(turn @ back)[:, None]], 1).tolist()
    (folder / "params.json").write_text(json.dumps(content))
