"""Where the error of a run's held-out photos is: beside the model, at its outline, or inside.

    python -m benchmarks.error_by_place RUN_DIR...

Of the fitted model's pictures, over the pixels that `psnr` of the run counts: the share of the pixels and of the
squared error (sRGB, all photos together) that is *missing* (the model covers less than half of the pixel), at the
*rim* (within RIM of the subject's size from the mask's outline), and *inside*; of the last also what is left after a
blur of BLUR of the subject's size (*broad*: light, level, large shapes). Missing pixels count as black.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.start_against_truth import found_in
from pipeline.colour import srgb_from_linear
from pipeline.images import read_alpha, read_exr, read_linear, shrink

F32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]
RIM, BLUR = 0.015, 0.03
PLACES = ("missing", "rim", "inside", "broad")


@dataclass(frozen=True, slots=True)
class Place:
    """pixels, error: shares of all pixels and of all squared error."""

    pixels: float
    error: float


def sums(model: F32, photo: F32, alpha: F32, counts: Bool) -> dict[str, tuple[float, float]]:
    """Number of pixels and sum of squared errors by place. model (H, W, 4), photo (H, W, 3) linear; alpha (H, W) of the
    mask; counts (H, W)."""
    off = np.asarray(_encoded(model[..., :3]) - _encoded(photo), np.float32)
    error, size = (off**2).mean(2), float(np.sqrt(counts.sum()))
    depth = np.asarray(cv2.distanceTransform((alpha > 0.5).astype(np.uint8), cv2.DIST_L2, 5))
    covered = counts & (model[..., 3] >= 0.5)
    inside = covered & (depth >= RIM * size)
    weight = inside.astype(np.float32)
    blurred = cv2.GaussianBlur(np.dstack([off * weight[..., None], weight]), (0, 0), max(BLUR * size, 0.1))
    broad = ((blurred[..., :3] / np.maximum(blurred[..., 3:], 1e-3)) ** 2).mean(2)
    places = (counts & ~covered, error), (covered & ~inside, error), (inside, error), (inside, broad)
    return {name: (float(w.sum()), float(e[w].sum())) for name, (w, e) in zip(PLACES, places, strict=True)}


def shares(found: list[dict[str, tuple[float, float]]]) -> dict[str, Place]:
    """Of several photos together."""
    total = {name: np.sum([f[name] for f in found], 0) for name in PLACES}
    whole = np.maximum(sum(total[name] for name in PLACES[:3]), 1e-30)
    return {name: Place(*(float(x) for x in total[name] / whole)) for name in PLACES}


def _encoded(linear: F32) -> F32:
    return np.asarray(srgb_from_linear(linear.clip(0, 1)), np.float32)


def of_run(run: Path) -> dict[str, Place]:
    """Of a finished run whose store still has its photos, masks and fit."""
    found, _ = found_in(run, ("capture", "masks", "inverse_rendering"))
    capture, masks, fit = found["capture"], found["masks"], found["inverse_rendering"]
    views, of_view = {v.index: v for v in capture.artifact.views}, {m.index: m for m in masks.artifact.masks}
    out = []
    for picture in fit.artifact.held_out:
        mask, s = of_view[picture.index], picture.scale
        photo = read_linear(capture.path(views[picture.index].image))
        rows, columns = (n // s * s for n in photo.shape[:2])
        photo, alpha = (shrink(a[:rows, :columns], s) for a in (photo, read_alpha(masks.path(mask.mask))))
        counts = alpha > 0.5
        if mask.asked is not None:
            counts &= shrink(read_alpha(masks.path(mask.asked))[:rows, :columns], s) > 0.99
        out.append(sums(read_exr(fit.path(picture.exr))[0], photo, alpha, counts))
    if not out:
        raise SystemExit(f"{run}: no held-out photos; give --holdout to the run")
    return shares(out)


def main() -> None:
    """Print a line for each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    for run in parser.parse_args().runs:
        told = (f"{name} {p.pixels:.1%} of the pixels, {p.error:.0%} of the error" for name, p in of_run(run).items())
        print(f"{run.name}: {'; '.join(told)}")


if __name__ == "__main__":
    main()
