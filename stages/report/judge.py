"""How good the asset is in views that nothing was fitted to: its renders against held-out photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from pipeline.verdict import Finding, Limits, judged
from stages.report.metrics import Scores

# PSNR over the subject after one 3 x 3 matrix a view, since nothing tells a held-out photo's exposure. Measured drafts:
# scanned head 35.7 dB, the same head by a noisy rig 32.1, made-up head of the demo 32.8; a stone head in grey photos
# and a man in a rig 23, both recognised at a glance; two men by phone 19 to 20; melted faces and a skull under moving
# shadows 15.7 to 17.2; a bust without its head 6.9.
PSNR = Limits(28.0, 18.0)
# Overlap of the silhouettes: .992 to .997 on the heads above, .92 to .96 with frayed shoulders, .35 without the head.
MASK = Limits(0.95, 0.8)
# dB by which the worst view may lie below the median: at most 3 on the heads above; 7 where its mask is wrong.
WORST = Limits(6.0, 15.0, lower=False)
# dB that are lost from the fitted field to the asset: 0 to .4 on sound meshes, 1.9 with hundreds of charts.
LOST = Limits(0.7, 3.0, lower=False)


class Row(Protocol):
    """A judged view (stages.report.build.JudgedRow)."""

    @property
    def index(self) -> int: ...
    @property
    def held_out(self) -> bool: ...
    @property
    def model(self) -> Scores | None: ...
    @property
    def asset(self) -> Scores | None: ...


def judge(rows: Sequence[Row], names: Mapping[int, str]) -> tuple[Finding, ...]:
    """Findings of the held-out views; none where there are none. names: of the photos, by index. The asset counts, the
    model where nothing of the asset was rendered."""
    scored = [(r.index, s) for r in rows if r.held_out and (s := r.asset or r.model) is not None]
    if not scored:
        return ()
    by_error = sorted(scored, key=lambda x: (x[1].psnr_matched, x[0]))
    by_mask = sorted(scored, key=lambda x: (x[1].mask_iou, x[0]))
    matched = float(np.mean([s.psnr_matched for _, s in scored]))
    overlap = float(np.mean([s.mask_iou for _, s in scored]))
    median, (least_index, least) = float(np.median([s.psnr_matched for _, s in scored])), by_error[0]
    worst = median - least.psnr_matched
    count = f"{len(scored)} photos that took no part in the fit"
    return (
        judged(
            "held_out_psnr",
            matched,
            PSNR,
            f"the asset shows {count} with {matched:.1f} dB in the mean",
            "compare photo and asset in the report's views: where shape is wrong, photograph from more directions; "
            "where all is blurred, keep the subject still",
            unit="dB",
            views=_named(by_error, names),
        ),
        judged(
            "held_out_mask_iou",
            overlap,
            MASK,
            f"the asset's silhouette overlaps the masks of {count} by {overlap:.3f}",
            "a part of the subject is missing, or something beside it was modelled: look at masks and cameras",
            views=_named(by_mask, names),
        ),
        judged(
            "held_out_worst",
            worst,
            WORST,
            f"the worst of {count}, {names.get(least_index, least_index)}, has {least.psnr_matched:.1f} dB, "
            f"{worst:.1f} below their median",
            "look at this photo: a wrong mask or camera, movement, or a side that no other photo shows",
            unit="dB",
            views=_named([x for x in by_error if x[1].psnr_matched < median - WORST.good], names),
        ),
        *_lost(rows),
    )


def _lost(rows: Sequence[Row]) -> list[Finding]:
    """What mesh and maps cost."""
    both = [r.model.psnr - r.asset.psnr for r in rows if r.held_out and r.model is not None and r.asset is not None]
    if not both:
        return []
    value = max(float(np.mean(both)), 0.0)
    message = f"the exported asset is {value:.1f} dB below the fitted model in the same views"
    remedy = "mesh or texture is too coarse or in shreds: look at charts and handles; more texels (bake.size) may help"
    return [judged("asset_against_model", value, LOST, message, remedy, unit="dB")]


def _named(scored: Sequence[tuple[int, Scores]], names: Mapping[int, str]) -> tuple[str, ...]:
    return tuple(names.get(index, str(index)) for index, _ in scored)
