"""A run's asset under a light that it was never in, against pictures of a rendered person under that light.

    python -m benchmarks.relit_person OUT TRUTH [--save FOLDER]

TRUTH has relit/STEM.exr (linear, premultiplied), relit/light.exr, cameras.json and labels
(workflows/evaluation/rendered_person.py). The asset is placed in the head's frame by its cameras and the closest
points of the skin, as for the other figures, and the light is turned with it. PSNR of sRGB-encoded skin pixels: as it
is, after one gain for all pictures, and after a matrix of colours for each.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from benchmarks.compare_views import compare
from pipeline.camera import PinholeCamera
from pipeline.images import read_exr, write_png_from_linear
from pipeline.maths.latlong import latlong_directions
from pipeline.meshes import F32, F64
from pipeline.transforms import matrix, scale_of
from stages.usd.render.exported import load_exported
from stages.usd.render.render import Renderer
from stages.usd.render.standard_light import StandardLight
from workflows.bench.captures_figures import Run
from workflows.evaluation.rendered_person import SKIN, placed_on_skin, read_labels, true_cameras


def seen_from(camera: PinholeCamera, head_from_asset: F64) -> PinholeCamera:
    """The camera in the asset's frame."""
    pose = matrix(np.linalg.inv(head_from_asset)) @ camera.world_from_cam
    pose[:3, :3] *= scale_of(head_from_asset)  # a rotation again
    return PinholeCamera(camera.K, pose, camera.width, camera.height, camera.distortion)


def turned(light: F32, head_from_asset: F64) -> F32:
    """A lat-long picture (H, W, 3) in the head's frame, in the asset's."""
    height, width = light.shape[:2]
    d = latlong_directions(width, height) @ (head_from_asset[:3, :3] / scale_of(head_from_asset)).T
    column = (1 - np.arctan2(d[..., 0], d[..., 2]) / np.pi) * width / 2 - 0.5
    row = (0.5 - np.arcsin(d[..., 1].clip(-1, 1)) / np.pi) * height - 0.5
    wide = np.pad(light, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    at = (column + 1).astype(np.float32), row.astype(np.float32)
    return np.asarray(cv2.remap(wide, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def main() -> None:
    """See the module."""
    p = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    p.add_argument("out", type=Path)
    p.add_argument("truth", type=Path)
    p.add_argument("--save", type=Path, help="folder for pairs of pictures: relit, true")
    options = p.parse_args()
    run = Run(options.out, json.loads((options.out / "run.json").read_text()), {})
    cameras = true_cameras(options.truth)
    placed = placed_on_skin(run, options.truth, cameras)
    if placed is None:
        raise SystemExit(f"{options.out} has too few cameras in common with {options.truth}")
    at = placed.head_from_asset
    renderer = Renderer(load_exported(run.out / run.record["asset"]))
    light = turned(read_exr(options.truth / "relit/light.exr")[0][..., :3], at)
    lit = StandardLight(renderer, light, "light.exr")
    shown, wanted, scores = [], [], []
    for path in sorted((options.truth / "relit").glob("*.exr")):
        if path.stem not in cameras:
            continue
        true = read_exr(path)[0]
        height, width = true.shape[:2]
        picture = renderer.render(seen_from(cameras[path.stem], at).scaled(width), light=lit)
        labels = read_labels(options.truth / "labels" / f"{path.stem}.png")
        skin = cv2.resize((labels == SKIN).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        both = (skin > 0.99) & (picture[..., 3] > 0.99) & (true[..., 3] > 0.99)
        a, b = picture[..., :3], true[..., :3]
        scores.append(compare(a, b, both))
        shown.append(a[both])
        wanted.append(b[both])
        if options.save:
            options.save.mkdir(parents=True, exist_ok=True)
            write_png_from_linear(options.save / f"{path.stem}.png", np.concatenate([a, b], 1).astype(np.float32))
    every = compare(np.concatenate(shown)[None], np.concatenate(wanted)[None], np.ones((1, sum(map(len, shown)))))
    mean = {k: float(np.mean([s[k] for s in scores])) for k in scores[0]}
    print(
        f"{len(scores)} relit views, skin: mean {mean['raw']:.2f} dB; all pixels {every['raw']:.2f}, after one gain of "
        f"{every['exposure']:.3f} {every['gain']:.2f}, after a matrix for each view {mean['matrix']:.2f}"
    )


if __name__ == "__main__":
    main()
