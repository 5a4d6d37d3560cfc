"""A run's asset against the truth that lies beside its capture, if one does: surface in mm, albedo in dB.

    truth/mesh_gt.ply                  the surface, metres, in the world of the capture's given cameras
    truth/alpha/I.png, truth/mask/I.png    the subject of photo I
    truth/albedo/I.exr                 linear albedo seen from photo I, smaller by a whole factor
    truth/skin.obj, cameras.json, ...  a rendered person (workflows.evaluation.rendered_person)

Surface: points spread evenly over each, of which those count that at least three fitted views see (in the picture, not
hidden, turned to the camera; the asset's also on the subject). accuracy: asset to truth; completeness: truth to asset;
chamfer: the mean of both. All means of exact distances to triangles. Albedo: the map seen from the cameras of
truth/albedo, PSNR of sRGB-encoded values, mean over views; once as it is and once after the one factor for all views
and colours that fits best.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.camera import PinholeCamera
from pipeline.capture_artifacts import CaptureView
from pipeline.transforms import matrix
from workflows.bench.captures_figures import Figures, Run
from workflows.evaluation import geometry
from workflows.evaluation.albedo import Labels, albedo_figures
from workflows.evaluation.geometry import F32, F64


def measure(run: Run, folder: Path) -> tuple[Figures, Labels]:
    """Every figure for which there is a truth, and PSNR by label of model and asset; empty without a truth."""
    truth = folder / "truth"
    if not truth.is_dir() or "asset" not in run.record:
        return {}, {}
    if (truth / "skin.obj").is_file() and (truth / "cameras.json").is_file():
        from workflows.evaluation import rendered_person

        return rendered_person.measure(run, truth)
    if not (truth / "mesh_gt.ply").is_file() or run.manifest("poses").get("source") != "given":
        return {}, {}
    return _scanned(run, truth), {}


def _scanned(run: Run, truth: Path) -> Figures:
    import trimesh

    views = [CaptureView.model_validate(v) for v in run.manifest("capture")["views"]]
    with_camera = [v for v in views if v.camera is not None]
    asset, st = geometry.asset_mesh(run.out / run.record["asset"], matrix(run.record["capture_from_asset"]))
    fitted = [(geometry.camera_of(v), alpha_of(truth, v.index)) for v in with_camera if not v.holdout]
    found = surface_figures(asset, trimesh.load(truth / "mesh_gt.ply", process=False), fitted)
    from_file = {str(v.index): geometry.camera_of(v) for v in with_camera}
    return found | albedo_figures(run, truth, asset, st, from_file)


def alpha_of(truth: Path, index: int) -> F32 | None:
    """(H, W) the subject of a photo, where the truth has it."""
    from pipeline.images import read_alpha

    paths = (truth / name / f"{index}.png" for name in ("alpha", "mask"))
    return next((read_alpha(p) for p in paths if p.is_file()), None)


def surface_figures(asset: Any, truth: Any, fitted: list[tuple[PinholeCamera, F32 | None]]) -> Figures:
    """Distances in mm of two meshes in metres; what no three views see counts for neither."""
    mine = geometry.seen(asset, fitted)
    true = geometry.seen(truth, [(camera, None) for camera, _ in fitted])
    accuracy = _mm(geometry.distances(truth, mine)) if len(mine) else None
    completeness = _mm(geometry.distances(asset, true)) if len(true) else None
    both = [x for x in (accuracy, completeness) if x is not None]
    chamfer = round(sum(both) / 2, 4) if len(both) == 2 else None
    return {"accuracy_mm": accuracy, "completeness_mm": completeness, "chamfer_mm": chamfer}


def _mm(metres: F64) -> float:
    return round(1000 * float(metres.mean()), 4)
