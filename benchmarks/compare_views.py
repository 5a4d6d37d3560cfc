"""How close a picture of an asset is to a photo or to another picture, over the subject's pixels.

    python benchmarks/compare_views.py RENDER.exr TRUTH.{jpg,png,exr} ALPHA.png [SIDE_BY_SIDE.png]

Prints psnr_fg (dB of sRGB-encoded values where alpha > 0.5) as it is, after one gain (exposure alignment, least
squares on linear values), and after one 3 x 3 matrix. The larger picture is shrunk by means over blocks.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from pipeline.colour import srgb_from_linear
from pipeline.images import read_alpha, read_linear, shrink, write_png
from stages.report.metrics import encoded, psnr


def compare(shown: np.ndarray, truth: np.ndarray, alpha: np.ndarray) -> dict[str, float]:
    """(H, W, 3) linear, (H, W): psnr_fg `raw`, `gain` and `matrix`, and the gain itself."""
    fg = alpha > 0.5
    a, b = shown[fg].astype(np.float64), truth[fg].astype(np.float64)
    gain = float((a * b).sum() / (a * a).sum())
    matrix = np.linalg.lstsq(a, b, rcond=None)[0]
    scores = {"raw": a, "gain": a * gain, "matrix": a @ matrix}
    return {k: psnr(encoded(v), encoded(b)) for k, v in scores.items()} | {"exposure": gain}


def main() -> None:
    """See the module."""
    shown, truth = (read_linear(Path(p)) for p in sys.argv[1:3])
    alpha = read_alpha(Path(sys.argv[3]))
    side = min(len(shown), len(truth))
    shown, truth, alpha = (shrink(x, len(x) // side) for x in (shown, truth, alpha))
    scores = compare(shown, truth, alpha)
    print("  ".join(f"{k} {v:.3f}" for k, v in scores.items()))
    if len(sys.argv) > 4:
        pictures = [srgb_from_linear((x * alpha[..., None]).clip(0, 1)) for x in (shown * scores["exposure"], truth)]
        write_png(Path(sys.argv[4]), np.concatenate(pictures, 1))


if __name__ == "__main__":
    main()
