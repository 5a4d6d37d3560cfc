"""The checks of the exported asset: faults in the files, and quality that was lost from the fitted model to the asset.

Source of the limits: PSNR between renders of the asset and of the fitted model is 39 to 43 dB for clean heads, 30 to 33
for people photographed by hand, 22 for a badly broken torso. The lobes of clean heads differ by .65 and .94 of the
fitted ones. Where F0 is out of its physical range (see stages.bake.judge), a lobe can still be close to GGX: .12 to
.78.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.colour import srgb_from_linear
from pipeline.verdict import Finding, Limits, judged
from stages.usd.check import findings as checks

F32 = npt.NDArray[np.float32]
AGAINST_MODEL = Limits(28.0, 20.0)  # dB
OVERLAP = Limits(0.97, 0.9)  # of the silhouettes, intersection over union
FAULTS = Limits(0, 0, lower=False)
WARNINGS = Limits(0, np.inf, lower=False)
# A spot differs by CLEARLY of 1, sRGB-encoded, has SPOT of the subject's area, and is RIM of its size from its outline.
CLEARLY, SPOT, RIM = 0.4, 1e-4, 0.008
SPOTTED = Limits(0.5, np.inf, lower=False)  # of the views: one with the mouth's inside beside the nose 1, others to .29
SHOWN = 3  # faults that are quoted
EQUAL = 1e-10  # lower limit of the mean squared difference: 100 dB


def validity(found: Sequence[tuple[str, checks.Finding]]) -> tuple[Finding, ...]:
    """Findings on the checks of all files: (name of the file, result of a check)."""
    bad, doubtful = (_texts(f for f in found if f[1].level == level) for level in ("error", "warning"))
    return (
        judged(
            "usd_faults",
            len(bad),
            FAULTS,
            f"the checks of the USD files found {len(bad)} errors{_quoted(bad)}",
            "programs may fail to open the asset; report this with the run's log",
        ),
        judged(
            "usd_warnings",
            len(doubtful),
            WARNINGS,
            f"the checks of the USD files gave {len(doubtful)} warnings{_quoted(doubtful)}",
            "test the asset in the programs that you use",
        ),
    )


def against_model(views: Iterable[tuple[str, F32, F32]]) -> tuple[Finding, ...]:
    """Compare renders of the asset with those of the model: (photo's name, model's, asset's) with pictures (H, W, 4)
    linear, premultiplied."""
    seen, spotted = [], []
    for name, model, asset in views:  # one by one: they are read from files
        seen.append((name, *_compared(model, asset)))
        if spots(model, asset):
            spotted.append(name)
    if not seen:
        return ()
    db = -10 * np.log10(max(float(np.mean([10 ** (-p / 10) for _, p, _ in seen])), EQUAL))
    share = float(np.mean([s for _, _, s in seen]))
    worst = [name for name, _, _ in sorted(seen, key=lambda s: s[1])]
    remedy = "decimation or texel size loses detail: raise bake.size and uv.target_faces, and check the surface"
    return (
        judged(
            "asset_against_model",
            db,
            AGAINST_MODEL,
            f"PSNR of the asset's renders against the fitted model's: {db:.1f} dB",
            remedy,
            unit="dB",
            views=worst,
        ),
        judged(
            "asset_silhouette",
            share,
            OVERLAP,
            f"IoU of the asset's silhouettes and the fitted model's: {share:.1%}",
            "a part of the model is missing in the mesh: see the findings of the surface stage",
            views=[name for name, _, _ in sorted(seen, key=lambda s: s[2])],
        ),
        judged(
            "asset_spots",
            len(spotted) / len(seen),
            SPOTTED,
            f"in {len(spotted)} of {len(seen)} views the asset has a spot that the fitted model does not have",
            "look at these views in the report: a part may come through another, or a face may be turned around",
            views=spotted,
        ),
    )


def spots(model: F32, asset: F32) -> int:
    """Regions inside of the asset's outline that differ clearly from the model's picture, holes included. Pictures
    (H, W, 4) linear, premultiplied."""
    shown = (model[..., 3] > 0.5) & ndimage.binary_fill_holes(asset[..., 3] > 0.5)
    area = int(shown.sum())
    rim = max(1, round(RIM * area**0.5))
    differ = np.abs(_encoded(model) - _encoded(asset)).max(-1) > CLEARLY
    differ &= ndimage.distance_transform_edt(np.pad(shown, 1))[1:-1, 1:-1] > rim
    label, count = ndimage.label(ndimage.median_filter(differ, 3))
    return int((np.bincount(label.ravel(), minlength=count + 1)[1:] > SPOT * area).sum())


def _compared(model: F32, asset: F32) -> tuple[float, float]:
    """PSNR (dB) over the pixels that the model covers, and IoU of the silhouettes. Pictures (H, W, 4)."""
    a, b = model[..., 3] > 0.5, asset[..., 3] > 0.5
    both = float((a & b).sum() / max(int((a | b).sum()), 1))
    if not a.any():
        return 0.0, both
    difference = _encoded(model[a]) - _encoded(asset[a])
    return -10 * float(np.log10(max(float((difference**2).mean()), EQUAL))), both


def _encoded(linear: F32) -> npt.NDArray[np.float64]:
    return np.asarray(srgb_from_linear(linear[..., :3].clip(0, 1)), np.float64)


def _texts(found: Iterable[tuple[str, checks.Finding]]) -> list[str]:
    """Each fault once: a component and the scene that refers to it have the same faults."""
    messages: dict[tuple[str, str, str], str] = {}
    for file, f in found:
        messages.setdefault((f.check, f.message, f.where), f"{file}: {f.check}: {f.message} {f.where}".strip())
    return list(messages.values())


def _quoted(texts: list[str]) -> str:
    more = f"; and {len(texts) - SHOWN} more" if len(texts) > SHOWN else ""
    return ": " + "; ".join(texts[:SHOWN]) + more if texts else ""
