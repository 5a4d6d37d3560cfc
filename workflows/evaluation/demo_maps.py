"""The exported F0 and roughness maps against the demo's ground truth, at the true points that its held-out views see.

The maps are read from the written asset, as an artist's program reads them; demo_material.py compares the fitted field.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from pipeline.capture_artifacts import Capture
from pipeline.transforms import apply
from stages.usd.render.exported import ExportedAsset, load_exported
from stages.usd.render.render import Renderer, vertex_values
from workflows.evaluation.demo_material import F64, agreement, seed_of, seen_points


def compare_maps(root: Path, capture_folder: Path, capture: Capture, capture_from_asset: F64) -> list[str]:
    """The figures in words; none for an asset whose standard material was not fitted. root: the asset's NAME.usd."""
    from pipeline.demo import skin

    asset = load_exported(root)
    if asset.f0 is None or asset.roughness is None:
        return []
    points = np.concatenate([seen_points(v, capture_folder).points for v in capture.views if v.holdout])
    f0, roughness = at_points(asset, apply(np.asarray(np.linalg.inv(capture_from_asset), np.float64), points))
    true = skin.material(points, seed_of(capture_folder))
    return [
        agreement(f0, true.f0).line("exported F0"),
        agreement(roughness, true.roughness).line("exported roughness"),
    ]


def at_points(asset: ExportedAsset, points: F64) -> tuple[F64, F64]:
    """F0 and roughness (N,) of the maps at the vertices nearest to points (N, 3), asset coordinates."""
    assert asset.f0 is not None and asset.roughness is not None
    renderer = Renderer(asset)
    _, nearest = cKDTree(asset.mesh.vertices).query(points)
    f0, roughness = (vertex_values(x, renderer)[nearest, 0] for x in (asset.f0, asset.roughness))
    return f0, roughness
