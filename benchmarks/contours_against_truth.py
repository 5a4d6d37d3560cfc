"""How far the contours of a run's masks lie from the true mesh's silhouettes, in pixels of the photos.

    python -m benchmarks.contours_against_truth RUN_DIR TRUTH_MESH [--views 0 10 22]

RUN_DIR is a finished run whose store still has its cameras and masks. Where the true silhouette runs alone, its normal
is followed REACH pixels to both sides: what the mask covers there beyond the silhouette, or less, is its distance.
Silhouettes are rays through the lens as it is, ACROSS x ACROSS a pixel at the contour.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import trimesh

from benchmarks.start_against_truth import found_in
from pipeline import transforms
from pipeline.artifacts import Camera
from pipeline.images import read_alpha

REACH = 14  # pixels
ACROSS = 3
F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]


def hits(camera: Camera, truth: trimesh.Trimesh, uv: F64) -> F32:
    """(N,) 1 where the ray through an image position (N, 2) meets the mesh, which is in the asset's space."""
    K, pose = transforms.matrix(camera.K), transforms.matrix(camera.world_from_cam)
    origin, d = transforms.rays(K, pose, np.array(camera.distortion), uv)
    return np.asarray(truth.ray.intersects_any(np.broadcast_to(origin, d.shape), d), np.float32)


def silhouette(camera: Camera, truth: trimesh.Trimesh) -> F32:
    """(H, W) share of each pixel that the mesh covers."""
    w, h = camera.width, camera.height
    cover = hits(camera, truth, transforms.pixel_centres(w, h, 1)).reshape(h, w)
    grown = cv2.dilate(cover, np.ones((3, 3))) - cv2.erode(cover, np.ones((3, 3)))
    rows, columns = np.nonzero(grown > 0)
    within = (np.arange(ACROSS) + 0.5) / ACROSS
    offsets = np.stack(np.meshgrid(within, within), -1).reshape(-1, 2)
    uv = (np.stack([columns, rows], 1)[:, None] + offsets).reshape(-1, 2).astype(np.float64)
    cover[rows, columns] = hits(camera, truth, uv).reshape(len(rows), -1).mean(1)
    return cover


def distances(alpha: F32, truth: F32) -> F32:
    """(N,) how far outside of the true contour a mask's lies, negative inside, along that contour."""
    smooth = cv2.GaussianBlur(truth, (0, 0), 1.5)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    edge = (cv2.dilate(truth, np.ones((3, 3))) >= 0.5) & (truth < 0.5)
    edge[:REACH] = edge[-REACH:] = edge[:, :REACH] = edge[:, -REACH:] = False
    y, x = np.nonzero(edge)
    n = -np.stack([gx[y, x], gy[y, x]], 1) / (np.hypot(gx[y, x], gy[y, x]) + 1e-9)[:, None]
    t = np.arange(-REACH, REACH + 0.1, 0.5)
    at = [np.asarray(c[:, None] + t * n[:, k, None], np.float32) for k, c in enumerate((x, y))]
    a, b = (cv2.remap(p, at[0], at[1], cv2.INTER_LINEAR) for p in (alpha, truth))
    alone = (b[:, :4] > 0.9).all(1) & (b[:, -4:] < 0.1).all(1)
    return np.asarray(((a - b).sum(1) * 0.5)[alone], np.float32)


def told(d: F32) -> str:
    """Distances in words."""
    shares = ", ".join(f"{(d < -k).mean():.1%} over {k:g} inside" for k in (0.5, 1, 2))
    return (f"median {np.median(d):+.2f}, mean of the amount {np.abs(d).mean():.2f}; {shares}, "
            f"{(d > 2).mean():.1%} over 2 outside")  # fmt: skip


def main() -> None:
    """Cast, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--views", type=int, nargs="*")
    args = parser.parse_args()
    found, to_world = found_in(args.run)
    truth = trimesh.load(args.truth, process=False)
    truth.apply_transform(np.linalg.inv(to_world))
    cameras = {c.index: c for c in found["poses"].artifact.cameras}
    masks = {m.index: m for m in found["masks"].artifact.masks}
    every = []
    for i in args.views or sorted(masks):
        alpha = read_alpha(found["masks"].path(masks[i].mask))
        every.append(distances(alpha, silhouette(cameras[i], truth)))
        if args.views:
            print(f"view {i}: {told(every[-1])}")
    print(f"{len(every)} masks, pixels: {told(np.concatenate(every))}")


if __name__ == "__main__":
    main()
