"""Assembles the scores and pictures of the page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pipeline import tiles
from pipeline.images import read_encoded, read_exr
from pipeline.verdict import Verdict
from stages.report.by_label import LabelErrors, pooled
from stages.report.capture_figures import captured
from stages.report.collect import Results
from stages.report.compare import JudgedView
from stages.report.features import feature_figures
from stages.report.light_stage import shown_field
from stages.report.metrics import Scores, encoded, mean_scores
from stages.report.page import Picture, Pictures, ViewRow, render_page
from stages.report.pictures import (
    ERROR_RANGE,
    data_uri,
    error_map,
    light_picture,
    map_picture,
    scale_bar,
    scaled_picture,
    to_bytes,
    webp_uri,
)
from stages.report.uv_layout import uv_layout
from stages.report.verdict import verdict_shown
from stages.report.viewer import viewer

SKIPPED_MAPS = ("basis_lut",)  # a table, not a picture of the surface
FIXED_RANGES = {  # the same in every report, so that assets can be compared
    "f0": (0.0, 0.06), "roughness": (0.0, 1.0), "ambient_occlusion": (0.0, 1.0), "confidence": (0.0, 1.0),
    "inv_kappa": (0.0, 0.5), "specular_intensity": (0.0, 0.2), "displacement": (-2.0, 2.0),
    "cavity": (0.0, 1.0), "curvature": (-250.0, 250.0), "thickness": (0.0, 100.0), "measured": (0.0, 1.0),
}  # fmt: skip
REGISTERED = ("psnr", "psnr_matched")  # scores that are also given from the held-out photos' registered cameras
ENVIRONMENT, LOBE_FIT = "asset/environment.exr", "_lobe_fit."


@dataclass(frozen=True, slots=True)
class JudgedRow:
    """A view's scores and its pictures for the page, without the full images."""

    index: int
    held_out: bool
    model: Scores | None
    asset: Scores | None
    row: ViewRow
    registered: Scores | None = None
    model_labels: LabelErrors = field(default_factory=dict)
    asset_labels: LabelErrors = field(default_factory=dict)
    mask_from: str = ""
    features: dict[str, float] = field(default_factory=dict)


def build_rows(view: JudgedView, side: int) -> JudgedRow:
    """Pictures of a view: photo, model, asset, error of the asset (of the model if there is no render of the asset)."""
    pictures = [Picture(data_uri(to_bytes(encoded(view.photo)), side), "photo")]
    known = (("model", view.model, view.model_scores), ("asset", view.asset, view.asset_scores))
    renders = [(what, view.shown(image), scores) for what, image, scores in known if image is not None]
    for what, shown, scores in renders:
        picture = data_uri(to_bytes(encoded(shown[..., :3])), side)
        pictures.append(Picture(picture, what + _noted(scores, view.own_colours)))
    if renders:
        what, shown, _ = renders[-1]
        heat = data_uri(error_map(shown, view.photo, view.mask), side)
        pictures.append(Picture(heat, f"error of the {what}"))
    note = "held out" if view.held_out else "took part in the fit"
    return JudgedRow(
        view.index,
        view.held_out,
        view.model_scores,
        view.asset_scores,
        ViewRow(f"View {view.index}", f"{view.name}, {note}", pictures),
        view.registered_scores,
        view.model_labels,
        view.asset_labels,
        view.mask_from,
        view.features,
    )


def _noted(scores: Scores | None, own_colours: bool) -> str:
    if scores is None:
        return ""
    return f", {scores.psnr:.1f} dB" + (f", {scores.psnr_matched:.1f} in the photo's colours" if own_colours else "")


def best_median_worst(rows: list[JudgedRow], count: int) -> list[JudgedRow]:
    """At most `count` rows for the page: the views with the best, the median and the worst PSNR, named so, before the
    others in their order. Fewer than three scored views stay as they are."""
    scored = sorted((r for r in rows if r.asset or r.model), key=lambda r: -(r.asset or r.model).psnr)  # type: ignore[union-attr]
    if len(scored) < 3:
        return rows[:count]
    picked = (scored[0], "best"), (scored[len(scored) // 2], "median"), (scored[-1], "worst")
    named = [replace(r, row=replace(r.row, title=f"{what.capitalize()}: view {r.index}")) for r, what in picked]
    indices = {r.index for r in named}
    return [*named, *(r for r in rows if r.index not in indices)][:count]


def summary(rows: list[JudgedRow]) -> dict[str, Any]:
    """`holdout` of metrics.json: means over views, the worst view, and the scores of every view."""
    model, asset = [r.model for r in rows if r.model], [r.asset for r in rows if r.asset]
    held_out = bool(rows) and all(r.held_out for r in rows)
    out: dict[str, Any] = {"views": len(rows), "held_out": held_out, **mean_scores(model)}
    out |= {f"asset_{k}": v for k, v in mean_scores(asset).items()}
    again = mean_scores([r.registered for r in rows if r.registered])
    out |= {f"{k}_registered": again[k] for k in REGISTERED if again[k] is not None}
    scored = [(s.psnr, r.index) for r in rows if (s := r.asset or r.model)]
    out["worst_view"] = min(scored)[1] if scored else None
    labels = {"psnr": pooled(r.model_labels for r in rows), "asset_psnr": pooled(r.asset_labels for r in rows)}
    out["by_label"] = {k: v for k, v in labels.items() if v}
    out["per_view"] = {str(r.index): _both(r) for r in rows}
    out["masks"] = {str(r.index): r.mask_from for r in rows}  # by which the subject was told from the rest
    return out | feature_figures({r.index: r.features for r in rows})


def _both(row: JudgedRow) -> dict[str, float | None]:
    model = row.model.json() if row.model else {}
    again = row.registered.json() if row.registered else {}
    model |= {f"{k}_registered": again[k] for k in REGISTERED if k in again}
    return model | ({f"asset_{k}": v for k, v in row.asset.json().items()} if row.asset else {})


def build_page(
    metrics: Mapping[str, Any],
    verdict: Verdict,
    rows: list[JudgedRow],
    r: Results,
    side: int,
    outlines: int,
    *,
    view: bool,
) -> str:
    """The HTML page with its pictures; `view`: with the 3D view."""
    return render_page(
        metrics,
        Pictures(
            views=[x.row for x in rows],
            sides=_sides(r, side),
            films=_films(r),
            maps=_maps(r, side // 2),
            light=_light(r, side),
            scale=data_uri(scale_bar(), 256, lossless=True),
            scale_top=ERROR_RANGE,
            captured=captured(r, side // 2, outlines, r.inverse_rendering.artifact.photos),
            verdict=verdict_shown(verdict, r, side // 2),
            viewer=viewer(r) if view else None,
            field=shown_field(r.reflectance, side),
        ),
    )


def _sides(r: Results, side: int) -> list[Picture]:
    """The preview pictures of the asset, shape and appearance side by side."""
    found = {
        f.path.removeprefix("previews/").removesuffix(".png"): f
        for f in r.usd.artifact.files
        if f.path.startswith("previews/")
    }
    order = [n for s in ("left", "front", "right") for n in (s, f"shape_{s}") if n in found]
    return [
        Picture(
            data_uri(_over_grey(read_encoded(r.usd.path(found[n]))), side),
            n.replace("shape_", "shape from the ") if "shape" in n else f"{n}, captured light",
        )
        for n in order
    ]


def _films(r: Results) -> list[Picture]:
    """One turn under the captured light and under a made one."""
    files = {f.path.removeprefix("previews/turn_"): f for f in r.usd.artifact.files}
    words = {"captured": "one turn, captured light", "sunset": "one turn, sunset"}
    found = [(files[f"{name}.webp"], text) for name, text in words.items() if f"{name}.webp" in files]
    return [Picture(webp_uri(r.usd.path(f).read_bytes()), text) for f, text in found]


def _over_grey(image: np.ndarray[Any, Any]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """RGB of an 8-bit RGBA picture over mid grey, for light and dark pages."""
    if image.shape[2] < 4:
        return np.asarray(image, np.uint8)
    alpha = image[..., 3:].astype(np.float32) / 255
    return np.asarray(image[..., :3] * alpha + 90 * (1 - alpha), np.uint8)


def _maps(r: Results, side: int) -> list[Picture]:
    """Pictures of every map; UDIM tiles are side by side."""
    out, count = [], r.bake.artifact.tiles
    kinds = [tiles.form("exr", t, count) for t in range(count)]
    for name, texture in sorted(r.bake.artifact.maps.items()):
        if name not in SKIPPED_MAPS and set(kinds) <= texture.files.keys():
            pictures = [_thinned(read_exr(r.bake.path(texture.files[k]))[0], side) for k in kinds]
            values = tiles.side_by_side(pictures, whole=True)
            limits = FIXED_RANGES.get(name)
            picture = scaled_picture(values, *limits) if limits else map_picture(values, texture.space)
            scale = f"; scale {limits[0]:g} to {limits[1]:g}" if limits else ""
            out.append(Picture(data_uri(picture, side), f"{name.replace('_', ' ')}, mean {texture.mean:.3g}{scale}"))
    return [*out, *_lobe_fit(r, side), uv_layout(r, side)]


def _lobe_fit(r: Results, side: int) -> list[Picture]:
    """Picture of the error of GGX against the fitted lobe, and of places where the light does not determine kappa."""
    files = [f for f in r.usd.artifact.files if LOBE_FIT in f.path]
    if not files:
        return []
    picture = tiles.side_by_side([_thinned(read_encoded(r.usd.path(f))[..., :3], side) for f in files], whole=True)
    off = r.usd.artifact.figures.get("ggx_residual", 0.0)
    caption = f"GGX against the fitted lobe. Red: residual ({off:.1%} in total); green: kappa not resolved"
    return [Picture(data_uri(picture, side), caption)]


def _thinned(image: np.ndarray[Any, Any], side: int) -> np.ndarray[Any, Any]:
    """Subsampled rows and columns, about twice as many as are shown."""
    step = max(1, image.shape[0] // (2 * side))
    return np.asarray(image[::step, ::step])


def _light(r: Results, side: int) -> Picture | None:
    files = [f for f in r.usd.artifact.files if f.path == ENVIRONMENT]
    if not files:
        return None
    caption = "captured light (lat-long; the centre is in front of the face)"
    return Picture(data_uri(light_picture(read_exr(r.usd.path(files[0]))[0][..., :3]), side), caption)
