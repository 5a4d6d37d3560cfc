"""How far the masks of a run are from pictures that label every pixel of its photos.

    python -m benchmarks.masks_against_labels RUN_DIR LABELS_DIR [--each]

RUN_DIR is a finished run whose store still has its photos and masks. LABELS_DIR has a PNG with the name of each photo,
0 on the background. Told are the IoU at alpha 0.5, and the wrong pixels further than FAR from the true contour as
shares of the subject: whole parts that a mask lacks or adds, not its accuracy at the edge.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.start_against_truth import found_in
from pipeline.images import read_alpha

FAR = 3.0  # pixels
Bool = npt.NDArray[np.bool_]
F64 = npt.NDArray[np.float64]


def agreement(inside: Bool, truth: Bool) -> tuple[float, float, float]:
    """IoU of a mask (H, W) with the truth (H, W), and the shares of the truth's area that it adds and lacks, far from
    the true contour."""

    def distance(where: Bool) -> F64:
        return np.asarray(cv2.distanceTransform(where.astype(np.uint8), cv2.DIST_L2, 5), np.float64)

    added, lacking = inside & (distance(~truth) > FAR), ~inside & (distance(truth) > FAR)
    area = max(int(truth.sum()), 1)
    union = max(int((inside | truth).sum()), 1)
    return float((inside & truth).sum()) / union, float(added.sum()) / area, float(lacking.sum()) / area


def main() -> None:
    """Compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("labels", type=Path)
    parser.add_argument("--each", action="store_true", help="a line for each photo")
    args = parser.parse_args()
    found, _ = found_in(args.run)
    names = {v.index: v.name for v in found["capture"].artifact.views}
    rows = []
    for m in found["masks"].artifact.masks:
        labels = cv2.imread(str(args.labels / f"{Path(names[m.index]).stem}.png"), cv2.IMREAD_GRAYSCALE)
        if labels is None:
            continue
        rows.append(agreement(read_alpha(found["masks"].path(m.mask)) >= 0.5, labels > 0))
        if args.each:
            print(f"{names[m.index]} ({m.source}): IoU {rows[-1][0]:.4f}, {rows[-1][1]:.2%} added, "
                  f"{rows[-1][2]:.2%} lacking")  # fmt: skip
    if not rows:
        raise SystemExit(f"{args.labels}: no labels of these photos")
    iou, added, lacking = np.array(rows).T
    print(f"{len(rows)} masks: IoU {iou.mean():.4f} in the mean, {iou.min():.4f} at worst; "
          f"{added.mean():.2%} added and {lacking.mean():.2%} lacking beyond {FAR:g} pixels")  # fmt: skip


if __name__ == "__main__":
    main()
