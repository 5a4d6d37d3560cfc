"""How far the light is still in the base colour: its correlation with what arrives, by label.

Shading that was left in the albedo shows as a correlation with the irradiance that the fitted light predicts, shadows
and interreflections included, or with ambient occlusion. It is no proof on its own: lips, brows and creases are darker
than their surroundings whatever the light, so that a true albedo does not have 0 either.

Symbols: Pearson's r of the luminance (Rec.709) of the base colour with that of the irradiance, and with ambient
occlusion, over texels that photos show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.colour import LUMA
from pipeline.meshes import F32, F64, Indices
from stages.bake.regions import U8, Votes
from stages.bake.texels import Samples

MAX_TEXELS = 100_000  # evenly spaced texels of a tile: r is then accurate to .003
FEW = 200  # texels of a label from which it has figures


@dataclass(frozen=True, slots=True)
class Shown:
    """N texels that photos show. luma, lit, ambient (N,); code (N,): label, 0 without."""

    luma: F32
    lit: F32
    ambient: F32
    code: U8


def shown(s: Samples, texel: Indices, size: int, votes: Votes | None) -> Shown:
    """Evenly spaced texels of a tile that photos show; texel (N,): their flat indices in a picture of `size`."""
    seen = np.flatnonzero(s.unseen < 0.5)
    rows = seen[:: max(1, -(-len(seen) // MAX_TEXELS))]
    code = np.zeros(len(rows), np.uint8) if votes is None else votes.winners(texel[rows], size)
    luma = np.asarray(s.base_color[rows] @ np.array(LUMA), np.float32)
    return Shown(luma, s.lit[rows], s.ambient[rows], code)


def figures_of(parts: Sequence[Shown], names: Sequence[str]) -> dict[str, float]:
    """delight_LABEL_irradiance and delight_LABEL_occlusion of each label, in [-1, 1]; "surface" without labels. A label
    with few texels, or with one value everywhere, has none."""
    luma, lit, around = (np.concatenate([getattr(p, n) for p in parts]) for n in ("luma", "lit", "ambient"))
    code = np.concatenate([p.code for p in parts])
    out = {}
    for one in np.unique(code).tolist():
        own = code == one
        if own.sum() < FEW:
            continue
        name = "surface" if one == 0 else names[one] if one < len(names) else str(one)
        for what, values in (("irradiance", lit), ("occlusion", around)):
            found = pearson(luma[own].astype(np.float64), values[own].astype(np.float64))
            if found is not None:
                out[f"delight_{name}_{what}"] = round(found, 4)
    return out


def pearson(a: F64, b: F64) -> float | None:
    """Correlation coefficient of a (N,) and b (N,); None where one of them does not vary."""
    a, b = a - a.mean(), b - b.mean()
    length = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / length if length > 1e-12 * len(a) else None
