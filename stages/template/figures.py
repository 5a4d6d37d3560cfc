"""Figures of a registration for its artifact."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.registration.quality import Distances, distances, face_piercings, outer_quads, quad_quality, seen_share
from pipeline.registration.scan import Scan
from stages.template.register import Registration


def region_figures(found: Registration, regions: tuple[str, ...], scan: Scan) -> Mapping[str, Distances]:
    """Distances by region, rounded to micrometres."""
    measured = distances(found.head, regions, scan, found.placed.scale)
    return {
        n: Distances(
            round(d.median, 3), round(d.most, 3), round(d.displaced_median, 3), round(d.displaced_most, 3), d.count
        )
        for n, d in measured.items()
    }


def figures_of(found: Registration, regions: tuple[str, ...], skin: Distances) -> dict[str, float]:
    """Figures by name. scale: metres per metre of the template; angles in degrees, of the cage's outer quads."""
    head = found.head
    quads = quad_quality(head.vertices, head.quads[outer_quads(head.region, regions)])
    values = {
        "scale": found.placed.scale,
        "scale_deviation": found.placed.scale_deviation,
        "identity_rms": float(np.sqrt((found.placed.weights**2).mean())) if len(found.placed.weights) else 0.0,
        "landmarks_mm": found.landmarks_mm,
        "distance_mm": skin.median,
        "distance_95_mm": skin.most,
        "displaced_mm": skin.displaced_median,
        "displaced_95_mm": skin.displaced_most,
        "seen": seen_share(head, regions),
        "eyes_closed": float(found.closed),
        "folded": found.fitted.folded,
        "pierced": face_piercings(head, regions),
        "repairs": found.fitted.repairs,
        "angle_least": quads.least,
        "angle_largest": quads.largest,
        "angle_sharp_1_percent": quads.sharp,
        "angle_blunt_1_percent": quads.blunt,
        "aspect_1_percent": quads.aspect,
    }
    return {name: round(float(value), 5) for name, value in values.items()}
