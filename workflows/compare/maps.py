"""The same map of both runs on one fixed scale, and the difference, texel by texel in A's charts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from workflows.compare.pictures import Picture, Row, signed
from workflows.compare.runs import Side
from workflows.compare.surface import Matched, looked_up, spread_out

F32 = npt.NDArray[np.float32]
DISTANCE = 2.0  # mm at the ends of the scale of the surfaces' distance


@dataclass(frozen=True, slots=True)
class Kind:
    """How a map is shown. low, high: its scale, none for colours. reach: of the difference, at the scale's
    ends."""

    name: str
    title: str
    reach: float
    low: float = 0.0
    high: float = 0.0
    unit: str = ""


KINDS = (
    Kind("albedo", "albedo", 0.1),
    Kind("f0", "F0", 0.02, 0, 0.06),
    Kind("roughness", "roughness", 0.3, 0, 1),
    Kind("normal", "normal", 20, unit="degrees"),
    Kind("displacement", "displacement", 1, -2, 2, "mm"),
    Kind("ambient_occlusion", "ambient occlusion", 0.3, 0, 1),
    Kind("confidence", "confidence", 0.5, 0, 1),
    Kind("coverage", "coverage: measured or assumed", 0.5, 0, 1),
)


def rows(a: Side, b: Side, match: Matched | str) -> Iterator[Row]:
    """Distance of the surfaces, then each map that at least one run has."""
    if not isinstance(match, str):
        yield _distance(match)
    for kind in KINDS:
        arrays = [_read(s, kind.name) for s in (a, b)]
        if any(x is not None for x in arrays):
            yield _row(kind, (a, b), arrays, match)


def _distance(match: Matched) -> Row:
    mm = np.asarray(1000 * match.distance, np.float32)
    known = np.isfinite(mm)
    size = np.abs(mm[known])
    caption = f"A outside of B: blue, inside: orange; scale -{DISTANCE:g} to +{DISTANCE:g} mm"
    figures = (
        f"median {np.median(size):.3f} mm, 95 % below {np.percentile(size, 95):.2f} mm" if len(size) else "no match"
    )
    note = f"{figures}; {100 * (1 - known.mean()):.1f} % of A's surface is not on B"
    return Row("Shape: distance of the two surfaces", note, (_sheet(match, signed(mm, DISTANCE), known, caption),))


def _row(kind: Kind, sides: tuple[Side, Side], arrays: list[F32 | None], match: Matched | str) -> Row:
    scale = f"; scale {kind.low:g} to {kind.high:g} {kind.unit}".rstrip() if kind.high > kind.low else ""
    one, two = arrays
    if isinstance(match, str) or one is None or two is None:
        pictures = tuple(
            _picture(_shown(kind, x[:: max(1, len(x) // 256), :: max(1, len(x) // 256)]), f"{s.name}{scale}")
            for s, x in zip(sides, arrays, strict=True)
            if x is not None
        )
        missing = [s.name for s, x in zip(sides, arrays, strict=True) if x is None]
        return Row(kind.title, f"{' and '.join(missing)} has no such map" if missing else "", pictures)
    values = [looked_up(x, uv) for x, uv in ((one, match.sheet.uv), (two, match.uv))]
    known = np.isfinite(match.distance) | match.same_charts
    pictures = tuple(
        _sheet(match, _shown(kind, v), k, f"{s.name}{scale}{_mean(kind, v[k])}")
        for s, v, k in zip(sides, values, (np.ones_like(known), known), strict=True)
    )  # fmt: skip
    if kind.name == "normal" and not match.same_charts:
        return Row(kind.title, "in each run's own tangent frames: no difference where the charts differ", pictures)
    return Row(kind.title, *_difference(kind, values, known, match, pictures))


def _difference(
    kind: Kind, values: list[F32], known: npt.NDArray[np.bool_], match: Matched, pictures: tuple[Picture, ...]
) -> tuple[str, tuple[Picture, ...]]:
    """The note and all pictures."""
    from stages.report.pictures import heat

    if kind.name == "normal":
        dot = (values[0] * values[1]).sum(1) / np.maximum(np.prod([np.linalg.norm(v, axis=1) for v in values], 0), 1e-9)
        step = np.degrees(np.arccos(dot.clip(-1, 1))).astype(np.float32)
        shown, caption = (
            heat(step[:, None] / kind.reach)[:, 0],
            f"angle between them; scale 0 to {kind.reach:g} degrees",
        )
    else:
        step = np.asarray((values[1] - values[0]).mean(1), np.float32)
        shown = signed(step, kind.reach)
        caption = f"B - A: blue above, orange below; scale -{kind.reach:g} to +{kind.reach:g} {kind.unit}".rstrip()
    some = step[known & np.isfinite(step)]
    size = np.abs(some)
    note = (
        f"mean difference {_rounded(some.mean())}, median of its size {_rounded(np.median(size))}"
        if len(some)
        else "no match"
    )
    return note, (*pictures, _sheet(match, shown, known, caption))


def _shown(kind: Kind, values: F32) -> npt.NDArray[np.uint8]:
    """RGB (..., 3) of a map's values (..., C)."""
    from stages.report.metrics import encoded
    from stages.report.pictures import scale_colours, to_bytes

    flat = np.nan_to_num(values).reshape(-1, 1, values.shape[-1])
    if kind.name == "albedo":
        rgb = to_bytes(encoded(flat[..., :3].astype(np.float32)))
    elif kind.name == "normal":
        rgb = to_bytes(flat[..., :3] * 0.5 + 0.5)
    else:
        share = ((flat[..., 0] - kind.low) / (kind.high - kind.low)).clip(0, 1)
        rgb = scale_colours()[np.round(share * 255).astype(np.uint8)]
    return np.asarray(rgb.reshape(*values.shape[:-1], 3), np.uint8)


def _mean(kind: Kind, values: F32) -> str:
    return "" if kind.name == "normal" or not len(values) else f", mean {_rounded(values.mean())}"


def _rounded(value: float) -> str:
    return f"{round(float(value), 6):.3g}"


def _sheet(match: Matched, rgb: npt.NDArray[np.uint8], known: npt.NDArray[np.bool_], caption: str) -> Picture:
    """Colours (N, 3) of the texels in A's charts; what has no chart, or is not known, is transparent."""
    alpha = np.where(known, 255, 0).astype(np.uint8)[:, None]
    return _picture(spread_out(match.sheet, np.concatenate([rgb, alpha], 1), 0), caption)


def _picture(image: npt.NDArray[np.uint8], caption: str) -> Picture:
    from stages.report.pictures import data_uri

    return Picture(data_uri(np.ascontiguousarray(image), max(image.shape[:2]), lossless=True), caption)


def _read(side: Side, name: str) -> F32 | None:
    """(H, tiles H, C) a map from the store, else from the asset's folder; None if it is in neither."""
    from pipeline import tiles
    from pipeline.images import read_exr

    files = _in_store(side, name) or _published(side, name)
    return tiles.side_by_side([read_exr(f)[0] for f in files]) if files else None


def _in_store(side: Side, name: str) -> list[Path]:
    from pipeline import tiles

    bake: dict[str, Any] = side.run.manifest("bake")
    count, files = int(bake.get("tiles", 1)), bake.get("maps", {}).get(name, {}).get("files", {})
    found = [side.stored("bake", files.get(tiles.form("exr", t, count))) for t in range(count)]
    return [f for f in found if f is not None] if all(found) else []


def _published(side: Side, name: str) -> list[Path]:
    """NAME_map.exr, or its tiles in order, wherever below asset/ they lie."""
    asset = Path(str(side.record.get("asset", ""))).stem
    found = [
        p for pattern in (f"{asset}_{name}.exr", f"{asset}_{name}.1*.exr") for p in (side.out / "asset").rglob(pattern)
    ]
    return sorted(found, key=lambda p: p.name) if asset else []
