"""From the store into the folder that the user named. Nothing half-written is ever seen under its final name."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.artifacts import FileRef, Located
from pipeline.contract import Done, versions
from pipeline.errors import Cancelled, stage_error_from_os_error
from pipeline.store import link_or_copy
from workflows.run.owned import write_owned
from workflows.run.pack import packed, write_pack
from workflows.run.plan import Plan
from workflows.run.published import is_record, note_published, published
from workflows.run.replace import Replacement, drop, prepare, put, tidy
from workflows.run.report_timing import TIMED, with_seconds
from workflows.run.room import check_room_for_copies
from workflows.run.spare_page import owns_its_store, page_in_one_place
from workflows.run.verdict import verdict_of_done
from workflows.store.roots import note_root

Copies = dict[str, Path]  # path below the published folder -> file in the store


def publish(
    plan: Plan,
    done: Iterable[Done[Any]],
    notify: Callable[[str], None] = lambda text: None,
    stopped: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Copy asset/, report/ and reflectance/ to `plan.out` and write run.json beside them, and the asset's zip if the
    request has `pack`. Returns what run.json holds.

    All folders are complete before any replaces the one before it. Files of the user's own in them stay. One whose
    name is needed, or that was published and then edited, is renamed; `notify` is called, and run.json names it under
    "moved_aside". stopped: whether the user stops the run; asked for the last time before anything is replaced.

    Raises:
        StageError: the disk is full or can't be written; what was there before is still there.
        Cancelled: the user stopped the run; as before.
    """
    stages = {d.stage: d for d in done}
    record = run_record(plan, stages)
    try:
        moved = _replace_folders(plan, stages, record["timing"], stopped)
        moved |= _pack(plan, stages, record, notify)
        if moved:
            record["moved_aside"] = moved
        aside = write_owned(plan.out, "run.json", json.dumps(record, indent=1), is_record)
        for before, now in (moved | ({"run.json": aside} if aside else {})).items():
            notify(f"{plan.out / before} is yours: kept as {plan.out / now}")
        page_in_one_place(plan, stages)
        note_root(plan.store, plan.out, {n: d.key for n, d in stages.items()})
    except OSError as e:
        raise stage_error_from_os_error(e, plan.out) or e from e
    return record


def _pack(
    plan: Plan, stages: Mapping[str, Done[Any]], record: dict[str, Any], notify: Callable[[str], None]
) -> dict[str, str]:
    """The zip, where it is asked for and there is an asset. Returns the user's file that had to move."""
    if plan.request.pack is None:
        return {}
    if "usd" not in stages:
        notify("no zip: this run ended before the asset")
        return {}
    name = stages["usd"].located.artifact.name
    aside = write_pack(plan.out, name, asset_files(stages))
    record["pack"] = f"{name}.zip"
    return {record["pack"]: aside} if aside else {}


def _replace_folders(
    plan: Plan, stages: Mapping[str, Done[Any]], timing: Mapping[str, float], stopped: Callable[[], bool]
) -> dict[str, str]:
    """asset/, report/ and reflectance/, whichever the stages made. Returns the user's files that had to move: old
    path -> new."""
    out, known, moved = plan.out, published(plan.out), dict[str, str]()
    assets = asset_files(stages)
    wanted = {
        "asset": assets,
        "report": report_files(stages, exr=not plan.request.no_exr_views),
        "reflectance": reflectance_files(stages),
    }
    linked = frozenset(_linked(plan, (*assets.values(), *wanted["report"].values())))
    zipped = [assets[p] for p in packed(assets)] if plan.request.pack else []
    for name in wanted:
        moved |= tidy(out, name, known)
    copied = (p for copies in wanted.values() for p in copies.values() if p not in linked)
    check_room_for_copies(out, (*copied, *zipped))
    made: list[Replacement] = []
    try:
        for name, copies in wanted.items():
            if copies:
                made.append(prepare(out, name, partial(_fill, name, copies, timing, linked), known))
        _stop_if(stopped)
        new = {p: h for m in made for p, h in m.hashes.items()}
        note_published(out, {**known, **{p: known.get(p, frozenset()) | {h} for p, h in new.items()}})
        for folder in made:
            put(folder)
            moved |= folder.aside
    except BaseException:
        for folder in made:
            drop(folder)
        raise
    kept = {p: h for p, h in known.items() if p.partition("/")[0] not in {m.name for m in made}}
    note_published(out, {**kept, **{p: frozenset({h}) for p, h in new.items()}})
    return moved


def _stop_if(stopped: Callable[[], bool]) -> None:
    if stopped():
        raise Cancelled("stopped by the user; finished stages are kept, nothing was published")


def _linked(plan: Plan, sources: Iterable[Path]) -> Iterable[Path]:
    """Files of the store that get a second name in OUT instead of a copy: those of the stage usd, where the store is
    OUT's own. An edit in place then damages a result that takes a minute to make again, which its hash tells; the views
    of the fit are copied, and so is everything of a store that several folders share."""
    inside = plan.store.root / "usd"
    return (p for p in sources if p.is_relative_to(inside)) if owns_its_store(plan) else ()


def _fill(name: str, copies: Copies, timing: Mapping[str, float], linked: frozenset[Path], folder: Path) -> None:
    for path, source in copies.items():
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        if name == "report" and path in TIMED:
            target.write_bytes(with_seconds(path, source.read_bytes(), timing))
        elif source in linked:
            link_or_copy(source, target)
        else:
            shutil.copyfile(source, target)


def asset_files(stages: Mapping[str, Done[Any]]) -> Copies:
    """asset/: everything that lies beside the file to open."""
    if "usd" not in stages:
        return {}
    usd: Located[Any] = stages["usd"].located
    top = usd.artifact.root.rpartition("/")[0]
    inside = f"{top}/" if top else ""
    return {f.path.removeprefix(inside): usd.path(f) for f in usd.artifact.files if f.path.startswith(inside)}


def report_files(stages: Mapping[str, Done[Any]], *, exr: bool) -> Copies:
    """report/: the page and its figures, and the held-out views of the model and of the exported asset as PNG
    and, for programs that measure them, as EXR."""
    copies: Copies = {}
    if "report" in stages:
        copies |= {f.path: stages["report"].located.path(f) for f in stages["report"].located.artifact.files}
    for stage, field, folder in (("inverse_rendering", "held_out", "views"), ("usd", "views", "asset_views")):
        if stage not in stages:
            continue
        located = stages[stage].located
        for view in getattr(located.artifact, field):
            if exr:
                copies[f"{folder}/{view.index}.exr"] = located.path(view.exr)
            copies[f"{folder}/{view.index}.png"] = located.path(view.png)
    return copies | _of_second(stages, exr=exr)


def _of_second(stages: Mapping[str, Done[Any]], *, exr: bool) -> Copies:
    """report/second/: the light of a second capture, and its held-out views as the model shows them."""
    located = stages["inverse_rendering"].located if "inverse_rendering" in stages else None
    second = getattr(located.artifact, "second", None) if located is not None else None
    if located is None or second is None:
        return {}
    copies = {"second/light.json": located.path(second.light)}
    for view in second.held_out:
        copies |= {f"second/views/{view.index}.{k}": located.path(getattr(view, k)) for k in ("exr", "png")[not exr :]}
    return copies


def reflectance_files(stages: Mapping[str, Done[Any]]) -> Copies:
    """reflectance/: the field of a light stage's capture; nothing for other captures."""
    if "reflectance" not in stages:
        return {}
    located = stages["reflectance"].located
    return {f.path.removeprefix("reflectance/"): located.path(f) for f in located.artifact.files}


def run_record(plan: Plan, stages: Mapping[str, Done[Any]]) -> dict[str, Any]:
    """What run.json holds. Figures that may differ from run to run are here, not in any manifest."""
    taken = {n: float(d.run.get("seconds", 0.0)) for n, d in stages.items()}
    record: dict[str, Any] = {
        "verdict": verdict_of_done(stages.values()).record(),
        "stages": {
            n: {
                "key": d.key,
                "reused": d.reused,
                "seconds": taken[n],
                "peak_memory_mb": d.run.get("peak_memory_mb"),
                "device": d.run.get("device"),
                "warnings": list(getattr(d.located.artifact, "warnings", ())),
            }
            for n, d in stages.items()
        },
        "timing": {**taken, "total": round(sum(taken.values()), 3)},
        "request": plan.request.model_dump(mode="json") | plan.request.whole_paths(),
        "store": str(plan.store.root.resolve()),
        "device": plan.device,
        "seed": plan.request.seed,
        "versions": versions(),
    }
    if "poses" in stages:
        record["capture_from_asset"] = stages["poses"].located.artifact.capture_from_asset
    if "usd" in stages:
        record["asset"] = f"asset/{Path(stages['usd'].located.artifact.root).name}"
        record["asset_hash"] = asset_hash(stages["usd"].located.artifact.files)
    return record


def asset_hash(files: Iterable[FileRef]) -> str:
    """sha256 over the sorted (path, sha256) of the asset's files: equal hashes mean equal bytes."""
    pairs = sorted((f.path, f.sha256) for f in files)
    return hashlib.sha256(json.dumps(pairs).encode()).hexdigest()
