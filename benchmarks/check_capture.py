"""Cameras and masks of a capture against what is known of them, without the fit.

    python -m benchmarks.check_capture CAPTURE --store DIR [--params params.json | --projections FOLDER]
                                       [--masks FOLDER] [--set poses.method=colmap ...]

--params: FaceScape's file of the true cameras; views that it marks invalid are not compared. --projections: a text file
of a 3 x 4 matrix for each photo, `STEM_P.txt`; for photos scaled down since, --shrink 2. --masks: `INDEX.png` each.
Prints how many photos have a place; the distance of camera centres after the best similarity, in percent of the mean
distance of the cameras from where they look; the angles between the rotations after the best common turn; the IoU.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from pipeline.artifacts import CameraSet, Located, MaskSet
from pipeline.capture_artifacts import Capture
from pipeline.contract import execute
from pipeline.images import read_alpha
from pipeline.store import Store
from pipeline.transforms import F64, matrix, umeyama
from stages.capture.scan import scan_capture
from stages.capture.stage import STAGE as CAPTURE
from stages.capture.stage import Inputs as CaptureInputs
from stages.masks.stage import STAGE as MASKS
from stages.masks.stage import Inputs as MasksInputs
from stages.poses.stage import STAGE as POSES
from stages.poses.stage import Inputs as PosesInputs
from stages.presets import configs_for, parse_sets

Poses = dict[str, tuple[F64, F64]]  # by the photo's stem: centre (3,), world_from_cam rotation (3, 3)


def known_params(path: Path) -> Poses:
    """Of a FaceScape params.json."""
    params = json.loads(path.read_text())
    out = {}
    for key in (k for k in params if k.endswith("_Rt") and params.get(k[:-2] + "valid", True)):
        Rt = np.array(params[key])
        out[key[:-3]] = (-Rt[:, :3].T @ Rt[:, 3], Rt[:, :3].T)
    return out


def known_projections(folder: Path, shrink: float) -> Poses:
    """Of STEM_P.txt files with 12 numbers each, and a word before them in some sets."""
    out = {}
    for path in sorted(folder.glob("*_P.txt")):
        P = np.array([float(w) for w in path.read_text().split() if not w.isalpha()]).reshape(3, 4)
        P[:2] /= shrink
        K, R, centre = cv2.decomposeProjectionMatrix(P)[:3]
        R = np.diag(np.sign(np.diag(K))) @ R
        R = R if np.linalg.det(R) > 0 else -R
        out[path.name[: -len("_P.txt")]] = ((centre[:3] / centre[3]).ravel(), R.T)
    return out


def compare_cameras(found: CameraSet, known: Poses) -> str:
    """A line of figures."""
    cameras = [c for c in found.cameras if Path(c.name).stem in known]
    poses = np.stack([matrix(c.world_from_cam) for c in cameras])
    centres, turns = (np.stack([known[Path(c.name).stem][k] for c in cameras]) for k in range(2))
    moved = umeyama(poses[:, :3, 3], centres)
    off = np.linalg.norm(poses[:, :3, 3] @ moved[:3, :3].T + moved[:3, 3] - centres, axis=1)
    axes = turns[:, :, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, centres))
    off *= 100 / np.linalg.norm(centres - middle, axis=1).mean()
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", turns, poses[:, :3, :3]))
    common = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    cosine = (np.einsum("nij,nij->n", common @ poses[:, :3, :3], turns) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    worst = cameras[int(off.argmax())].name
    return (f"centres off by {off.mean():.3f} % in the mean, {off.max():.3f} % at worst ({worst}); "
            f"turned by {np.median(angle):.3f} degrees in the median, {angle.max():.3f} at worst")  # fmt: skip


def compare_masks(masks: Located[MaskSet], truth: Path) -> str:
    """A line of figures."""
    ious = {}
    for m in masks.artifact.masks:
        a, b = (read_alpha(p) >= 0.5 for p in (masks.path(m.mask), truth / f"{m.index}.png"))
        ious[m.index] = float((a & b).sum() / (a | b).sum())
    worst = min(ious, key=lambda i: ious[i])
    mean = float(np.mean(list(ious.values())))
    return f"IoU of {len(ious)} masks {mean:.4f} in the mean, {ious[worst]:.4f} at worst (view {worst})"


def main() -> None:
    """Run the three stages and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--params", type=Path)
    parser.add_argument("--projections", type=Path)
    parser.add_argument("--shrink", type=float, default=1.0)
    parser.add_argument("--masks", type=Path)
    parser.add_argument("--set", action="append", default=[], dest="sets")
    args = parser.parse_args()
    store, configs = Store(args.store), configs_for("draft", parse_sets(args.sets))
    capture: Located[Capture] = execute(
        CAPTURE, CaptureInputs(scan_capture(args.capture)), configs["capture"], store
    ).located
    poses: Located[CameraSet] = execute(POSES, PosesInputs(capture), configs["poses"], store).located
    found = poses.artifact
    print(f"{len(found.cameras)} of {len(capture.artifact.views)} photos have a place; without: {found.unregistered}")
    print(f"scale: {found.scale}; reprojection error: {found.reprojection_error_px} pixels; {found.warnings}")
    if args.params or args.projections:
        known = known_params(args.params) if args.params else known_projections(args.projections, args.shrink)
        print(compare_cameras(found, known))
    if args.masks:
        masks: Located[MaskSet] = execute(MASKS, MasksInputs(capture, poses), configs["masks"], store).located
        faces = sum("face" in m.labelled for m in masks.artifact.masks)
        print(f"{compare_masks(masks, args.masks)}; not fitted: {masks.artifact.dropped}; faces: {faces}")


if __name__ == "__main__":
    main()
