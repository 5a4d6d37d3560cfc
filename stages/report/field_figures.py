"""Figures of a reflectance field for metrics.json."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.reflectance_artifacts import LeftOutPicture, ReflectanceField

BANDS = 4  # of the angle to the nearest light, with as many angles in each


def field_figures(field: ReflectanceField) -> dict[str, Any]:
    """`reflectance` of metrics.json; only `present` if the capture is of no light stage."""
    if not field.present:
        return {"present": False}
    return {
        "present": True,
        "size": field.size,
        "lights": field.lights,
        "left_out": list(field.left_out),
        "cameras_left_out": list(field.cameras),
        **field.figures,
        "by_angle": by_angle(field.predicted),
        "pictures": [p.model_dump(mode="json") for p in field.predicted],
    }


def by_angle(found: Sequence[LeftOutPicture]) -> list[dict[str, float]]:
    """Pictures in bands of the angle to the nearest light: its limits, PSNR of the mean squared error of field and
    blend, number of pictures. A light's pictures are in one band."""
    angles = sorted({p.angle for p in found})
    out = []
    for some in np.array_split(angles, min(BANDS, len(angles))) if angles else []:
        inside = [p for p in found if some[0] <= p.angle <= some[-1]]
        out.append({"from": float(some[0]), "to": float(some[-1]), "pictures": len(inside),
                    "psnr": together([p.psnr for p in inside]),
                    "blend_psnr": together([p.blend_psnr for p in inside])})  # fmt: skip
    return out


def together(decibels: Sequence[float]) -> float:
    """PSNR of pictures together, from theirs: that of the mean of their squared errors."""
    return round(float(-10 * np.log10(np.mean(10 ** (-np.array(decibels) / 10)))), 2)
