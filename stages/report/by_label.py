"""Errors of views by the labels of their photos: face, eyes, hair, the rest of the subject."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from stages.report.metrics import EQUAL, F32, encoded

LabelErrors = dict[str, tuple[float, int]]  # by label: sum of squared differences (sRGB-encoded), number of pixels
BODY = "body"  # the subject where there is no other label: neck, clothes, and hair that no network found


def label_errors(
    rendered: F32, photo: F32, mask: F32, labels: npt.NDArray[np.generic], names: Sequence[str]
) -> LabelErrors:
    """Errors of one view. rendered (H, W, 4), photo (H, W, 3) linear; mask (H, W); labels (H, W) codes."""
    inside = mask > 0.5
    square = ((encoded(rendered[..., :3][inside]).astype(np.float64) - encoded(photo[inside])) ** 2).mean(1)
    code = np.asarray(labels[inside], np.int64)
    out: LabelErrors = {}
    for k in np.unique(code):
        name = names[k] if k < len(names) else str(k)
        name = BODY if name in ("subject", "background") else name
        before = out.get(name, (0.0, 0))
        out[name] = before[0] + float(square[code == k].sum()), before[1] + int((code == k).sum())
    return out


def pooled(views: Iterable[LabelErrors]) -> dict[str, float]:
    """PSNR in dB by label, over the pixels of all views together."""
    total: LabelErrors = {}
    for view in views:
        for name, (square, count) in view.items():
            before = total.get(name, (0.0, 0))
            total[name] = before[0] + square, before[1] + count
    return {n: round(min(EQUAL, -10 * float(np.log10(max(s / k, 1e-10)))), 3) for n, (s, k) in sorted(total.items())}
