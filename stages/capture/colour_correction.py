"""Colour correction of all photos of a capture by the colour checker that some of them show.

Symbols: c linear colour of a photo, e its exposure, M its camera's map to reflectances (stages.capture.colour_matrix).
Stored is k M c, with the largest k up to 1 at which every colour of every photo is within a file's range. k is the
chart's `level`: a perfect white at its place has k e in a stored photo. e is unchanged, from EXIF.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.artifacts import FileRef
from pipeline.capture_artifacts import CaptureView, ChartFound, ColourChart
from pipeline.colour import srgb_from_linear
from pipeline.errors import StageError
from pipeline.images import read_encoded, read_linear, write_exr, write_png
from pipeline.transforms import matrix, rows
from stages.capture.colour_checker import F64, Patches
from stages.capture.colour_matrix import ColourMatrix, colour_matrix_of


@dataclass(frozen=True, slots=True)
class ChartReading:
    """The colour correction, None without a usable chart. warnings: about charts that can't be used."""

    chart: ColourChart | None
    warnings: list[str]


def read_charts(views: Sequence[CaptureView], found: Sequence[Patches | None], wanted: bool) -> ChartReading:
    """For each camera, the chart with the smallest error. found: the detected chart of each view, or None.

    Raises:
        StageError: `wanted`, and no photo shows a usable chart.
    """
    best: dict[str, tuple[ColourMatrix, CaptureView, Patches]] = {}
    seen, warnings = [], []
    for view, patches in zip(views, found, strict=True):
        if patches is None:
            continue
        correction = colour_matrix_of(_unexposed(patches, view.exposure))
        if isinstance(correction, str):
            warnings.append(f"{view.name}: the colour checker {correction}; it is not used")
            continue
        seen.append(view.name)
        other = best.get(view.camera_group)
        if other is None or correction.error < other[0].error:
            best[view.camera_group] = (correction, view, patches)
    if wanted and not best:
        raise StageError("no colour checker is found", where="capture.colour_checker=on",
                         value="; ".join(warnings[:3]) or "none detected",
                         limit="a classic colour checker of 24 patches, complete, flat, and at least a fifth of a "
                         "photo's longer edge wide", remedy="photograph it close to the face in the same light, or set "
                         "capture.colour_checker=auto")  # fmt: skip
    if not best:
        return ChartReading(None, warnings)
    fits = tuple(_fit(*b) for _, b in sorted(best.items()))
    k = 1 / max(1.0, *(float(matrix(f.matrix).clip(0).sum(1).max()) for f in fits))
    return ChartReading(ColourChart(photos=tuple(seen), level=round(k, 6), fits=fits), warnings)


def _unexposed(patches: Patches, exposure: float) -> Patches:
    return Patches(patches.corners, patches.colours / exposure, patches.usable)


def _fit(correction: ColourMatrix, view: CaptureView, patches: Patches) -> ChartFound:
    white = np.linalg.solve(correction.matrix, np.ones(3)).round(4)
    return ChartFound(camera_group=view.camera_group, photo=view.name, index=view.index,
                      corners=rows(patches.corners.round(3)), matrix=rows(correction.matrix.round(6)),
                      way=correction.way, error=round(correction.error, 4), patches=correction.patches,
                      white=(float(white[0]), float(white[1]), float(white[2])))  # fmt: skip


def correct_colours(
    chart: ColourChart, views: Sequence[CaptureView], folder: Path, tick: Callable[[int, str], None]
) -> list[CaptureView]:
    """The views with corrected photos and clean plates, which replace the copies in `folder`. Cameras whose photos show
    no chart get the mean of the other cameras' matrices. tick: done, name."""
    of = {f.camera_group: chart.level * matrix(f.matrix) for f in chart.fits}
    mean = np.asarray(np.mean(list(of.values()), axis=0), np.float64)
    out = []
    for n, view in enumerate(views):
        tick(n, view.name)
        m = of.get(view.camera_group, mean)
        changed = {"image": FileRef.of(folder, recoloured(folder / view.image.path, m))}
        if view.plate is not None:
            changed["plate"] = FileRef.of(folder, recoloured(folder / view.plate.path, m))
        if view.parallel is not None:
            changed["parallel"] = FileRef.of(folder, recoloured(folder / view.parallel.path, m))
        out.append(view.model_copy(update=changed))
    return out


def recoloured(path: Path, m: F64) -> Path:
    """Replace a photo by m c and return the new file: 16-bit PNG, or EXR for a float file. m: (3, 3). Negative Rec.709
    values are clamped at 0."""
    image = read_encoded(path)
    colours = np.asarray((read_linear(path) @ m.T.astype(np.float32)).clip(0), np.float32)
    path.unlink()
    if not np.issubdtype(image.dtype, np.integer):
        target = path.with_suffix(".exr")
        write_exr(target, colours)
        return target
    encoded = np.asarray(srgb_from_linear(colours), np.float32)
    if image.shape[2] == 4:
        alpha = image[..., 3:].astype(np.float32) / np.float32(np.iinfo(image.dtype.name).max)
        encoded = np.concatenate([encoded, alpha], 2)
    target = path.with_suffix(".png")
    write_png(target, encoded, bits=16)
    return target
