"""Report stage: writes metrics.json and one HTML page from the results of all other stages."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from pipeline.artifacts import CameraSet, FittedFace, Located, MaskSet, Surface, TextureSet, UvMesh
from pipeline.asset_artifacts import Report, UsdAsset
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage, StageConfig
from pipeline.reflectance_artifacts import ReflectanceField

PICTURE_SIDE = 360  # pixels: longer side of a picture on the page
VIEWS_SHOWN = 8  # held-out views shown as pictures; the table lists all
MASKS_SHOWN = 24  # photos shown with the outline of their mask, the worst first


@dataclass(frozen=True, slots=True)
class Inputs:
    """The artifacts of all other stages."""

    capture: Located[Capture]
    poses: Located[CameraSet]
    masks: Located[MaskSet]
    inverse_rendering: Located[FittedFace]
    surface: Located[Surface]
    uv: Located[UvMesh]
    reflectance: Located[ReflectanceField]
    bake: Located[TextureSet]
    usd: Located[UsdAsset]


class Config(StageConfig):
    """Settings of the report."""

    viewer: bool = Field(True, description="put a 3D view of the asset into the page (needs usd.glb)")


def run(inputs: Inputs, config: Config, context: Context) -> Report:
    """Score the views, collect the figures, write metrics.json and index.html."""
    import json

    from pipeline.verdict import verdict_of_inputs
    from stages.report.build import best_median_worst, build_page, build_rows, summary
    from stages.report.collect import figures
    from stages.report.compare import judged_views, unjudged
    from stages.report.judge import judge

    rows, total = [], max(1, len(inputs.usd.artifact.views), len(inputs.inverse_rendering.artifact.held_out))
    for number, view in enumerate(judged_views(inputs)):
        context.check()
        rows.append(build_rows(view, PICTURE_SIDE))
        context.progress(number + 1, total + 1, f"view {view.index}")
    findings = judge(rows, {v.index: v.name for v in inputs.capture.artifact.views})
    verdict = verdict_of_inputs(inputs, report=findings)
    metrics = {"verdict": verdict.record(every=True), "holdout": summary(rows), "timing": {}, **figures(inputs)}
    metrics["warnings"] = [*metrics["warnings"], *unjudged(inputs)]
    (context.workdir / "metrics.json").write_text(json.dumps(metrics, indent=1) + "\n")
    page = build_page(
        metrics, verdict, best_median_worst(rows, VIEWS_SHOWN), inputs, PICTURE_SIDE, MASKS_SHOWN, view=config.viewer
    )
    (context.workdir / "index.html").write_text(page, encoding="utf-8")
    context.progress(total + 1, total + 1, "done")
    files = context.file("index.html"), context.file("metrics.json")
    return Report(files=files, warnings=tuple(unjudged(inputs)), findings=findings)


STAGE = Stage(name="report", version=20, inputs=Inputs, config=Config, output=Report, run=run)
