"""An asset's albedo against the true one, seen from the cameras of truth/albedo. PSNR of sRGB-encoded values, mean over
views: as it is, and after the one factor for all views and colours that fits best."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera import PinholeCamera
from workflows.bench.captures_figures import Figures, Run
from workflows.evaluation import geometry
from workflows.evaluation.geometry import F64

Labels = dict[str, dict[str, dict[str, float]]]  # PSNR and share of the error by label, of model and asset


def albedo_figures(run: Run, truth: Path, asset: Any, st: F64, cameras: dict[str, PinholeCamera]) -> Figures:
    """Of the pictures in truth/albedo whose camera is known; asset and cameras are in one world. cameras: by the
    pictures' stems."""
    from pipeline.images import read_alpha, read_exr

    texture, pairs = None, []
    for path in sorted((truth / "albedo").glob("*.exr")):
        if path.stem not in cameras:
            continue
        values, names = read_exr(path)
        inner = truth / "alpha" / f"{path.stem}.png"
        if "A" not in names and not inner.is_file():
            continue
        alpha = values[..., names.index("A")] if "A" in names else read_alpha(inner)
        texture = geometry.albedo_map(run.out / "asset" / "textures") if texture is None else texture
        pairs.append(geometry.albedo_pairs(asset, st, texture, cameras[path.stem], values[..., :3], alpha))
    pairs = [(got, want) for got, want in pairs if len(got)]
    if not pairs:
        return {}
    gain = geometry.best_gain(*(np.concatenate(part) for part in zip(*pairs, strict=True)))
    raw, gained = (
        float(np.mean([geometry.psnr(geometry.as_seen(k * a), geometry.as_seen(b)) for a, b in pairs]))
        for k in (1.0, gain)
    )
    return {"albedo_db": round(raw, 3), "albedo_gain_db": round(gained, 3), "albedo_gain": round(gain, 4)}
