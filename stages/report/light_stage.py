"""The report's section on a reflectance field: a table, a plot, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from pipeline.artifacts import (
    Located,
)
from pipeline.images import read_encoded
from pipeline.reflectance_artifacts import LeftOutPicture, ReflectanceField
from stages.report.field_figures import by_angle
from stages.report.page import Picture, ViewRow
from stages.report.pictures import ERROR_RANGE, data_uri, heat

WIDTH, HEIGHT, MARGIN = 520, 220, 36  # of the plot
FIELD_COLOUR, BLEND_COLOUR = "#3b7dd8", "#c9772b"
PANELS = 2  # of a stored picture: truth, field


@dataclass(frozen=True, slots=True)
class FieldShown:
    """The section. headline: (value, name, explanation); bands: rows of `by_angle`; plot: SVG; rows: pictures of
    left-out lights; quick: a sentence on fewer lamps for an environment."""

    headline: Sequence[tuple[str, str, str]]
    bands: Sequence[dict[str, float]]
    plot: Markup
    legend: Sequence[tuple[str, str]]
    rows: Sequence[ViewRow]
    quick: str


def shown_field(r: Located[ReflectanceField], side: int) -> FieldShown | None:
    """The section; None without a field. side: pixels of a picture."""
    field = r.artifact
    if not field.present:
        return None
    f = field.figures
    headline, quick = [], ""
    if "left_out_psnr" in f:
        told = f"{len(field.left_out)} lights that the fit did not use, pixels of the mesh"
        headline = [
            (f"{f['left_out_psnr']:.1f} dB", "PSNR, field", told),
            (f"{f['blend_psnr']:.1f} dB", "PSNR, blend", "of the pictures under the three nearest lights"),
            (f"{f['left_out_angle']:.0f}°", "to the nearest light", "mean of the lights that were left out"),
        ]
    if "openpbr_psnr" in f:
        headline.append((f"{f['openpbr_psnr']:.1f} dB", "PSNR, OpenPBR", "the same by the asset's material alone"))
    if "left_out_camera_psnr" in f:
        told = f"the same lights seen by {len(field.cameras)} cameras that the fit did not use"
        headline.append((f"{f['left_out_camera_psnr']:.1f} dB", "PSNR, other cameras", told))
    if "quick_psnr" in f:
        quick = (
            f"An environment (the made light sunset) by {f['quick_lamps']:.0f} lamps (--quick) takes "
            f"{f['quick_lamps'] / f['full_lamps']:.2f} of the time of {f['full_lamps']:.0f}, and is "
            f"{f['quick_psnr']:.1f} dB from it."
        )
    legend = (("field", FIELD_COLOUR), ("blend of the three nearest lights", BLEND_COLOUR))
    return FieldShown(headline, by_angle(field.predicted), plot(field.predicted), legend, _rows(r, side), quick)


def _rows(r: Located[ReflectanceField], side: int) -> list[ViewRow]:
    """Truth, field and difference of each stored picture."""
    known = {(p.camera, p.light): p for p in r.artifact.predicted}
    out = []
    for ref in r.artifact.shown:
        name, camera, light = Path(ref.path).stem.split("_")
        p = known[int(camera), int(light)]
        truth, field = np.split(read_encoded(r.path(ref))[..., :3], PANELS, axis=1)
        off = np.abs(truth.astype(np.float32) - field.astype(np.float32)).mean(2) / 255
        pictures = [
            Picture(data_uri(np.ascontiguousarray(truth), side), "truth"),
            Picture(
                data_uri(np.ascontiguousarray(field), side), f"field, {p.psnr:.1f} dB; blend {p.blend_psnr:.1f} dB"
            ),
            Picture(data_uri(heat(off / np.float32(ERROR_RANGE)), side), "difference"),
        ]
        note = f"seen by camera {p.camera}, {p.angle:.0f} degrees from the nearest light of the fit"
        out.append(ViewRow(f"{name.capitalize()}: light {p.light}", note, pictures))
    return out


def plot(found: Sequence[LeftOutPicture]) -> Markup:
    """SVG: PSNR of every picture against the angle to the nearest light. Empty without pictures."""
    if not found:
        return Markup()
    values = [v for p in found for v in (p.psnr, p.blend_psnr)]
    low, high = 5 * np.floor(min(values) / 5), 5 * np.ceil(max(values) / 5 + 1e-9)
    left = 5 * np.floor(min(p.angle for p in found) / 5)
    right = max(5 * np.ceil(max(p.angle for p in found) / 5), left + 5)

    def x(angle: float) -> float:
        return float(MARGIN + (WIDTH - 2 * MARGIN) * (angle - left) / (right - left))

    def y(decibels: float) -> float:
        return float(HEIGHT - MARGIN - (HEIGHT - 2 * MARGIN) * (decibels - low) / max(high - low, 1))

    marks = [
        f'<circle cx="{x(p.angle):.1f}" cy="{y(v):.1f}" r="2.5" fill="{colour}" fill-opacity="0.6"/>'
        for p in found
        for v, colour in ((p.blend_psnr, BLEND_COLOUR), (p.psnr, FIELD_COLOUR))
    ]
    lines = []
    for v in np.arange(low, high + 1, 5):
        lines.append(f'<path d="M{MARGIN} {y(v):.1f}H{WIDTH - MARGIN}" stroke="#8886" fill="none"/>'
                     f'<text x="{MARGIN - 5}" y="{y(v) + 4:.1f}" text-anchor="end">{v:.0f}</text>')  # fmt: skip
    for a in np.arange(left, right + 1, 5):
        lines.append(f'<text x="{x(a):.1f}" y="{HEIGHT - MARGIN + 16}" text-anchor="middle">{a:.0f}</text>')
    lines.append(f'<text x="{WIDTH / 2:.0f}" y="{HEIGHT - 4}" text-anchor="middle">degrees to the nearest light</text>'
                 f'<text x="{MARGIN - 26}" y="{MARGIN - 14}">dB</text>')  # fmt: skip
    return Markup(
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" role="img" '
        'aria-label="PSNR of left-out lights against the angle to the nearest light" font-size="11" '
        f'fill="currentColor">{"".join(lines)}{"".join(marks)}</svg>'
    )
