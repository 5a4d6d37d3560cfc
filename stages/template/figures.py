"""Figures of a registration for its artifact."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np

from pipeline.eyes.fit import FittedBall
from pipeline.head_artifacts import FittedEye
from pipeline.registration.inside import shown_through
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
        "eyes_fitted": float(sum(not b.reason for b in found.eyes.values())),
        "iris_pixels": min((b.pixels for b in found.eyes.values()), default=0.0),
        "folded": found.fitted.folded,
        "pierced": face_piercings(head, regions),
        "shown_through": shown_through(head, regions, found.placed.scale),
        "repairs": found.fitted.repairs,
        "angle_least": quads.least,
        "angle_largest": quads.largest,
        "angle_sharp_1_percent": quads.sharp,
        "angle_blunt_1_percent": quads.blunt,
        "aspect_1_percent": quads.aspect,
    }
    return {name: round(float(value), 5) for name, value in values.items()}


def fitted_eye(part: str, ball: FittedBall) -> FittedEye:
    """An eye for the artifact, rounded to micrometres."""
    eye = ball.eye
    figures = {"pixels": ball.pixels, "score": ball.score, "shown": ball.shown, "off_mm": 1000 * ball.off}
    return FittedEye(
        part=part,
        centre=cast(tuple[float, float, float], tuple(round(float(x), 6) for x in eye.centre)),
        radius=round(eye.radius, 6),
        iris=round(eye.iris, 6),
        axes=tuple(tuple(round(float(x), 9) for x in row) for row in eye.axes),
        figures={k: round(float(v), 4) for k, v in figures.items()},
    )
