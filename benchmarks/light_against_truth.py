"""The captured light of a run on a rendered person, against the true one.

    python -m benchmarks.light_against_truth OUT TRUTH

TRUTH has light.exr (lat-long, in the head's frame) and what workflows/evaluation/rendered_person.py needs to place the
head. Printed for the dome of the fitted harmonics alone, and for asset/environment.exr: the gain that takes it to the
truth (photos have an exposure), and after it the errors of the irradiance, root mean square over all directions
relative to the truth's, and of the logarithm of the radiance, per 2.8 degrees.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.relit_person import turned
from pipeline.images import read_exr
from pipeline.lighting.dome import environment, light_from_environment, read_light
from pipeline.maths import sh
from pipeline.maths.latlong import latlong_directions, latlong_weights
from pipeline.meshes import F32, F64
from stages.usd.layout import LIGHT
from workflows.bench.captures_figures import read_run
from workflows.evaluation.rendered_person import placed_on_skin, true_cameras

WIDTH = 128
DARK = 0.02  # radiance that is added before the logarithm


def irradiance(picture: F32) -> F64:
    """(N, 3) over all directions of a small grid."""
    normals = torch.from_numpy(latlong_directions(WIDTH, WIDTH // 2).reshape(-1, 3))
    light = torch.from_numpy(light_from_environment(picture).astype(np.float64))
    return np.asarray(sh.irradiance(light, normals).numpy(), np.float64)


def small(picture: F32) -> F32:
    """(H, W, 3) at the size at which radiance is compared."""
    return np.asarray(cv2.resize(picture, (WIDTH, WIDTH // 2), interpolation=cv2.INTER_AREA), np.float32)


def errors(picture: F32, truth: F32) -> tuple[float, float, float]:
    """Gain, error of the irradiance and of the logarithm of the radiance. Both of the same size."""
    weights = np.broadcast_to(latlong_weights(WIDTH, WIDTH // 2), (WIDTH // 2, WIDTH)).reshape(-1, 1)
    found, wanted = irradiance(picture), irradiance(truth)
    gain = float((weights * found * wanted).sum() / (weights * found**2).sum())
    off = float(np.sqrt((weights * (gain * found - wanted) ** 2).sum() / (weights * wanted**2).sum()))
    a, b = (np.log(x.mean(-1).reshape(-1, 1) + DARK) for x in (gain * picture, truth))
    return gain, off, float(np.sqrt((weights * (a - b) ** 2).sum() / weights.sum()))


def main() -> None:
    """See the module."""
    p = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    p.add_argument("out", type=Path)
    p.add_argument("truth", type=Path)
    options = p.parse_args()
    run = read_run(options.out)
    placed = None if run is None else placed_on_skin(run, options.truth, true_cameras(options.truth))
    if run is None or placed is None:
        raise SystemExit(f"{options.out} has too few cameras in common with {options.truth}")
    truth = small(turned(read_exr(options.truth / "light.exr")[0][..., :3], placed.head_from_asset))
    asset = (options.out / str(run.record["asset"])).parent
    pictures = {
        "fitted harmonics": environment(read_light(asset / LIGHT), WIDTH),
        "environment.exr": small(read_exr(asset / "environment.exr")[0][..., :3]),
    }
    for name, picture in pictures.items():
        gain, off, radiance = errors(picture, truth)
        print(f"{name:18s} gain {gain:.3f}, irradiance {100 * off:.1f} %, logarithm of the radiance {radiance:.2f}")


if __name__ == "__main__":
    main()
