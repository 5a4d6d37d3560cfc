"""Figures of all stages as one plain dictionary: the content of metrics.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from pipeline.artifacts import CameraSet, FittedFace, Located, MaskSet, Surface, TextureSet, UvMesh
from pipeline.asset_artifacts import UsdAsset
from pipeline.capture_artifacts import Capture
from pipeline.reflectance_artifacts import ReflectanceField
from pipeline.tiles import FIRST
from stages.report.chart import chart_figures
from stages.report.field_figures import field_figures


class Started(Protocol):
    """The artifacts from which the reconstruction started."""

    @property
    def capture(self) -> Located[Capture]: ...
    @property
    def poses(self) -> Located[CameraSet]: ...
    @property
    def masks(self) -> Located[MaskSet]: ...


class Results(Started, Protocol):
    """All artifacts that the report reads."""

    @property
    def inverse_rendering(self) -> Located[FittedFace]: ...
    @property
    def surface(self) -> Located[Surface]: ...
    @property
    def uv(self) -> Located[UvMesh]: ...
    @property
    def reflectance(self) -> Located[ReflectanceField]: ...
    @property
    def bake(self) -> Located[TextureSet]: ...
    @property
    def usd(self) -> Located[UsdAsset]: ...


def own_colours(model: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether the fit gave every photo its own colour response. model: decision on each part of the model."""
    return bool(model.get("calibration", {}).get("modelled"))


def figures(r: Results) -> dict[str, Any]:
    """Everything except the views' scores and the timing."""
    face, surface, uv = r.inverse_rendering.artifact, r.surface.artifact, r.uv.artifact
    bake, usd = r.bake.artifact, r.usd.artifact
    cameras = r.poses.artifact
    return {
        "model": {k: dict(v) for k, v in face.model.items()},
        "fit": {
            "steps": face.steps,
            "loss": face.loss,
            "psnr_fitted_views": face.psnr,
            "views": len(face.fitted_views),
            "rank": face.rank,
            "light_order": face.light_order,
            "beta": face.beta,
            "cell": face.cell,
        },
        "photos": {str(p.index): {"psnr": p.psnr, "weight": p.weight, "low_share": p.low_share} for p in face.photos},
        "cameras": {
            "source": cameras.source,
            "metric": cameras.metric,
            "scale": cameras.scale,
            "registered": len(cameras.cameras),
            "unregistered": len(cameras.unregistered),
            "reprojection_error_px": cameras.reprojection_error_px,
        },
        "colour_chart": chart_figures(r),
        "masks": {
            "views": len(r.masks.artifact.masks),
            "dropped": len(r.masks.artifact.dropped),
            "faces": sum("face" in m.labelled for m in r.masks.artifact.masks),
            "hair": sum("hair" in m.labelled for m in r.masks.artifact.masks),
            "extent": "head" if r.masks.artifact.extent is not None else "region of interest",
            "views_cut_by_extent": sum(m.asked is not None for m in r.masks.artifact.masks),
        },
        "surface": {
            "vertices": surface.vertices,
            "faces": surface.faces,
            "watertight": surface.watertight,
            "components": surface.components,
            "removed_components": surface.removed_components,
            "trimmed_share": surface.trimmed,
            "handles_cut": surface.handles_cut,
            "handles_left": surface.handles_left,
        },
        "uv": {
            "vertices": uv.vertices,
            "faces": uv.faces,
            "quads": uv.quads,
            "charts": uv.charts,
            "tiles": uv.tiles,
            "utilisation": uv.utilisation,
            **{f"utilisation_{FIRST + t}": share for t, share in enumerate(uv.tile_utilisation)},
            "stretch": uv.stretch,
            "face_share": uv.face_share,
            "overlap": uv.overlap,
            "stretch_max": uv.stretch_max,
            "seam_front_mm": uv.seam_front_mm,
            "deviation_mm": uv.deviation_mm,
            "deviation_rms_mm": uv.deviation_rms_mm,
            "proxy_deviation_rms_mm": uv.proxy_deviation_rms_mm,
        },
        "maps": {
            "size": bake.size,
            "tiles": bake.tiles,
            "covered_share": bake.coverage,
            "zero_set_rms_mm": bake.zero_set_rms_mm,
            **{f"zero_set_rms_mm_{name}": value for name, value in sorted(bake.lod_rms_mm.items())},
            **bake.figures,
            **{
                n: {"channels": m.channels, "minimum": m.minimum, "mean": m.mean, "maximum": m.maximum}
                for n, m in sorted(bake.maps.items())
            },
        },
        "regions": dict(bake.regions),
        "asset": {
            "name": usd.name,
            "root": usd.root.rpartition("/")[2],
            "checks": usd.checks,
            "megabytes": round(sum(f.size for f in usd.files if f.path.startswith("asset/")) / 1e6, 2),
            **{k: usd.stated.get(k, "not stated") for k in ("author", "license", "subjectConsent")},
            **usd.figures,
        },
        "reflectance": field_figures(r.reflectance.artifact),
        "warnings": warnings(r),
    }


def warnings(r: Results) -> list[str]:
    """The warnings of all stages, in their order, and what they left out."""
    out = [f"capture: {w}" for w in r.capture.artifact.warnings]
    out += [f"capture: left out: {x}" for x in r.capture.artifact.left_out]
    out += [f"poses: {w}" for w in r.poses.artifact.warnings]
    if not r.poses.artifact.metric:
        out.append("poses: the scale is unknown; the asset's size is an assumption")
    if r.poses.artifact.unregistered:
        out.append(f"poses: no camera pose was found for {', '.join(r.poses.artifact.unregistered)}")
    out += [f"masks: {w}" for w in r.masks.artifact.warnings]
    if r.masks.artifact.dropped:
        out.append(
            f"masks: views not fitted, because their mask disagrees: {', '.join(map(str, r.masks.artifact.dropped))}"
        )
    for name in ("inverse_rendering", "surface", "uv", "reflectance", "bake", "usd"):
        out += [f"{name}: {w}" for w in getattr(r, name).artifact.warnings]
    return list(dict.fromkeys(out))
