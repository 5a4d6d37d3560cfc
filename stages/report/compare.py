"""The views that are scored: photos, masks, predictions and renders of the asset, one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import HeldOutView, Located, RegisteredView, ViewMask
from pipeline.capture_artifacts import CaptureView
from pipeline.images import read_alpha, read_encoded, read_exr, read_linear, shrink
from pipeline.polarised import unpolarised
from stages.report.by_label import LabelErrors, label_errors
from stages.report.collect import Results, own_colours
from stages.report.features import feature_shifts
from stages.report.metrics import Scores, matched, score

F32 = npt.NDArray[np.float32]
MIN_SHARE = 0.99  # of a pixel inside the region that counts, for the pixel to count, as in the fit


@dataclass(frozen=True, slots=True)
class JudgedView:
    """One view. photo (H, W, 3), mask (H, W) of the subject inside its extent, renders (H, W, 4) restricted to the
    region that counts; scores are None if there is no render.

    registered_scores: of the model from the camera that the photo's own registration to it found, None where it was not
    registered. own_colours: photos differ in exposure or white balance, and those of this photo are unknown.
    model_labels, asset_labels: errors by the photo's labels, empty if it has none. mask_from: where the mask comes
    from, as the stage masks names it ("given": the capture's own). features: how far those of a face lie from where the
    photo shows them (feature_shifts).
    """

    index: int
    name: str
    held_out: bool
    photo: F32
    mask: F32
    model: F32 | None
    asset: F32 | None
    model_scores: Scores | None
    asset_scores: Scores | None
    registered_scores: Scores | None = None
    own_colours: bool = False
    model_labels: LabelErrors = field(default_factory=dict)
    asset_labels: LabelErrors = field(default_factory=dict)
    mask_from: str = ""
    features: dict[str, float] = field(default_factory=dict)

    def shown(self, render: F32) -> F32:
        """A render (H, W, 4) for the page: in the photo's colours, if the fit has a colour response per photo."""
        return matched(render, self.photo, self.mask) if self.own_colours and (self.mask > 0.5).any() else render


def judged_views(r: Results) -> Iterator[JudgedView]:
    """Views with a mask and with a render of the model or the asset, in the order of their index."""
    predicted = {v.index: v for v in r.inverse_rendering.artifact.held_out}
    rendered = {v.index: v for v in r.usd.artifact.views}
    registered = {v.camera.index: v for v in r.inverse_rendering.artifact.registered}
    masks = {m.index: m for m in r.masks.artifact.masks}
    own = own_colours(r.inverse_rendering.artifact.model)
    for view in sorted(r.capture.artifact.views, key=lambda v: v.index):
        i = view.index
        if i not in predicted.keys() | rendered.keys() or i not in masks:
            continue
        factor = (predicted.get(i) or rendered[i]).scale
        fitted = shrink(read_linear(r.capture.path(view.image)), factor)
        photo = _without_filters(r, view, fitted, factor)
        asked = _asked(r, masks[i], factor)
        mask = shrink(read_alpha(r.masks.path(masks[i].mask)), factor) * asked
        shown = (
            _read(r.inverse_rendering, predicted.get(i)),
            _read(r.usd, rendered.get(i)),
            _read(r.inverse_rendering, registered.get(i)),
        )
        model, asset, again = (None if x is None else np.asarray(x * asked[..., None], np.float32) for x in shown)
        scores = [
            score(x, p, mask) if x is not None and (mask > 0.5).any() else None
            for x, p in ((model, fitted), (asset, photo), (again, fitted))
        ]
        errors = [_by_label(r, masks[i], x, p, mask, factor) for x, p in ((model, fitted), (asset, photo))]
        person = r.masks.artifact.landmarks is not None
        features = feature_shifts(photo, mask, asset) if person and asset is not None else {}
        yield JudgedView(
            i, view.name, view.holdout, photo, mask, model, asset, scores[0], scores[1], scores[2], own, errors[0],
            errors[1], masks[i].source, features,
        )  # fmt: skip


def _without_filters(r: Results, view: CaptureView, fitted: F32, factor: int) -> F32:
    """(H, W, 3) the photo that the asset should look like: the fitted one, or of a polarised pair what a camera without
    a filter shows. The field is compared with the fitted one, which shows no highlights, and neither does the field."""
    if view.parallel is None:
        return fitted
    return unpolarised(fitted, shrink(read_linear(r.capture.path(view.parallel)), factor), view.parallel_exposure)


def _asked(r: Results, mask: ViewMask, factor: int) -> F32:
    """(H, W) 1 where pixels count: the subject inside its extent, or background; (1, 1) if all pixels count."""
    if mask.asked is None:
        return np.ones((1, 1), np.float32)
    return np.asarray(shrink(read_alpha(r.masks.path(mask.asked)), factor) > MIN_SHARE, np.float32)


def _by_label(r: Results, of: ViewMask, render: F32 | None, photo: F32, mask: F32, factor: int) -> LabelErrors:
    if of.labels is None or render is None:
        return {}
    codes = read_encoded(r.masks.path(of.labels))[factor // 2 :: factor, factor // 2 :: factor, 0]
    codes = codes[: mask.shape[0], : mask.shape[1]]
    return label_errors(render, photo, mask, codes, r.masks.artifact.label_names) if codes.shape == mask.shape else {}


def unjudged(r: Results) -> list[str]:
    """Messages on held-out views that have no scores."""
    predicted, masks = ({v.index for v in a} for a in (r.inverse_rendering.artifact.held_out, r.masks.artifact.masks))
    out = []
    for view in r.capture.artifact.views:
        if view.holdout and view.index not in predicted:
            out.append(f"report: held-out view {view.index} was not predicted (it has no camera)")
        elif view.holdout and view.index not in masks:
            out.append(f"report: held-out view {view.index} has no mask and was not scored")
    return out


def _read(at: Located, view: HeldOutView | RegisteredView | None) -> F32 | None:  # type: ignore[type-arg]
    return None if view is None else read_exr(at.path(view.exr))[0][..., :4]
