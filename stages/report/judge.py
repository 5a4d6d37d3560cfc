"""The checks on held-out photos: renders of the asset are compared with photos that were not fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from pipeline.verdict import Finding, Limits, judged
from stages.report.features import FEATURES
from stages.report.metrics import Scores

# PSNR over the subject after one 3 x 3 matrix per view, because the exposure of a held-out photo is unknown. Measured
# on drafts: scanned head 35.7 dB, the same head with a noisy rig 32.1, demo head 32.8; a stone head in grey photos and
# a man in a rig 23, both easily recognised; two men by phone 19 to 20; deformed faces and a skull under moving shadows
# 15.7 to 17.2; a bust without its head 6.9.
PSNR = Limits(28.0, 18.0)
# IoU of the silhouettes: .992 to .997 on the heads above, .92 to .96 with ragged shoulders, .35 without the head.
MASK = Limits(0.95, 0.8)
# dB of the worst view below the median: at most 3 on the heads above; 7 if its mask is wrong.
WORST = Limits(6.0, 15.0, lower=False)
# dB lost from the fitted field to the asset: 0 to .4 on good scans, .3 to .9 on heads made from the template, whose
# facets of 1.3 mm smooth the outline; 1.9 with hundreds of charts.
LOST = Limits(1.0, 3.0, lower=False)
# An asset that shows its photos that well is no broken one, whatever the model does better: ears and a hidden nape of
# a head seen by eight cameras cost 3.1 dB of 32.2.
LOST_OF_GOOD = Limits(LOST.good, np.inf, lower=False)
# Pixels, of 512 along the photo's longer side, from a feature of the face to where the photo shows it: .0 to .6 on
# persons in rigs and a man by phone with given lenses .4 to 1.7; a woman whose jaw moved 4.4.
FEATURE = Limits(4.0, np.inf, lower=False)


class Row(Protocol):
    """A scored view (stages.report.build.JudgedRow)."""

    @property
    def index(self) -> int: ...
    @property
    def held_out(self) -> bool: ...
    @property
    def model(self) -> Scores | None: ...
    @property
    def asset(self) -> Scores | None: ...
    @property
    def features(self) -> Mapping[str, float]: ...


def judge(rows: Sequence[Row], names: Mapping[int, str]) -> tuple[Finding, ...]:
    """Findings on the held-out views; none if there are no such views. names: of the photos, by index. The asset is
    checked, or the model if no render of the asset exists."""
    scored = [(r.index, s) for r in rows if r.held_out and (s := r.asset or r.model) is not None]
    if not scored:
        return ()
    by_error = sorted(scored, key=lambda x: (x[1].psnr_matched, x[0]))
    by_mask = sorted(scored, key=lambda x: (x[1].mask_iou, x[0]))
    matched = float(np.mean([s.psnr_matched for _, s in scored]))
    overlap = float(np.mean([s.mask_iou for _, s in scored]))
    median, (least_index, least) = float(np.median([s.psnr_matched for _, s in scored])), by_error[0]
    worst = median - least.psnr_matched
    count = f"{len(scored)} held-out photos"
    return (
        judged(
            "held_out_psnr",
            matched,
            PSNR,
            f"mean PSNR of the asset on {count}: {matched:.1f} dB",
            "compare photo and asset in the report: if the shape is wrong, take photos from more directions; if "
            "everything is blurred, keep the subject still",
            unit="dB",
            views=_named(by_error, names),
        ),
        judged(
            "held_out_mask_iou",
            overlap,
            MASK,
            f"mean IoU of the asset's silhouette and the masks of {count}: {overlap:.3f}",
            "a part of the subject is missing, or something beside it was modelled: check the masks and cameras",
            views=_named(by_mask, names),
        ),
        judged(
            "held_out_worst",
            worst,
            WORST,
            f"the worst of {count}, {names.get(least_index, least_index)}, has a PSNR of {least.psnr_matched:.1f} dB, "
            f"{worst:.1f} dB below the median",
            "check this photo: wrong mask or camera, movement, or a side that no other photo shows",
            unit="dB",
            views=_named([x for x in by_error if x[1].psnr_matched < median - WORST.good], names),
        ),
        *_lost(rows),
        *_features(rows, names),
    )


def _lost(rows: Sequence[Row]) -> list[Finding]:
    """The finding on PSNR that is lost from the fitted model to the asset."""
    both = [(r.model, r.asset) for r in rows if r.held_out and r.model is not None and r.asset is not None]
    if not both:
        return []
    value = max(float(np.mean([model.psnr - asset.psnr for model, asset in both])), 0.0)
    good = float(np.mean([asset.psnr_matched for _, asset in both])) >= PSNR.good
    message = f"PSNR of the exported asset is {value:.1f} dB below that of the fitted model in the same views"
    remedy = "mesh or texture is too coarse or broken: check charts and handles; more texels (bake.size) may help"
    return [judged("asset_against_model", value, LOST_OF_GOOD if good else LOST, message, remedy, unit="dB")]


def _features(rows: Sequence[Row], names: Mapping[int, str]) -> list[Finding]:
    """The finding on the feature of a face that lies farthest from where a held-out photo shows it."""
    far = sorted(
        ((v, n, r.index) for r in rows if r.held_out for n, v in r.features.items() if n in FEATURES), reverse=True
    )
    if not far:
        return []
    value, name, index = far[0]
    message = f"{name}: {value:.1f} px from where {names.get(index, index)} shows the same, of 512 px; the most of all"
    remedy = "look at this photo: the person moved or spoke, or the shape is wrong there and needs photos around it"
    views = tuple(dict.fromkeys(names.get(i, str(i)) for v, _, i in far if v > FEATURE.good))
    return [judged("features", value, FEATURE, message, remedy, unit="px", views=views)]


def _named(scored: Sequence[tuple[int, Scores]], names: Mapping[int, str]) -> tuple[str, ...]:
    return tuple(names.get(index, str(index)) for index, _ in scored)
