"""What a model of the camera's vignetting or of its tone curve would explain in a run's held-out photos.

    python -m benchmarks.photometry RUN_DIR...

The fitted model's pictures of the held-out photos, each brought to its photo's own level, are multiplied by
exp(a r^2 + b r^4) (r: distance from the photo's centre over half of its diagonal; vignetting), by exp(a t + b t^2 +
c t^3) (t: logarithm of the predicted radiance over MIDDLE; a tone curve that sRGB does not undo), or by both. The
coefficients are fitted to all held-out photos but one, with Huber's weights, and scored on that one, in turn. Only
pixels well inside of the subject count, because at its outline other errors prevail.
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

F64 = npt.NDArray[np.float64]
INSIDE = 7  # pixels: side of the square that must be inside of the subject
DARK, BRIGHT = 0.003, 0.97  # linear; beyond it a photo tells noise or its limit
MIDDLE, HUBER = 0.22, 0.1
KINDS = {"vignetting": (2, 0), "tone curve": (0, 3), "both": (2, 3)}  # powers of r^2 and of t


@dataclass(frozen=True, slots=True)
class Pixels:
    """Pixels of one photo: photo, model (N, 3), linear, the model with the photo's own level; square (N,) r^2."""

    photo: F64
    model: F64
    square: F64

    def basis(self, kind: str) -> F64:
        """(N, K) what the coefficients of a kind multiply."""
        squares, tones = KINDS[kind]
        t = np.log(self.model.mean(1) / MIDDLE)
        columns = [self.square**k for k in range(1, squares + 1)] + [t**k for k in range(1, tones + 1)]
        return np.stack(columns, 1)

    def error(self, factor: F64) -> float:
        """Sum over the pixels of the mean squared error of sRGB, of the model times a factor (N,)."""
        model = levelled(self.photo, self.model * factor[:, None])
        off = [srgb_from_linear(np.clip(a, 0, 1)).astype(np.float64) for a in (self.photo, model)]
        return float(((off[0] - off[1]) ** 2).mean(1).sum())


def levelled(photo: F64, model: F64) -> F64:
    """The model's colours (N, 3) with the photo's level in each channel: by the median of the ratios."""
    return np.asarray(model * np.exp(np.median(np.log(photo / model), 0)), np.float64)


def fitted(some: list[Pixels], kind: str) -> F64:
    """The coefficients of a kind (K,) for several photos."""
    A, b = [], []
    for pixels in some:
        basis = pixels.basis(kind)
        ratio = np.log(pixels.photo.mean(1) / pixels.model.mean(1))
        ratio -= np.median(ratio)
        weight = np.sqrt(1 / np.maximum(1, np.abs(ratio) / HUBER))
        A.append((basis - basis.mean(0)) * weight[:, None])
        b.append(ratio * weight)
    return np.asarray(np.linalg.lstsq(np.concatenate(A), np.concatenate(b), rcond=None)[0], np.float64)


def explained(photos: list[Pixels]) -> dict[str, float]:
    """PSNR without a correction ("none") and with each kind, fitted to the other photos."""
    count = sum(len(p.square) for p in photos)
    error = {"none": sum(p.error(np.ones(len(p.square))) for p in photos)}
    for kind in KINDS:
        error[kind] = sum(
            p.error(np.exp(p.basis(kind) @ fitted(photos[:i] + photos[i + 1 :], kind))) for i, p in enumerate(photos)
        )
    return {kind: float(-10 * np.log10(max(e, 1e-300) / count)) for kind, e in error.items()}


def held_out(run: Path) -> list[Pixels]:
    """The held-out photos of a finished run whose store still has its photos, masks and fit."""
    found, _ = found_in(run, ("capture", "masks", "inverse_rendering"))
    capture, masks, fit = found["capture"], found["masks"], found["inverse_rendering"]
    views, of_view = {v.index: v for v in capture.artifact.views}, {m.index: m for m in masks.artifact.masks}
    out = []
    for picture in fit.artifact.held_out:
        model, _ = read_exr(fit.path(picture.exr))
        photo = read_linear(capture.path(views[picture.index].image))
        rows, columns = (n // picture.scale * picture.scale for n in photo.shape[:2])
        alpha = read_alpha(masks.path(of_view[picture.index].mask))
        photo, alpha = (shrink(a[:rows, :columns], picture.scale) for a in (photo, alpha))
        whole = cv2.erode((alpha > 0.99).astype(np.uint8), np.ones((INSIDE, INSIDE), np.uint8)) > 0
        rgb = model[..., :3]
        use = whole & (model[..., 3] > 0.99) & (photo.min(2) > DARK) & (photo.max(2) < BRIGHT) & (rgb.min(2) > DARK)
        if not use.any():
            continue
        h, w = alpha.shape
        y, x = np.mgrid[:h, :w] + 0.5
        square = ((x - w / 2) ** 2 + (y - h / 2) ** 2) / ((w / 2) ** 2 + (h / 2) ** 2)
        of_photo, of_model = photo[use].astype(np.float64), rgb[use].astype(np.float64)
        out.append(Pixels(of_photo, levelled(of_photo, of_model), square[use]))
    return out


def main() -> None:
    """Score the runs, print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    for run in parser.parse_args().runs:
        photos = held_out(run)
        if len(photos) < 2:
            raise SystemExit(f"{run}: fewer than two held-out photos; give --holdout to the run")
        print(f"{run.name}: " + ", ".join(f"{kind} {value:.2f} dB" for kind, value in explained(photos).items()))


if __name__ == "__main__":
    main()
