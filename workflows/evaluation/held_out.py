"""The held-out pictures of a run as EXR: in OUT/report where the run kept all, else in its store."""

from __future__ import annotations

from pathlib import Path

from pipeline.store import MANIFEST, read_object

KINDS = {"views": ("inverse_rendering", "held_out"), "asset_views": ("usd", "views")}  # folder -> stage, field


def held_out_exr(out: Path, kind: str, index: int) -> Path:
    """The picture of a view. kind: "views" of the fitted model, "asset_views" of the asset. It may not be there."""
    published = out / "report" / kind / f"{index}.exr"
    if published.is_file():
        return published
    record, (stage, field) = read_object(out / "run.json"), KINDS[kind]
    known = record.get("stages", {}).get(stage, {})
    folder = Path(str(record.get("store", ""))) / stage / str(known.get("key", ""))
    views = read_object(folder / MANIFEST).get(field, ())
    return next((folder / v["exr"]["path"] for v in views if v.get("index") == index), published)
