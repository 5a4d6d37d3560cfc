"""The demo's result against its ground truth: pictures, surface and albedo.

Everything is measured on the published files (USD, maps, predicted views), brought into the capture's world by
run.json's capture_from_asset. Distances are in millimetres, colours as PSNR of sRGB-encoded values in dB.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.images import read_alpha, read_encoded, read_exr, shrink
from pipeline.transforms import matrix
from workflows.evaluation import geometry
from workflows.evaluation.geometry import as_seen, asset_mesh, distances, psnr
from workflows.evaluation.held_out import held_out_exr

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Figures:
    """psnr: held-out views, the subject's pixels, sRGB. accuracy: asset to truth, mm. completeness: truth to asset."""

    psnr: float
    psnr_asset: float
    accuracy_mean: float
    accuracy_median: float
    completeness_mean: float
    albedo: float
    views: int

    def lines(self) -> list[str]:
        """For people."""
        return [
            f"held-out views ({self.views}), subject's pixels: {self.psnr:.1f} dB from the fitted model, "
            f"{self.psnr_asset:.1f} dB from the exported asset",
            f"surface, asset to truth: mean {self.accuracy_mean:.2f} mm, median {self.accuracy_median:.2f} mm; "
            f"truth to asset: mean {self.completeness_mean:.2f} mm",
            f"albedo, after one gain: {self.albedo:.1f} dB",
        ]


def measure(out: Path, capture_folder: Path, capture: Capture) -> Figures:
    """Compare the run in `out` with `capture_folder`/truth."""
    import trimesh

    record = json.loads((out / "run.json").read_text())
    mesh, st = asset_mesh(out / record["asset"], matrix(record["capture_from_asset"]))
    truth = trimesh.load(capture_folder / "truth" / "mesh_gt.ply", process=False)
    fitted = [v for v in capture.views if not v.holdout]
    held = [v for v in capture.views if v.holdout]
    accuracy = 1000 * distances(truth, seen_by(mesh, fitted))
    completeness = 1000 * distances(mesh, seen_by(truth, fitted))
    return Figures(
        psnr=_mean(_picture_psnr(held_out_exr(out, "views", v.index), capture_folder, v) for v in held),
        psnr_asset=_mean(_picture_psnr(held_out_exr(out, "asset_views", v.index), capture_folder, v) for v in held),
        accuracy_mean=float(accuracy.mean()),
        accuracy_median=float(np.median(accuracy)),
        completeness_mean=float(completeness.mean()),
        albedo=_albedo_psnr(out, capture_folder, mesh, st, held),
        views=len(held),
    )


def _mean(values: Iterator[float]) -> float:
    found = list(values)
    return float(np.mean(found)) if found else float("nan")


# ------------------------------------------------------------------ pictures
def _picture_psnr(render: Path, capture_folder: Path, view: CaptureView) -> float:
    predicted = read_exr(render)[0][..., :3]
    photo = (read_encoded(capture_folder / view.name)[..., :3].astype(np.float32) / 255).astype(np.float32)
    factor = photo.shape[0] // predicted.shape[0]
    subject = shrink(read_alpha(capture_folder / f"truth/alpha/{view.index}.png"), factor) > 0.5
    return psnr(as_seen(predicted)[subject], shrink(photo, factor)[subject])


# ------------------------------------------------------------------ surface
def seen_by(mesh: Any, views: list[CaptureView]) -> F64:
    """Points spread over a mesh that several of the views show (truth_geometry.SEEN_BY)."""
    return geometry.seen(mesh, ((geometry.camera_of(v), None) for v in views))


# ------------------------------------------------------------------ albedo
def _albedo_psnr(out: Path, capture_folder: Path, mesh: Any, st: F64, views: list[CaptureView]) -> float:
    """Albedo map seen from the held-out cameras against the truth's, after the one gain that fits best."""
    texture = geometry.albedo_map(out / "asset/textures")
    got, expected = [], []
    for view in views:
        path = capture_folder / f"truth/albedo/{view.index}.exr"
        if path.is_file():
            alpha = read_alpha(capture_folder / f"truth/alpha/{view.index}.png")
            a, b = geometry.albedo_pairs(mesh, st, texture, geometry.camera_of(view), read_exr(path)[0][..., :3], alpha)
            got.append(a)
            expected.append(b)
    if not got:
        return float("nan")
    gain = geometry.best_gain(np.concatenate(got), np.concatenate(expected))
    return _mean(psnr(as_seen(gain * a), as_seen(b)) for a, b in zip(got, expected, strict=True))
