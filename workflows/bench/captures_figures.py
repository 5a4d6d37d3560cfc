"""The figures of one finished run: read from run.json, metrics.json and the manifests of its stages.

A run that ended early has some of these only; what is missing is left out, and nothing here fails for it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
Figures = dict[str, float | int | None]
Ranges = dict[str, dict[str, list[float]]]
FACE = ("face", "eyes")  # labels of the masks stage that make up a face
WHOLE, UNLABELLED = "whole", "unlabelled"
REASONS = 3  # of a verdict, the worst first: what fits into a table
ORDER = ("unusable", "usable")


@dataclass(frozen=True, slots=True)
class Run:
    """A run's folder. Manifests are read as they are, so that fields that a later version adds do no harm."""

    out: Path
    record: dict[str, Any]
    metrics: dict[str, Any]
    _manifests: dict[str, dict[str, Any]] = field(default_factory=dict)

    def folder(self, stage: str) -> Path | None:
        """Where a stage's files are; None if the run has none of it."""
        known = self.record.get("stages", {}).get(stage)
        return None if known is None else Path(self.record["store"]) / stage / known["key"]

    def manifest(self, stage: str) -> dict[str, Any]:
        """A stage's manifest; empty if the run has none of it."""
        if stage not in self._manifests:
            folder = self.folder(stage)
            path = folder / "manifest.json" if folder is not None else None
            self._manifests[stage] = json.loads(path.read_text()) if path is not None and path.is_file() else {}
        return self._manifests[stage]

    def path(self, stage: str, ref: dict[str, Any]) -> Path:
        """One of a stage's files."""
        folder = self.folder(stage)
        assert folder is not None
        return folder / str(ref["path"])


def read_run(out: Path) -> Run | None:
    """None if there is no run.json."""
    try:
        record = json.loads((out / "run.json").read_text())
    except (OSError, ValueError):
        return None
    try:
        metrics = json.loads((out / "report" / "metrics.json").read_text())
    except (OSError, ValueError):
        metrics = {}
    return Run(out, record, metrics)


# ------------------------------------------------------------------ the verdict
def verdict_of(run: Run | None) -> dict[str, Any]:
    """Its level, "none" where the run has no verdict, how many findings of each level, and the worst in words."""
    verdict = run.record.get("verdict") if run is not None else None
    if not isinstance(verdict, dict):
        return {"level": "none", "unusable": 0, "usable": 0, "reasons": []}
    found = verdict.get("findings", [])
    bad = sorted((f for f in found if f.get("level") in ORDER), key=lambda f: ORDER.index(f["level"]))
    reasons = [f"{f.get('stage', '')} {f.get('check', '')}: {f.get('said', '')}".strip() for f in bad[:REASONS]]
    counts = {level: sum(f["level"] == level for f in bad) for level in ORDER}
    return {"level": verdict.get("level", "none"), **counts, "reasons": reasons}


# ------------------------------------------------------------------ plain figures
def figures_of(run: Run) -> Figures:
    """Everything that needs no picture."""
    views, placed = run.manifest("capture").get("views", []), run.manifest("poses").get("cameras")
    held, timing = run.metrics.get("holdout", {}), run.record.get("timing", {})
    memory = [s.get("peak_memory_mb") or 0 for s in run.record.get("stages", {}).values()]
    found: Figures = {
        "photos": len(views) or None,
        "placed": None if placed is None else len(placed),
        "held_out": held.get("views") if held.get("held_out") else None,
        "psnr": held.get("psnr"),
        "psnr_matched": held.get("psnr_matched"),
        "psnr_registered": held.get("psnr_registered"),
        "asset_psnr": held.get("asset_psnr"),
        "asset_psnr_matched": held.get("asset_psnr_matched"),
        "asset_mask_iou": held.get("asset_mask_iou"),
        "features_px": held.get("features_px"),
        "features_px_most": held.get("features_px_most"),
        "unseen": run.manifest("bake").get("figures", {}).get("unseen"),
        "charts": run.manifest("uv").get("charts"),
        "seconds": timing.get("total"),
        "memory_mb": max(memory, default=0) or None,
    }
    return {**found, **_masks(run)}


def _masks(run: Run) -> Figures:
    agreed = [m["hull_iou"] for m in run.manifest("masks").get("masks", []) if m.get("hull_iou") is not None]
    if not agreed:
        return {"mask_median": None, "mask_worst": None}
    return {"mask_median": round(float(np.median(agreed)), 4), "mask_worst": round(float(min(agreed)), 4)}


# ------------------------------------------------------------------ texture
def texture_of(run: Run) -> tuple[Figures, Ranges]:
    """Fragments, the face's share of the covered texels of its tile, and ranges of F0 and roughness by label."""
    if "mesh" not in run.manifest("uv") or "maps" not in run.manifest("bake"):
        return {}, {}
    from pipeline import meshes
    from stages.uv.rough import FRAGMENT
    from stages.uv.unwrap import chart_of_face

    path = run.path("uv", run.manifest("uv")["mesh"])
    mesh, charts = meshes.load(path), meshes.load_charts(path)
    area = meshes.areas(mesh.vertices, mesh.faces)
    of_chart = np.bincount(chart_of_face(charts.faces, len(charts.uvs)), area / area.sum())
    found: Figures = {"fragments": int((of_chart < FRAGMENT).sum())}
    covered = _covered(mesh, charts, int(run.manifest("bake")["size"]))
    code = _map(run, "region")
    names = run.manifest("masks").get("label_names", [])
    inside = _labels(code[covered], names) if code is not None else {}
    if inside:
        faces = [mask for name, mask in inside.items() if name in FACE]
        tile = np.nonzero(covered)[1] // covered.shape[0]
        found["face_share"] = round(_of_own_tile(np.any(faces, axis=0), tile), 4) if faces else 0.0
    return found, _ranges(run, covered, inside)


def _of_own_tile(face: npt.NDArray[np.bool_], tile: npt.NDArray[np.int64]) -> float:
    """Share of the face (N,) in the covered texels of the tile that shows most of it. tile (N,): of each texel."""
    own = tile == np.bincount(tile, face).argmax()
    return float(face[own].mean())


def _covered(mesh: Any, charts: Any, size: int) -> npt.NDArray[np.bool_]:
    """(S, tiles S) texels whose centre is under a chart; beyond it maps only go on."""
    from pipeline import raster, tiles

    parts = [tiles.single_tile(mesh, charts, t)[1] for t in range(tiles.count(charts))]
    return np.concatenate([raster.layers(raster.texel_corners(p, size), size) > 0 for p in parts], 1)


def _map(run: Run, name: str) -> F32 | None:
    """(S, tiles S) one channel of a map; None if the run has no such map."""
    from pipeline import tiles
    from pipeline.images import read_exr

    bake = run.manifest("bake")
    verdict, count = bake.get("maps", {}).get(name), int(bake.get("tiles", 1))
    if verdict is None:
        return None
    files = [verdict["files"][tiles.form("exr", t, count)] for t in range(count)]
    return tiles.side_by_side([read_exr(run.path("bake", f))[0][..., :1] for f in files], whole=True)[..., 0]


def _labels(code: F32, names: list[str]) -> dict[str, npt.NDArray[np.bool_]]:
    """Which of the texels have each label; code 0 is where no photo with labels has seen the surface."""
    whole = np.rint(code).astype(int)
    found = {}
    for c in np.unique(whole):
        found[UNLABELLED if c == 0 else names[c] if c < len(names) else f"label {c}"] = whole == c
    return found


def _ranges(run: Run, covered: npt.NDArray[np.bool_], inside: dict[str, npt.NDArray[np.bool_]]) -> Ranges:
    """[least, mean, largest] of each map and label, and the label's share of the covered texels."""
    out: Ranges = {}
    every = np.ones(int(covered.sum()), np.bool_)
    for name in ("f0", "roughness"):
        values = _map(run, name)
        if values is None:
            continue
        for label, mask in {WHOLE: every, **inside}.items():
            some = values[covered][mask]
            if len(some):
                verdict = out.setdefault(label, {"share": [round(float(mask.mean()), 4)]})
                verdict[name] = [round(float(v), 4) for v in (some.min(), some.mean(dtype=np.float64), some.max())]
    return out
