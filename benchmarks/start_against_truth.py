"""How far the fit's start lies from the truth: the visual hull, moved by the sweep, fused depth maps, and both.

    python benchmarks/start_against_truth.py RUN_DIR TRUTH_MESH [--side 512] [--cells 288]

RUN_DIR is a finished run whose store still has its photos, cameras and masks; nothing is fitted. Distances run from the
start's surface to the nearest of many points of the mesh, in mm, for the head and for what lies below the chin.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import cKDTree

from pipeline.artifacts import Located
from pipeline.store import Store
from stages.inverse_rendering.initial_geometry import Start, hull_start
from stages.inverse_rendering.load_views import read_views
from stages.inverse_rendering.stereo import start_from_photos, surface_points
from stages.inverse_rendering.stereo_choice import stereo_start
from stages.registry import REGISTRY

CHIN, CHEST = -0.06, -0.17  # heights in the truth's world, m
SAMPLES = 400_000
FAR = 3.0  # mm
F64 = npt.NDArray[np.float64]


def found_in(run: Path, names: tuple[str, ...] = ("capture", "poses", "masks")) -> tuple[dict[str, Located[Any]], F64]:
    """Artifacts of some stages of the run, and its capture_from_asset."""
    record = json.loads((run / "run.json").read_text())
    store, by_name = Store(Path(record["store"])), {s.name: s for s in REGISTRY}
    loaded = {}
    for name in names:
        artifact = store.load(name, record["stages"][name]["key"], by_name[name].output)
        if artifact is None:
            raise SystemExit(f"{run}: its {name} are no longer in the store {store.root}; run it again")
        loaded[name] = artifact
    return loaded, np.array(record["capture_from_asset"], float).reshape(4, 4)


def told(start: Start, to_world: F64, truth: trimesh.Trimesh) -> str:
    """Distances in words."""
    on, face = trimesh.sample.sample_surface(truth, SAMPLES, seed=1)
    points, _ = surface_points(start.values, start.lo, start.cell)
    points = points @ to_world[:3, :3].T + to_world[:3, 3]
    apart, nearest = cKDTree(on).query(points)
    inward = 1000 * apart * np.sign(((points - on[nearest]) * truth.face_normals[face[nearest]]).sum(1)) < -FAR
    height = points[:, 1]
    out = []
    for name, where in (("head", height > CHIN), ("neck and chest", (height <= CHIN) & (height > CHEST))):
        mm = 1000 * apart[where]
        out.append(f"{name}: mean {mm.mean():.2f} mm, {(mm > FAR).mean():.2%} over {FAR:.0f} mm, "
                   f"{inward[where].mean():.2%} inwards")  # fmt: skip
    return "; ".join(out)


def main() -> None:
    """Build the starts and measure them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--side", type=int, default=512, help="longest side of the photos (%(default)s)")
    parser.add_argument("--cells", type=int, default=288, help="of the finest grid (%(default)s)")
    args = parser.parse_args()
    found, to_world = found_in(args.run)
    capture, poses, masks = found["capture"], found["poses"].artifact, found["masks"]
    out = {v.index for v in capture.artifact.views if v.holdout} | set(masks.artifact.dropped)
    cameras = [c for c in poses.cameras if c.index not in out]
    views = read_views(capture, poses, masks, [c.index for c in cameras], args.side)
    truth = trimesh.load(args.truth, process=False)
    hull = hull_start(cameras, [v.alpha for v in views], poses.roi_radius, args.cells, 2)
    print("hull        ", told(hull, to_world, truth))
    begun = time.perf_counter()
    moved = start_from_photos(hull, views, "cpu")
    print("sweep       ", told(moved, to_world, truth), f"({time.perf_counter() - begun:.0f} s)")
    begun = time.perf_counter()
    dense, _ = stereo_start(hull, views, "dense", "cpu")
    print("depth maps  ", told(dense, to_world, truth), f"({time.perf_counter() - begun:.0f} s)")
    begun = time.perf_counter()
    both, _ = stereo_start(hull, views, "auto", "cpu")
    print("both        ", told(both, to_world, truth), f"({time.perf_counter() - begun:.0f} s)")


if __name__ == "__main__":
    main()
