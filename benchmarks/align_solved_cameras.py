"""Bring a run whose cameras were solved into the world of known cameras, so that it can be scored against a truth.

    python benchmarks/align_solved_cameras.py RUN_DIR PARAMS_JSON OUT_DIR

Solved cameras live in a world of their own. This finds the similarity that takes their centres to those in a
FaceScape `params.json` (Umeyama 1991), and writes OUT_DIR: links to RUN_DIR's asset and report beside a `run.json`
whose `capture_from_asset` leads into the known world. Prints how far the cameras are apart.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from pipeline import transforms
from pipeline.artifacts import CameraSet


def solved_cameras(run: Path) -> CameraSet:
    """The cameras of a finished run, from its store."""
    record = json.loads((run / "run.json").read_text())
    manifest = Path(record["store"]) / "poses" / record["stages"]["poses"]["key"] / "manifest.json"
    return CameraSet.model_validate_json(manifest.read_text())


def main() -> None:
    """Align, report, link."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("run", "params", "out"):
        parser.add_argument(name, type=Path)
    args = parser.parse_args()
    params = json.loads(args.params.read_text())
    solved, known = [], []
    for camera in solved_cameras(args.run).cameras:
        m = np.array(params[f"{camera.index}_Rt"], float)
        solved.append(transforms.matrix(camera.world_from_cam))
        known.append(transforms.inverse_rigid(transforms.rigid(m[:3, :3], m[:3, 3])))
    s, k = np.array(solved), np.array(known)
    known_from_asset = transforms.umeyama(s[:, :3, 3], k[:, :3, 3])
    moved = np.array([transforms.rescale_camera(known_from_asset, m) for m in s])
    apart = np.linalg.norm(moved[:, :3, 3] - k[:, :3, 3], axis=1) * 1e3
    turn = np.einsum("nij,nij->n", moved[:, :3, :3], k[:, :3, :3])
    degrees = np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1)))
    print(
        f"{len(s)} cameras: centres {np.median(apart):.2f} mm apart (worst {apart.max():.2f}), "
        f"directions {np.median(degrees):.3f} degrees (worst {degrees.max():.3f})"
    )
    args.out.mkdir(parents=True, exist_ok=True)
    for name in ("asset", "report"):
        link = args.out / name
        link.unlink(missing_ok=True)
        link.symlink_to((args.run / name).resolve())
    record = json.loads((args.run / "run.json").read_text())
    record["capture_from_asset"] = known_from_asset.tolist()
    (args.out / "run.json").write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
