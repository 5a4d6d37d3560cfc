"""The same held-out photo in both runs: photo, A, B, how they differ, and which is nearer to the photo."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from workflows.compare.figures import at, scored_views
from workflows.compare.pictures import Picture, Row, fitted, signed
from workflows.compare.runs import Side, common_photos

if TYPE_CHECKING:
    from pathlib import Path

    from workflows.compare.pictures import F32

SHOWN = 6  # views with pictures
SIDE = 360  # pixels of a picture's longer side
NEARER = 0.1  # difference of the errors at the end of the signed scale, sRGB-encoded values


@dataclass(frozen=True, slots=True)
class Pair:
    """A photo that both runs rendered. psnr: of the asset in A and in B, None where it was not scored."""

    name: str
    a: dict[str, Any]
    b: dict[str, Any]
    psnr: tuple[float, float] | None


def pairs(a: Side, b: Side) -> list[Pair]:
    """Photos with a render in both, those where the PSNR changes most first: the largest loss, the largest gain, and so
    on in turn."""
    scored = scored_views(a, b)
    found = [Pair(str(x.get("name")), x, y, scored.get(str(x.get("name")))) for x, y in common_photos(a, b)
             if render_of(a, x) is not None and render_of(b, y) is not None]  # fmt: skip
    ranked = sorted(found, key=lambda p: p.psnr[1] - p.psnr[0] if p.psnr else 0.0)
    half = len(ranked) // 2
    losses, gains = ranked[: len(ranked) - half], ranked[len(ranked) - half :][::-1]
    return [p for i in range(len(losses)) for p in (losses[i], *gains[i : i + 1])]


def render_of(side: Side, view: dict[str, Any]) -> Path | None:
    """The picture of the exported asset through a photo's camera: of the store, else of OUT/report."""
    known = {v.get("index"): v.get("png") for v in side.run.manifest("usd").get("views", ()) if isinstance(v, dict)}
    index = view.get("index")
    published = side.out / "report" / "asset_views" / f"{index}.png"
    return side.stored("usd", known.get(index)) or (published if published.is_file() else None)


def rows(a: Side, b: Side) -> Iterator[Row]:
    """At most SHOWN of them."""
    for pair in pairs(a, b)[:SHOWN]:
        yield _row(a, b, pair)


def kind_of(a: Side, b: Side) -> str:
    """What the views are: held out of both fits, or not."""
    return "Held-out views" if all(at(s.metrics, "holdout.held_out") for s in (a, b)) else "Views"


def _row(a: Side, b: Side, pair: Pair) -> Row:
    from pipeline.images import read_alpha, read_linear
    from stages.report.metrics import encoded
    from stages.report.pictures import ERROR_RANGE, data_uri, heat, to_bytes

    path = a.stored("capture", pair.a.get("image")) or b.stored("capture", pair.b.get("image"))
    mask = _mask(a, pair.a) or _mask(b, pair.b)
    renders = [_render(render_of(s, v)) for s, v in ((a, pair.a), (b, pair.b))]
    photo = read_linear(path) if path is not None else None
    height, width = (photo if photo is not None else renders[0]).shape[:2]
    scale = min(1.0, SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    shown = [encoded(fitted(r, *size)) for r in renders]
    pictures = []
    if photo is not None:
        pictures.append(Picture(data_uri(to_bytes(encoded(fitted(photo, *size))), SIDE), "photo"))
    for name, image, psnr in zip("AB", shown, pair.psnr or (None, None), strict=True):
        pictures.append(Picture(data_uri(to_bytes(image), SIDE), name + (f", {psnr:.1f} dB" if psnr else "")))
    apart = np.asarray(np.abs(shown[1] - shown[0]).mean(-1) / ERROR_RANGE, np.float32)
    pictures.append(Picture(data_uri(heat(apart), SIDE), "A and B apart"))
    if photo is not None and mask is not None:
        subject = encoded(fitted(photo, *size) * fitted(read_alpha(mask), *size)[..., None])
        errors = [np.abs(image - subject).mean(-1) for image in shown]
        nearer = signed(np.asarray(errors[0] - errors[1], np.float32), NEARER)
        pictures.append(Picture(data_uri(nearer, SIDE), "nearer to the photo: blue B, orange A"))
    change = f"{pair.psnr[1] - pair.psnr[0]:+.2f} dB" if pair.psnr else "not scored in both"
    held = [bool(v.get("holdout")) for v in (pair.a, pair.b)]
    note = "" if all(held) else "fitted in " + " and ".join(n for n, h in zip("AB", held, strict=True) if not h)
    return Row(f"{pair.name}: {change}", note, tuple(pictures))


def _mask(side: Side, view: dict[str, Any]) -> Path | None:
    known = {m.get("index"): m.get("mask") for m in side.run.manifest("masks").get("masks", ()) if isinstance(m, dict)}
    return side.stored("masks", known.get(view.get("index")))


def _render(path: Path | None) -> F32:
    """(H, W, 3) linear, on black, of a PNG with straight alpha."""
    from pipeline.images import read_alpha, read_linear

    assert path is not None, "only photos with both renders are paired"
    return np.asarray(read_linear(path) * read_alpha(path)[..., None], np.float32)


def sides(a: Side, b: Side) -> list[Row]:
    """The previews of both assets, one below the other: appearance, then shape. Empty unless both have some."""
    from pipeline.images import read_encoded
    from stages.report.pictures import data_uri

    found = [_previews(s) for s in (a, b)]
    names = [f"{kind}{turn}" for kind in ("", "shape_") for turn in ("left", "front", "right")]
    both = [n for n in names if all(n in f for f in found)]
    rows_of = []
    for title, kind in (("Appearance, captured light", ""), ("Shape", "shape_")):
        own = [n for n in both if n.startswith("shape_") == bool(kind)]
        pictures = [Picture(data_uri(read_encoded(f[n]), SIDE), f"{side.name}, {n.removeprefix('shape_')}")
                    for side, f in zip((a, b), found, strict=True) for n in own]  # fmt: skip
        if pictures:
            rows_of.append(Row(title, "", tuple(pictures)))
    return rows_of


def _previews(side: Side) -> dict[str, Path]:
    """name -> file."""
    files = (f for f in side.run.manifest("usd").get("files", ()) if isinstance(f, dict))
    named = {str(f.get("path", "")): side.stored("usd", f) for f in files}
    return {
        n.removeprefix("previews/").removesuffix(".png"): p
        for n, p in named.items()
        if n.startswith("previews/") and p is not None
    }
