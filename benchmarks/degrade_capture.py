"""The same photos by a worse camera: fewer pixels, noise, JPEG. Two captures become comparable that way.

    python benchmarks/degrade_capture.py CAPTURE OUT [--side 640] [--noise 0.0275] [--quality 95]
                                         [--background skin|white|colours|plain] [--every 1]

CAPTURE is a FaceScape folder (`params.json`, I.png or I.jpg), with its `truth/` if it has one. Photos and the truth's
alpha are averaged down by area in linear light; cameras follow (pixel centres at integers); noise is Gaussian in the
encoded values, the same for dark and bright, of one seed. A background that is black stays without noise. With
--background, photos before black get another one behind the truth's alpha: a skin-coloured wall, a white one, smooth
colours at random in many sizes, or a plain one, all of it in the middle colour of the first photo's subject, as before
a backdrop that a highlight or cloth resembles.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline import transforms
from pipeline.colour import srgb_from_linear
from pipeline.images import read_alpha, read_linear, write_png

BLACK = 0.02  # encoded: below it lies the background
INSIDE = 0.95  # alpha of the subject alone
Params = dict[str, Any]


def smaller(params: Params, side: int) -> Params:
    """Cameras for photos whose longest side is `side`; other entries as they are."""
    out = dict(params)
    for key in (k for k in params if k.endswith("_K")):
        index = key.removesuffix("_K")
        size = [int(params[f"{index}_{edge}"]) for edge in ("width", "height")]
        factor = side / max(size)
        K = transforms.corner_K_from_centre_K(np.array(params[key], float))
        K[:2] *= factor
        out[key] = transforms.centre_K_from_corner_K(K).tolist()
        out[f"{index}_width"], out[f"{index}_height"] = (round(n * factor) for n in size)
        if f"{index}_ori" in params:
            out[f"{index}_ori"] = f"{index}.jpg"
    return out


def resized(image: npt.NDArray[np.float32], side: int) -> npt.NDArray[np.float32]:
    """Averaged by area until its longest side is `side`."""
    h, w = image.shape[:2]
    factor = side / max(h, w)
    return np.asarray(cv2.resize(image, (round(w * factor), round(h * factor)), interpolation=cv2.INTER_AREA))


def behind(kind: str, height: int, width: int, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """(height, width, 3) linear background."""
    y, x = (c[..., None] / height for c in np.mgrid[:height, :width])
    if kind == "skin":
        out = np.array([0.42, 0.28, 0.22]) * (0.8 + 0.5 * x)
    elif kind == "white":
        out = np.ones(3) * (0.75 + 0.25 * y)
    else:
        grids = (0.7**k * rng.normal(size=(4 * 2**k, 4 * 2**k, 3)) for k in range(6))
        out = 0.3 + 0.15 * sum(cv2.resize(g, (width, height), interpolation=cv2.INTER_CUBIC) for g in grids)
    return np.asarray(np.clip(out, 0.02, 1), np.float32)


def middle(linear: npt.NDArray[np.float32], alpha: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """(3,) median of the subject's linear colours. linear: (H, W, 3) before black, alpha (H, W)."""
    return np.asarray(np.median(linear[alpha > INSIDE], axis=0), np.float32)


def main() -> None:
    """Write the worse capture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--side", type=int, default=640, help="longest side of the new photos (%(default)s)")
    parser.add_argument("--noise", type=float, default=0.0275, help="standard deviation, white = 1 (%(default)s)")
    parser.add_argument("--quality", type=int, default=95, help="of the JPEG (%(default)s)")
    parser.add_argument("--background", choices=("skin", "white", "colours", "plain"))
    parser.add_argument("--every", type=int, default=1, help="take every so many photos (%(default)s)")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    params = json.loads((args.capture / "params.json").read_text())
    (args.out / "params.json").write_text(json.dumps(smaller(params, args.side)))
    rng, plain = np.random.default_rng(0), None
    photos = (p for p in args.capture.iterdir() if p.stem.isdigit() and p.suffix.lower() in (".png", ".jpg", ".jpeg"))
    for photo in sorted(photos, key=lambda p: int(p.stem))[:: args.every]:
        linear = resized(read_linear(photo)[..., :3], args.side)
        if args.background:
            alpha = resized(read_alpha(args.capture / "truth" / "alpha" / f"{photo.stem}.png"), args.side)
            if args.background == "plain" and plain is None:
                plain = middle(linear, alpha)
            back = behind(args.background, alpha.shape[0], alpha.shape[1], rng) if plain is None else plain
            linear = linear + (1 - alpha[..., None]) * back
        shown = srgb_from_linear(linear)
        shown = shown + args.noise * rng.normal(size=shown.shape) * (shown > BLACK)
        pixels = np.round(255 * np.clip(shown, 0, 1)).astype(np.uint8)[..., ::-1]
        cv2.imwrite(str(args.out / f"{photo.stem}.jpg"), pixels, [cv2.IMWRITE_JPEG_QUALITY, args.quality])
    truth = args.out / "truth"
    for mask in sorted((args.capture / "truth" / "alpha").glob("*.png")):
        (truth / "alpha").mkdir(parents=True, exist_ok=True)
        write_png(truth / "alpha" / mask.name, resized(read_alpha(mask), args.side))
    for name in ("mesh_gt.ply", "env.exr"):
        if (args.capture / "truth" / name).is_file():
            shutil.copy(args.capture / "truth" / name, truth / name)


if __name__ == "__main__":
    main()
