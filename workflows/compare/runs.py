"""The two runs of a comparison: what their folders and their store still have, and what is missing.

A run of another version, or one whose store was cleared, is no error: what is there is compared, and `notes` says what
is not. Manifests are read as they are, so that fields that another version adds or lacks do no harm.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import StageError, UsageError
from pipeline.store import MANIFEST, RUN, read_object
from workflows.bench.captures_figures import Run

STAGES = ("capture", "poses", "masks", "uv", "bake", "usd")  # whose manifests are read


@dataclass(slots=True)
class Side:
    """One of the two runs. name: A or B. notes: what of it can't be shown, and why."""

    name: str
    out: Path
    run: Run
    notes: list[str] = field(default_factory=list)

    @property
    def record(self) -> dict[str, Any]:
        return self.run.record

    @property
    def metrics(self) -> dict[str, Any]:
        return self.run.metrics

    def key(self, stage: str) -> str:
        """Of a stage's result; empty if the run has none."""
        return str(self.record["stages"].get(stage, {}).get("key", ""))

    def settings(self) -> dict[str, Any]:
        """The values that the stages ran with: stage.name -> value; those of the store's records."""
        out: dict[str, Any] = {}
        for stage in self.record["stages"]:
            folder = self.run.folder(stage)
            config = read_object(folder / RUN).get("config") if folder is not None else None
            out |= {f"{stage}.{k}": v for k, v in config.items()} if isinstance(config, dict) else {}
        return out

    def photos(self) -> dict[tuple[str, int], dict[str, Any]]:
        """The capture's photos by their content: (sha256, the number among equal ones) -> the manifest's view."""
        out: dict[tuple[str, int], dict[str, Any]] = {}
        seen: Counter[str] = Counter()
        for view in _tables(self.run.manifest("capture").get("views"), "image"):
            sha = str(view["image"].get("sha256"))
            out[sha, seen[sha]] = view
            seen[sha] += 1
        return out

    def stored(self, stage: str, ref: object) -> Path | None:
        """A file of a stage's result; None if it is not there."""
        folder = self.run.folder(stage)
        path = folder / str(ref["path"]) if folder is not None and isinstance(ref, dict) and "path" in ref else None
        return path if path is not None and path.is_file() else None


def read_sides(a: Path, b: Path) -> tuple[Side, Side]:
    """Both runs.

    Raises:
        UsageError: they are the same folder. StageError: one is not a run's folder.
    """
    if a.resolve() == b.resolve():
        raise UsageError(
            "both names are the same run",
            where="A and B",
            value=b,
            limit="two different folders",
            remedy="name the --out folders of two runs",
        )
    return read_side("A", a), read_side("B", b)


def read_side(name: str, out: Path) -> Side:
    """One run, with notes on what is missing. Raises StageError if the folder holds no run."""
    record = read_object(out / "run.json")
    stages = record.get("stages")
    if not isinstance(stages, dict) or not stages:
        raise StageError(
            "this folder holds no run",
            where=out / "run.json",
            value=_what_it_is(out),
            limit="the run.json of a run",
            remedy=_remedy(out),
        )
    record["stages"] = {n: s for n, s in stages.items() if isinstance(s, dict) and isinstance(s.get("key"), str)}
    record.setdefault("store", "")
    metrics = read_object(out / "report" / "metrics.json")
    known = Run(out, record, metrics, {s: {} for s in STAGES})
    folders = {s: known.folder(s) for s in STAGES}
    run = Run(out, record, metrics, {s: read_object(f / MANIFEST) if f else {} for s, f in folders.items()})
    side = Side(name, out, run)
    side.notes += _missing(side)
    return side


def _missing(side: Side) -> Iterator[str]:
    if not isinstance(side.record.get("verdict"), dict):
        yield f"{side.name} has no verdict: its run.json is of an older version"
    if "usd" not in side.record["stages"]:
        yield f"{side.name} has no asset: it ended after {list(side.record['stages'])[-1:] or ['nothing']}"
    if not side.metrics:
        yield f"{side.name} has no {side.out / 'report/metrics.json'}: its scores are not shown"
    gone = [s for s in STAGES if s in side.record["stages"] and not side.run.manifest(s)]
    if gone:
        yield (
            f"{side.name}: the store {side.record['store']} no longer has {', '.join(gone)}: what is read from "
            "there is left out; the run's command makes it again"
        )


def _what_it_is(out: Path) -> str:
    if not out.exists():
        return "no such folder"
    return "a batch" if (out / "batch").is_dir() else "no run.json, or one without stages"


def _remedy(out: Path) -> str:
    found = sorted(p.parent for p in out.glob("*/run.json"))[:2] if out.is_dir() else []
    return f"name one run, for example {found[0]}" if found else "name the folder that was given as --out"


def common_photos(a: Side, b: Side) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Views of photos that both captures have, by content, in A's order."""
    theirs = b.photos()
    return [(view, theirs[key]) for key, view in a.photos().items() if key in theirs]


def about_captures(a: Side, b: Side) -> list[str]:
    """Notes on how far the two captures are the same."""
    ours, theirs = a.photos(), b.photos()
    if not ours or not theirs or ours.keys() == theirs.keys():
        return []
    both = len(ours.keys() & theirs.keys())
    if not both:
        return [
            "different captures: A and B have no photo in common, so that their figures say how the captures differ, "
            "not how the settings do; views and surfaces are not compared"
        ]
    return [
        f"the captures differ: {both} photos are in both, {len(ours) - both} only in A, {len(theirs) - both} only in B"
    ]


def _tables(value: object, *keys: str) -> Iterator[dict[str, Any]]:
    """The objects of a list that have these keys."""
    for item in value if isinstance(value, list) else ():
        if isinstance(item, dict) and all(isinstance(item.get(k), dict) for k in keys):
            yield item
