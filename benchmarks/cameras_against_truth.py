"""How far the solved cameras of a run are from the true ones of a rendered person.

    python -m benchmarks.cameras_against_truth RUN CAPTURE/truth/cameras.json

The two worlds are aligned by the similarity with the least sum of distances of the camera centres (Umeyama's, weighted
anew in 20 rounds), so that a wrong camera does not move the others. Prints how many photos have a camera, the median
and the largest error, and each photo that is more than FAR off.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from benchmarks.align_solved_cameras import solved_cameras
from pipeline.registration.procrustes import weighted
from pipeline.transforms import F64, apply, inverse_rigid, matrix, rescale_camera

ROUNDS = 20
FLOOR = 1e-3  # metres: nearer centres have the same weight
FAR = 0.03  # metres


def aligned(solved: F64, known: F64) -> F64:
    """Solved cameras (N, 4, 4) in the world of the known ones."""
    a, b, weights = solved[:, :3, 3], known[:, :3, 3], np.ones(len(solved))
    for _ in range(ROUNDS):
        similarity = weighted(a, b, weights, scaled=True)
        weights = 1 / np.maximum(np.linalg.norm(apply(similarity, a) - b, axis=1), FLOOR)
    return np.stack([rescale_camera(similarity, m) for m in solved])


def main() -> None:
    """Align and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("truth", type=Path)
    args = parser.parse_args()
    photos = {p["name"]: np.array(p["world_to_camera"], float) for p in json.loads(args.truth.read_text())["photos"]}
    found = solved_cameras(args.run)
    known = np.stack([inverse_rigid(photos[c.name]) for c in found.cameras])
    own = aligned(np.stack([matrix(c.world_from_cam) for c in found.cameras]), known)
    apart = np.linalg.norm(own[:, :3, 3] - known[:, :3, 3], axis=1)
    turn = np.einsum("nij,nij->n", own[:, :3, :3], known[:, :3, :3])
    degrees = np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1)))
    print(f"{len(own)} of {len(photos)} photos have a camera; centres: median {1e3 * np.median(apart):.1f} mm, largest "
          f"{1e3 * apart.max():.0f} mm; directions: {np.median(degrees):.2f}, {degrees.max():.1f} degrees")  # fmt: skip
    for camera, distance, angle in zip(found.cameras, apart, degrees, strict=True):
        if distance > FAR:
            print(f"  {camera.name}: {1e3 * distance:.0f} mm, {angle:.1f} degrees")


if __name__ == "__main__":
    main()
